"""Crops and scales a take's layers to the scene's render size, and provides the horizontal ramp for the wipe."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

from ...torch_backend import contract
from .. import compat
from ..access import pixels_of, set_value
from ..scene.ownership import TAG
from .node_names import GAP


def across(group: bpy.types.NodeTree) -> bpy.types.NodeSocket:
    """Socket of a value that rises from 0 at the left edge of the frame to 1 at the right edge."""
    # A scaled image would do in every version, but Blender 4.3 leaves its lowest row unset. 5.0 has no texture node.
    if compat.HAS_TEXTURE_NODE:
        node: Any = group.nodes.new("CompositorNodeTexture")
        node.texture = _blend()
        node.label = "From left to right"
        node.location = (-2 * GAP, 330.0)
        return node.outputs["Value"]
    ramp: Any = group.nodes.new("CompositorNodeImage")
    ramp.image = _ramp()
    ramp.label = "From left to right"
    wide = compat.new_fit_node(group, "Stretch")
    group.links.new(ramp.outputs["Image"], wide.inputs[0])
    # A scaled image fades out over its outermost pixels. Oversizing the ramp puts those pixels outside the frame.
    larger = group.nodes.new("CompositorNodeScale")
    for name in ("X", "Y"):
        set_value(larger.inputs[name], _BEYOND)
    group.links.new(wide.outputs[0], larger.inputs[0])
    ramp.location, wide.location = (-3 * GAP, 330.0), (-2 * GAP, 330.0)
    return larger.outputs[0]


RAMP = "Splannequin Ramp"
_STEPS, _ROWS = 1024, 32
# Layers with more than one channel.
_WIDE = {layer.name for layer in contract.FRAME_LAYERS if len(layer.channels) > 1}
# Size of the ramp relative to the frame.
_BEYOND = 1.1


def _blend() -> bpy.types.Texture:
    """A texture that rises from left to right."""
    texture = next((t for t in bpy.data.textures if t.get(TAG) and t.type == "BLEND"), None)
    if texture is None:
        texture = bpy.data.textures.new(RAMP, "BLEND")
        texture[TAG] = True
    return texture


def _ramp() -> bpy.types.Image:
    """An image that rises from 0 at the left edge of the frame to 1 at the right."""
    image = next((i for i in bpy.data.images if i.get(TAG) and not i.library and i.name.startswith(RAMP)), None)
    if image is not None:
        return image
    image = bpy.data.images.new(RAMP, _STEPS, _ROWS, alpha=False, float_buffer=True, is_data=True)
    image[TAG] = True
    across = 0.5 + _BEYOND * ((np.arange(_STEPS, dtype=np.float32) + 0.5) / _STEPS - 0.5)
    row = np.repeat(across[:, None], 4, axis=1)
    row[:, 3] = 1.0
    pixels_of(image).foreach_set(np.tile(row, (_ROWS, 1)).ravel())
    image.update()
    image.pack()
    return image


def fitted(
    scene: bpy.types.Scene,
    group: bpy.types.NodeTree,
    size: tuple[int, int],
    margin: tuple[int, int],
    layers: dict[str, bpy.types.NodeSocket],
) -> dict[str, bpy.types.NodeSocket]:
    """The layers' sockets by name, without overscan and scaled to the render size at the time of rendering.

    Frames with a wider aspect ratio than the render are cropped to the camera's view. Taller renders get bars.
    """
    names, sockets = tuple(layers), dict(layers)
    for row, name in enumerate(names if any(margin) else ()):
        node = compat.new_crop_node(group, margin, size)
        node.label = f"{name} without overscan"
        node.location = (-2 * GAP, -50.0 - 170.0 * row)
        group.links.new(sockets[name], node.inputs[0])
        sockets[name] = node.outputs[0]
    mode, shown = fit_mode(scene, size), _whole(group, sockets["Depth"])
    coverage = None
    for row, name in enumerate(("", *names) if shown is not None else names):
        node = compat.new_fit_node(group, mode)
        node.label = f"Fit {name}" if name else "Fit coverage"
        node.location = (-GAP, 150.0 - 170.0 * row)
        group.links.new(sockets[name] if name or shown is None else shown, node.inputs[0])
        if not name:
            coverage = node.outputs[0]
        else:
            sockets[name] = _unfaded(group, node.outputs[0], coverage, name in _WIDE)
    return sockets


def fit_mode(scene: bpy.types.Scene, size: tuple[int, int]) -> str:
    """How to fit an image of a size into the render: the widths match, as in the solved camera."""
    tall = scene.render.resolution_x * size[1] / (scene.render.resolution_y * size[0])
    # With equal aspect ratios up to rounding, both modes work. Then use "Fit" where cropping leaves a row unset.
    alike = abs(tall - 1.0) < 0.01 and not compat.CROPS_WHOLE
    return "Crop" if tall > 0.99 and not alike else "Fit"


def _whole(group: bpy.types.NodeTree, layer: bpy.types.NodeSocket) -> bpy.types.NodeSocket | None:
    """Socket of 1 wherever a layer has pixels. None if it is not needed."""
    if compat.HAS_COMPOSITING_GROUP:  # there, the border of a scaled image does not fade out
        return None
    node = compat.new_math_node(group, "GREATER_THAN")
    node.inputs[1].default_value = -1.0
    node.label = "Everywhere"
    group.links.new(layer, node.inputs[0])
    return node.outputs[0]


def _unfaded(
    group: bpy.types.NodeTree, layer: bpy.types.NodeSocket, coverage: bpy.types.NodeSocket | None, picture: bool
) -> bpy.types.NodeSocket:
    """Socket of a scaled layer with the fade-out of its outermost pixels undone."""
    if coverage is None:
        return layer
    if picture:
        return compat.new_quotient(group, layer, coverage)
    node = compat.new_math_node(group, "DIVIDE")
    group.links.new(layer, node.inputs[0])
    group.links.new(coverage, node.inputs[1])
    return node.outputs[0]
