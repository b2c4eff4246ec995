"""Reads the artist's camera frame by frame, and checks whether a take uses one."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

import bpy

from ...torch_backend import contract
from ..access import settings_of
from ..scene import scene_setup, session
from ..shot import inventory, scene_objects, seen_camera, selection


def sample_path(
    scene: bpy.types.Scene, name: str, shot: Path, width: int, every: int = 1
) -> Generator[int, None, contract.CameraPath]:
    """Reads an animated camera over the scene's range, one frame per step. Yields the frames done, returns the
    CameraPath.

    Keeps no bpy data between steps. Restores the scene's current frame at the end.

    Args:
        scene: the scene with the range, render size and pixel aspect of the path.
        name: `name_full` of the camera object.
        shot: shot folder. The path is in the coordinates of its solve.
        width: width of the frames in pixels; 0: the scene's.
        every: read every n-th frame of the scene, and the last one.

    Raises:
        contract.JobError: the camera no longer exists, or is not a perspective camera.
    """
    uid = scene.session_uid
    size = scene_setup.render_size(scene)
    width = width or size[0]
    height = max(1, round(size[1] * width / size[0]))
    numbers = range(scene.frame_start, scene.frame_end + 1, scene.frame_step)
    numbers = sorted({*numbers[::every], *numbers[-1:]})
    del scene
    frames: list[contract.CameraFrame] = []
    with seen_camera.frame_kept(uid):
        for number in numbers:
            frames.append(seen_camera.sampled(session.scene_of(uid), name, shot, number, (width, height)))
            yield len(frames)
    return contract.CameraPath(width, height, frames)


def name_of(scene: bpy.types.Scene) -> str:
    """`name_full` of the artist's camera to freeze from; empty for the clip's move."""
    camera, folder = settings_of(scene).path_camera, selection.shot_folder(scene)
    if camera is None or folder is None or camera == scene_objects.part(scene, folder, "camera"):
        return ""
    return str(camera.name_full)


def shutter_of(scene: bpy.types.Scene) -> float:
    """Shutter angle of the artist's camera in degrees, as the scene renders; 0 without motion blur."""
    if not settings_of(scene).motion_blur or not name_of(scene):
        return 0.0
    return min(360.0 * scene.render.motion_blur_shutter, 360.0)


def follows_camera(scene: bpy.types.Scene) -> bool:
    """True if a bake must read the artist's camera again: the take uses one, and one is selected."""
    folder = selection.shot_folder(scene)
    if folder is None or not name_of(scene):
        return False
    return bool(inventory.read(folder).takes.get(settings_of(scene).take_name, {}).get("camera_path"))
