"""Draws the sparse points of a solve in their colours. Blender's solid view draws loose points in black.

The object therefore shows only its bounds. This module draws its points while the object is visible.
"""

from __future__ import annotations

from typing import Any

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader  # pyright: ignore[reportUnknownVariableType]

from .. import compat
from ..access import mesh_of, named, scene_in
from ..process import children
from ..shot import scene_objects, selection

# Size of a point in pixels.
_SIZE = 3.0
_handler: Any = None
# (key of the mesh, shader, batch) of the points drawn last.
_kept: tuple[Any, ...] = ()


def coloured(mesh: bpy.types.Mesh) -> tuple[np.ndarray, np.ndarray]:
    """(locations [P, 3], sRGB colours [P, 4]) of a point cloud's mesh, float32."""
    places = np.empty(3 * len(mesh.vertices), np.float32)
    vertices: Any = mesh.vertices
    vertices.foreach_get("co", places)
    colours = np.full((len(mesh.vertices), 4), 0.9, np.float32)
    layer: Any = named(mesh.color_attributes, "Col")
    if layer is not None and len(layer.data) == len(colours):
        flat = np.empty(colours.size, np.float32)
        layer.data.foreach_get("color_srgb", flat)
        colours = flat.reshape(-1, 4)
    return places.reshape(-1, 3), colours


def _draw() -> None:
    """Draw handler of a 3D view."""
    global _kept
    context = bpy.context
    if context.space_data is None or not context.space_data.overlay.show_overlays:
        return
    shot = selection.shot_folder(scene_in(context))
    cloud = scene_objects.part(scene_in(context), shot, "points") if shot is not None else None
    if cloud is None or cloud.display_type != "BOUNDS" or not cloud.visible_get():
        return
    mesh = mesh_of(cloud)
    if not len(mesh.vertices):
        return
    key = (mesh.name, len(mesh.vertices), mesh.vertices[0].co[:], str(shot))
    if not _kept or _kept[0] != key:
        shader = _first_shader(compat.POINT_SHADERS)
        places, colours = coloured(mesh)
        batch = batch_for_shader(shader, "POINTS", {"pos": places, "color": colours})  # pyright: ignore[reportArgumentType]
        _kept = (key, shader, batch)
    gpu.state.depth_test_set("LESS_EQUAL")
    gpu.state.point_size_set(_SIZE * context.preferences.system.ui_scale)
    with gpu.matrix.push_pop():  # pyright: ignore[reportGeneralTypeIssues]
        gpu.matrix.multiply_matrix(cloud.matrix_world)
        _kept[2].draw(_kept[1])
    gpu.state.point_size_set(1.0)
    gpu.state.depth_test_set("NONE")


def _first_shader(names: tuple[str, ...]) -> Any:
    for name in names[:-1]:
        try:
            return gpu.shader.from_builtin(name)
        except ValueError:
            continue
    return gpu.shader.from_builtin(names[-1])


def register() -> None:
    """Registers the draw handler, except in background mode."""
    global _handler
    if not bpy.app.background:
        _handler = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_VIEW")
        children.import_in_background("zipfile")  # needed by numpy to open a solve's points: 0.2 s from a cold disk


def unregister() -> None:
    """Removes the draw handler."""
    global _handler, _kept
    if _handler is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_handler, "WINDOW")
    _handler, _kept = None, ()
