"""Nodes that decode working frames with a highlight shoulder. Blender reads these frames as sRGB.

Below the knee the values are sRGB. Above it they encode light up to 64 times white, see
`torch_backend/contract/colour.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from mathutils import Color

from ...torch_backend import contract
from .. import compat
from ..access import set_value

if TYPE_CHECKING:
    import bpy

# Light level at which the shoulder begins.
_KNEE = ((contract.SHOULDER_FROM + 0.055) / 1.055) ** 2.4
_WIDE = 180.0


def has_shoulder(shot_folder: contract.ShotFolder) -> bool:
    """True if the working frames of a shot have a shoulder. False also if frames.json cannot be read."""
    try:
        return contract.read_json(shot_folder.listing).get("display") == contract.SHOULDER
    except (OSError, ValueError, contract.JobError):
        return False


def lit(tree: bpy.types.NodeTree, picture: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Socket of the scene-linear light of an image that was read as sRGB and has a shoulder. The result is opaque."""
    names = {node.name for node in tree.nodes}
    # The curve is defined for linear Rec.709. In another working space the channels are converted there and back.
    channels = _through(tree, list(compat.separated(tree, picture)), Color.from_scene_linear_to_rec709_linear)
    channels = _through(tree, [_inverse_shoulder(tree, c) for c in channels], Color.from_rec709_linear_to_scene_linear)
    whole = compat.combined(tree, channels)
    for column, node in enumerate(n for n in tree.nodes if n.name not in names):
        node.location = (_WIDE * (column % 8), -300.0 - _WIDE * (column // 8))
    return whole


def _inverse_shoulder(tree: bpy.types.NodeTree, channel: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Decoded light of a channel that was read as sRGB: max(c, knee) through the curve, less the knee, plus min(c,
    knee)."""
    # By Math nodes, because Blender's curve nodes would end at 1.
    start, roll = contract.SHOULDER_FROM, contract.SHOULDER_ROLL
    srgb = _on(tree, _on(tree, channel, "MAXIMUM", _KNEE), "POWER", 1.0 / 2.4)
    grown = _on(tree, _on(tree, srgb, "MULTIPLY_ADD", 1.055 / roll, -(0.055 + start) / roll), "EXPONENT")
    # 0.8 + roll (e - 1), decoded from sRGB to light
    base = _on(tree, grown, "MULTIPLY_ADD", roll / 1.055, (start - roll + 0.055) / 1.055)
    above = _on(tree, _on(tree, base, "POWER", 2.4), "SUBTRACT", _KNEE)
    node = compat.new_math_node(tree, "ADD")
    tree.links.new(above, node.inputs[0])
    tree.links.new(_on(tree, channel, "MINIMUM", _KNEE), node.inputs[1])
    return node.outputs[0]


def _through(
    tree: bpy.types.NodeTree, channels: list[bpy.types.NodeSocket], convert: Callable[[Color], Color]
) -> list[bpy.types.NodeSocket]:
    """The channels converted to another linear space; unchanged if the spaces are equal."""
    units = [convert(Color([float(n == k) for n in range(3)])) for k in range(3)]
    columns: list[tuple[float, float, float]] = [(unit.r, unit.g, unit.b) for unit in units]
    same = all(abs(columns[k][n] - float(n == k)) < 1e-4 for n in range(3) for k in range(3))
    if same:
        return channels
    out: list[bpy.types.NodeSocket] = []
    for n in range(3):
        total = _on(tree, channels[0], "MULTIPLY", columns[0][n])
        for k in (1, 2):
            node = compat.new_math_node(tree, "MULTIPLY_ADD")
            tree.links.new(channels[k], node.inputs[0])
            set_value(node.inputs[1], columns[k][n])
            tree.links.new(total, node.inputs[2])
            total = node.outputs[0]
        out.append(total)
    return out


def _on(tree: bpy.types.NodeTree, source: bpy.types.NodeSocket, operation: str, *values: float) -> bpy.types.NodeSocket:
    node = compat.new_math_node(tree, operation)
    tree.links.new(source, node.inputs[0])
    for socket, value in zip(node.inputs[1:], values, strict=False):
        set_value(socket, value)
    return node.outputs[0]
