"""A camera of the artist's, read frame by frame, and whether a take is seen from one."""

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
    """Reads an animated camera over the scene's range, a frame per turn; yields frames done, returns the CameraPath.

    Nothing of bpy is kept between two turns. The scene's current frame is put back at the end.

    Args:
        scene: the scene, whose range, render size and pixel aspect say what the camera sees.
        name: of the camera object.
        shot: shot folder whose solve the path is to be in.
        width: of the frames in pixels; 0: the scene's.
        every: of the scene's frames that one is read of, the last one as well.

    Raises:
        contract.JobError: the camera is gone, or is no perspective camera.
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
    """Name of the artist's camera to freeze from; empty for the clip's own move."""
    camera, folder = settings_of(scene).path_camera, selection.shot_folder(scene)
    if camera is None or folder is None or camera == scene_objects.part(scene, folder, "camera"):
        return ""
    return str(camera.name)


def shutter_of(scene: bpy.types.Scene) -> float:
    """Degrees of 360 that the shutter of the artist's camera is open, as the scene renders; 0 without motion blur."""
    if not settings_of(scene).motion_blur or not name_of(scene):
        return 0.0
    return min(360.0 * scene.render.motion_blur_shutter, 360.0)


def follows_camera(scene: bpy.types.Scene) -> bool:
    """True if a bake has to look at the artist's camera again: the take was seen from one, and one is chosen."""
    folder = selection.shot_folder(scene)
    if folder is None or not name_of(scene):
        return False
    return bool(inventory.read(folder).takes.get(settings_of(scene).take_name, {}).get("camera_path"))
