"""Views of the scene in the solve's coordinates: a camera of the artist's, read frame by frame."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

from ...torch_backend import contract
from ..access import camera_of, named, present, settings_of
from ..scene import axes, scene_setup, session
from ..shot import inventory, scene_objects, selection


def in_solve(
    scene: bpy.types.Scene,
    shot: Path,
    view_matrix: Matrix,
    window_matrix: Matrix,
    width: int,
    height: int,
    graph: bpy.types.Depsgraph | None = None,
) -> tuple[list[float], list[float]]:
    """(viewmat, K) in solve units of what a view of the scene shows.

    Args:
        scene: the scene, in which the shot's root says where the solve stands.
        shot: shot folder.
        view_matrix: world to view, Blender's axes, [4, 4].
        window_matrix: perspective projection, [4, 4].
        width: of the picture in pixels.
        height: of the picture in pixels.
        graph: where the root stands by it; None: in the window's scene, which is the scene then.

    Returns:
        viewmat: 16 floats, world-to-camera, row-major, OpenCV axes.
        K: fx, fy, cx, cy in pixels.
    """
    root = scene_objects.placed_root(scene, shot, graph)
    placed = np.array(root.matrix_world if root else Matrix(), dtype=np.float64)
    scale = scene_objects.depth_scale(scene, shot, graph)
    return axes.in_solve(view_matrix, window_matrix, placed, scale, (width, height))


def sample_path(scene: bpy.types.Scene, name: str, shot: Path, width: int) -> Generator[int, None, contract.CameraPath]:
    """Reads an animated camera over the scene's range, a frame per turn; yields frames done, returns the CameraPath.

    Nothing of bpy is kept between two turns. The scene's current frame is put back at the end.

    Args:
        scene: the scene, whose range, render size and pixel aspect say what the camera sees.
        name: of the camera object.
        shot: shot folder whose solve the path is to be in.
        width: of the frames in pixels; 0: the scene's.

    Raises:
        contract.JobError: the camera is gone, or is no perspective camera.
    """
    uid, before = scene.session_uid, scene.frame_current
    size = scene_setup.render_size(scene)
    width = width or size[0]
    height = max(1, round(size[1] * width / size[0]))
    numbers = range(scene.frame_start, scene.frame_end + 1, scene.frame_step)
    del scene
    frames: list[contract.CameraFrame] = []
    try:
        for number in numbers:
            frames.append(_sampled(session.scene_of(uid), name, shot, number, (width, height)))
            yield len(frames)
    finally:
        back = session.scene_of(uid)
        if back is not None:
            back.frame_set(before)
    return contract.CameraPath(width, height, frames)


def _sampled(
    scene: bpy.types.Scene | None, name: str, shot: Path, number: int, size: tuple[int, int]
) -> contract.CameraFrame:
    """A camera at one frame, as `sample_path` reads it."""
    camera = named(scene.objects, name) if scene is not None else None
    if scene is None or camera is None or camera.type != "CAMERA" or camera_of(camera).type != "PERSP":
        raise contract.JobError(
            f"{name} is not a perspective camera of this scene.",
            "Choose another camera to freeze from.",
            contract.ExitCode.USAGE,
        )
    scene.frame_set(number)
    # The context's may be another scene's, where the camera stands still.
    graph = present(_layer(scene, camera).depsgraph)
    seen = camera.evaluated_get(graph)
    if not seen.is_evaluated:
        raise contract.JobError(
            f"{name} does not move: it is disabled in viewports, or its collection is excluded.",
            "Enable it in the Outliner, or make it the scene's camera.",
            contract.ExitCode.USAGE,
        )
    aspect = scene.render.pixel_aspect_x, scene.render.pixel_aspect_y
    window = seen.calc_matrix_camera(graph, x=size[0], y=size[1], scale_x=aspect[0], scale_y=aspect[1])
    view = seen.matrix_world.normalized().inverted()
    return contract.CameraFrame(number, *in_solve(scene, shot, view, window, *size, graph), "blender")


def _layer(scene: bpy.types.Scene, camera: bpy.types.Object) -> bpy.types.ViewLayer:
    """A view layer of the scene in which a camera moves: the context's, if it is one of them, else the first."""
    layers = [layer for layer in scene.view_layers if named(layer.objects, camera.name) == camera]
    shown = bpy.context.view_layer
    return next((layer for layer in layers if layer == shown), (layers or list(scene.view_layers))[0])


def name_of(scene: bpy.types.Scene) -> str:
    """Name of the artist's camera to freeze from; empty for the clip's own move."""
    camera, folder = settings_of(scene).path_camera, selection.shot_folder(scene)
    if camera is None or folder is None or camera == scene_objects.part(scene, folder, "camera"):
        return ""
    return str(camera.name)


def follows_camera(scene: bpy.types.Scene) -> bool:
    """True if a bake has to look at the artist's camera again: the take was seen from one, and one is chosen."""
    folder = selection.shot_folder(scene)
    if folder is None or not name_of(scene):
        return False
    return bool(inventory.read(folder).takes.get(settings_of(scene).take_name, {}).get("camera_path"))
