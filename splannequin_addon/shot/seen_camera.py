"""Cameras in the solve's coordinates: of a view of the scene, and of a take."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Generator
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ...torch_backend import contract
from ..access import camera_of, fully_named, holds, present
from ..scene import axes, session
from . import scene_objects


def in_solve(
    scene: bpy.types.Scene,
    shot: Path,
    view_matrix: Matrix,
    window_matrix: Matrix,
    width: int,
    height: int,
    graph: bpy.types.Depsgraph | None = None,
) -> tuple[list[float], list[float]]:
    """(viewmat, K) of a view of the scene in solve units.

    Args:
        scene: the scene. The shot's root in it defines the placement of the solve.
        shot: shot folder.
        view_matrix: world to view, Blender's axes, [4, 4].
        window_matrix: perspective projection, [4, 4].
        width: width of the image in pixels.
        height: height of the image in pixels.
        graph: dependency graph that evaluates the root; None: the state in the window, which must show the scene.

    Returns:
        viewmat: 16 floats, world-to-camera, row-major, OpenCV axes.
        K: fx, fy, cx, cy in pixels.
    """
    root = scene_objects.placed_root(scene, shot, graph)
    placed = np.array(root.matrix_world if root else Matrix(), dtype=np.float64)
    scale = scene_objects.depth_scale(scene, shot, graph)
    return axes.in_solve(view_matrix, window_matrix, placed, scale, (width, height))


def sampled(
    scene: bpy.types.Scene | None, name: str, shot: Path, number: int, size: tuple[int, int]
) -> contract.CameraFrame:
    """A camera at one frame in solve units; with an empty name, the scene's active camera, as markers switch it."""
    matrix, window, graph = evaluated(scene, name, number, size)
    view = matrix.normalized().inverted()
    scene = present(scene)
    return contract.CameraFrame(number, *in_solve(scene, shot, view, window, *size, graph), "blender")


def evaluated(
    scene: bpy.types.Scene | None,
    name: str,
    number: int,
    size: tuple[int, int],
    hint: str = "Choose another camera to freeze from.",
) -> tuple[Matrix, Matrix, bpy.types.Depsgraph]:
    """A camera of a scene, evaluated at a frame. Sets the scene to that frame.

    Args:
        scene: the scene; None if it no longer exists.
        name: `name_full` of the camera object; empty: the active camera, as markers switch it.
        number: frame number.
        size: width and height of the image in pixels, with the scene's pixel aspect.
        hint: hint of the error if it is not a perspective camera of the scene.

    Returns:
        Evaluated camera-to-world matrix, Blender's camera axes, [4, 4]; perspective projection, [4, 4]; and the
            dependency graph of both.

    Raises:
        contract.JobError: the camera no longer exists, is not a perspective camera, or is not evaluated.
    """
    if scene is not None:
        scene.frame_set(number)
    camera = None if scene is None else fully_named(scene.objects, name) if name else scene.camera
    if scene is None or camera is None or camera.type != "CAMERA" or camera_of(camera).type != "PERSP":
        name = name or (camera.name if camera is not None else "The scene's camera")
        raise contract.JobError(
            f"{name} is not a perspective camera of this scene.",
            hint,
            contract.ExitCode.USAGE,
        )
    # The context's view layer may belong to another scene, where the camera does not move.
    graph = present(_layer(scene, camera).depsgraph)
    seen = camera.evaluated_get(graph)
    if not seen.is_evaluated:
        raise contract.JobError(
            f"{camera.name} does not move, because it is disabled in viewports or its collection is excluded.",
            "Enable it in the Outliner, or make it the scene's camera.",
            contract.ExitCode.USAGE,
        )
    aspect = scene.render.pixel_aspect_x, scene.render.pixel_aspect_y
    window = seen.calc_matrix_camera(graph, x=size[0], y=size[1], scale_x=aspect[0], scale_y=aspect[1])
    return seen.matrix_world.copy(), window, graph


@contextlib.contextmanager
def frame_kept(scene_uid: int) -> Generator[None]:
    """Context manager that restores the current frame of the scene with this number at the end."""
    scene = session.scene_of(scene_uid)
    before = (scene.frame_current, scene.frame_subframe) if scene is not None else None
    try:
        yield
    finally:
        back = session.scene_of(scene_uid)
        if back is not None and before is not None:
            back.frame_set(before[0], subframe=before[1])


def _layer(scene: bpy.types.Scene, camera: bpy.types.Object) -> bpy.types.ViewLayer:
    """A view layer of the scene with a camera: the context's if possible, else the first."""
    layers = [layer for layer in scene.view_layers if holds(layer.objects, camera)]
    shown = bpy.context.view_layer
    return next((layer for layer in layers if layer == shown), (layers or list(scene.view_layers))[0])


def path_of(shot: Path, facts: dict[str, Any]) -> str:
    """File of a take's camera path: as stored, or in the shot if the shot was moved since."""
    named = str(facts.get("camera_path", ""))
    moved = contract.ShotFolder(shot).camera_path(str(facts.get("take", "")))
    return str(moved) if named and not os.path.isfile(named) and os.path.isfile(moved) else named
