"""Nodes that freeze a plate by a take's warp: matte * plate(ST) + fill (`torch_backend/freeze/composite/warp.py`).

The nodes look up the four nearest pixels unfiltered and blend them bilinearly, in steps of 1/256 of a pixel. A position
at a pixel's centre gives exactly that pixel.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from .. import compat
from ..access import set_value

if TYPE_CHECKING:
    import bpy

LAYERS = ("Combined", "Alpha", "ST", "Matte")
"""Layers of a warp: the fill, the frozen frame's alpha, the ST coordinates, and the plate's weight."""
_STEPS = 256.0
_WIDE = 180.0


def frozen(
    tree: bpy.types.NodeTree, plate: bpy.types.NodeSocket, warp: bpy.types.NodeOutputs, size: tuple[int, int]
) -> bpy.types.NodeSocket:
    """Socket of a plate frozen by a warp, at the warp's size.

    Args:
        tree: node tree that gets the nodes.
        plate: socket of the plate.
        warp: outputs of the Image node that shows the warp, `LAYERS`.
        size: width and height of the plate that the warp applies to.
    """
    names = {node.name for node in tree.nodes}
    shown = looked_up(tree, plate, warp["ST"], size)
    whole = _mixed(tree, 1.0, _mixed(tree, 1.0, shown, warp["Matte"], "MULTIPLY"), warp["Combined"], "ADD")
    whole = compat.with_alpha(tree, whole, warp["Alpha"])
    for column, node in enumerate(n for n in tree.nodes if n.name not in names):
        node.location = (_WIDE * (column % 8 - 3), -1700.0 - _WIDE * (column // 8))
    return whole


def looked_up(
    tree: bpy.types.NodeTree, plate: bpy.types.NodeSocket, st: bpy.types.NodeSocket, size: tuple[int, int]
) -> bpy.types.NodeSocket:
    """Socket of a plate of `size` sampled bilinearly through an ST map, at the map's size."""
    plate = compat.sized(tree, plate, size)
    s, t = compat.new_coordinates(tree, st)
    # Blender's smooth filters differ between versions, and none reproduces an unmoved pixel exactly.
    (left, right, across), (low, high, up) = (_between(tree, v, n) for v, n in zip((s, t), size, strict=True))
    below, above = (
        _mixed(tree, across, compat.new_look_up(tree, plate, left, y), compat.new_look_up(tree, plate, right, y))
        for y in (low, high)
    )
    return _mixed(tree, up, below, above)


def _between(
    tree: bpy.types.NodeTree, share: bpy.types.NodeSocket, size: int
) -> tuple[bpy.types.NodeSocket, bpy.types.NodeSocket, bpy.types.NodeSocket]:
    """Sockets (first pixel, second pixel, weight of the second) for a position in a row of `size` pixels.

    The position and the coordinates of both pixels are fractions 0..1 of the row.
    """

    def on(source: bpy.types.NodeSocket, operation: str, *values: float) -> bpy.types.NodeSocket:
        node = compat.new_math_node(tree, operation)
        tree.links.new(source, node.inputs[0])
        for socket, value in zip(node.inputs[1:], values, strict=False):
            set_value(socket, value)
        return node.outputs[0]

    steps = on(on(share, "MULTIPLY_ADD", _STEPS * size, -0.5 * _STEPS), "ROUND")
    place = on(on(on(steps, "MULTIPLY", 1.0 / _STEPS), "MAXIMUM", 0.0), "MINIMUM", size - 1.0)
    first = on(place, "FLOOR")
    rest = compat.new_math_node(tree, "SUBTRACT")
    tree.links.new(place, rest.inputs[0])
    tree.links.new(first, rest.inputs[1])
    # Blender 4.3's Nearest rounds a pixel's centre to the next pixel. A quarter into the pixel is safe in all versions.
    at = [on(first, "MULTIPLY_ADD", 1.0 / size, (n + 0.25) / size) for n in (0, 1)]
    # The second pixel may lie outside the image, where no pixel exists. Its weight is then 0.
    return at[0], at[1], rest.outputs[0]


def _mixed(
    tree: bpy.types.NodeTree,
    amount: bpy.types.NodeSocket | float,
    base: bpy.types.NodeSocket,
    overlay: bpy.types.NodeSocket,
    blend: str = "MIX",
) -> bpy.types.NodeSocket:
    """Socket of the blend of two images, or of an image and a value."""
    _, factor, first, second, result = compat.new_mix_node(tree, blend)
    if isinstance(amount, (float, int)):
        factor.default_value = amount
    else:
        tree.links.new(amount, factor)
    tree.links.new(base, first)
    tree.links.new(overlay, second)
    return result
