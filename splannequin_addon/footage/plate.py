"""The clip behind a camera of ours, from the import until the solved camera takes its place: the frames are seen at
once. Neither the scene's own camera nor anything else of the artist's is touched."""

from __future__ import annotations

from pathlib import Path

import bpy

from ...torch_backend import contract
from ..access import camera_of
from ..scene import sequences
from ..shot import scene_objects

_REACH = 1e-2
"""How far the camera sees, in scene units: the plate alone, nothing of the scene stands before it."""


def show(scene: bpy.types.Scene, shot: Path) -> bpy.types.Object | None:
    """Makes the camera, in place of an earlier one of the shot; None if the import's frames are not there.

    Args:
        scene: the scene; frame n of it shows frame n of the clip.
        shot: shot folder.
    """
    remove(scene, shot)
    span = _frames(shot)
    if span is None:
        return None
    first, last, path = span
    name = f"{scene_objects.name_of(shot)} plate"
    data = bpy.data.cameras.new(name)
    data.clip_start, data.clip_end = 0.1 * _REACH, _REACH
    background = data.background_images.new()
    background.image = image = sequences.load_sequence(path, f"Clip {scene_objects.name_of(shot)}", "srgb")
    sequences.show_sequence(background.image_user, image, first, last)
    background.frame_method, background.display_depth, background.alpha = "FIT", "BACK", 1.0
    data.show_background_images = True
    camera = scene_objects.new(scene, shot).plate = bpy.data.objects.new(name, data)
    scene.collection.objects.link(camera)
    return camera


def find(scene: bpy.types.Scene, shot: Path) -> bpy.types.Object | None:
    """The camera, if the scene still has it."""
    return scene_objects.part(scene, shot, "plate")


def remove(scene: bpy.types.Scene, shot: Path) -> bool:
    """Takes the camera out of the file. True if it was there."""
    camera = find(scene, shot)
    if camera is None:
        return False
    data = camera_of(camera)
    images = [b.image for b in data.background_images]
    bpy.data.objects.remove(camera)
    if not data.users:
        bpy.data.cameras.remove(data)
    bpy.data.batch_remove([i for i in images if i is not None and not i.users])
    return True


def _frames(shot: Path) -> tuple[int, int, Path] | None:
    """First and last frame of an import, and the first one's picture."""
    try:
        listed = contract.read_json(contract.ShotFolder(shot).listing)["frames"]
        first, last, name = int(listed[0]["frame"]), int(listed[-1]["frame"]), Path(str(listed[0]["file"])).name
    except (OSError, ValueError, KeyError, IndexError, TypeError):
        return None
    path = contract.ShotFolder(shot).raw / name
    return (first, last, path) if path.is_file() else None
