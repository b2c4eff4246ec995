"""A camera with the clip as its background image, shown from the import until the solved camera replaces it.

Does not change the scene's active camera or any of the artist's data.
"""

from __future__ import annotations

from pathlib import Path

import bpy

from ...torch_backend import contract
from ..access import camera_of
from ..scene import sequences
from ..shot import scene_objects

# Clip end of the camera, in scene units. It is so small that no object of the scene covers the plate.
_REACH = 1e-2


def show(scene: bpy.types.Scene, shot: Path) -> bpy.types.Object | None:
    """Adds the camera to the scene and replaces an earlier one of the shot. None if the imported frames are missing.

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
    """The clip's camera, or None if the scene no longer has it."""
    return scene_objects.part(scene, shot, "plate")


def remove(scene: bpy.types.Scene, shot: Path) -> bool:
    """Removes the clip's camera from the file. True if there was one."""
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
    """(first frame, last frame, image of the first frame) of an import, or None."""
    try:
        listed = contract.read_json(contract.ShotFolder(shot).listing)["frames"]
        first, last, name = int(listed[0]["frame"]), int(listed[-1]["frame"]), Path(str(listed[0]["file"])).name
    except (OSError, ValueError, KeyError, IndexError, TypeError):
        return None
    path = contract.ShotFolder(shot).raw / name
    return (first, last, path) if path.is_file() else None
