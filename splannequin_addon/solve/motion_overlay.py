"""The motion overlay in a solved camera's background images: finds and removes it."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..access import camera_of
from ..scene.ownership import TAG
from ..shot import scene_objects

OVERLAY = "motion overlay"
"""Tag value of its image."""
# Property of its image: which of our background images were visible before it was added.
_BEFORE = "splannequin_shown_before"


def find(scene: bpy.types.Scene, shot: Path) -> bpy.types.CameraBackgroundImage | None:
    """The overlay in the shot's camera, or None if it is not shown."""
    camera = scene_objects.part(scene, shot, "camera")
    backgrounds = camera_of(camera).background_images if camera is not None else ()
    return next((b for b in backgrounds if b.image is not None and b.image.get(TAG) == OVERLAY), None)


def bare_plate(data: bpy.types.Camera, overlay: bpy.types.Image) -> None:
    """Shows a camera's plate without the freeze over it. The overlay's image stores the state that `hide` restores."""
    ours = _ours(data)
    overlay[_BEFORE] = [int(background.show_background_image) for background in ours]
    for place, background in enumerate(ours):
        background.show_background_image = place == 0  # the plate is always the first


def _ours(data: bpy.types.Camera) -> list[bpy.types.CameraBackgroundImage]:
    """Our background images except the overlay."""
    images = [(b, b.image) for b in data.background_images]
    return [b for b, image in images if image is not None and image.get(TAG) and image.get(TAG) != OVERLAY]


def hide(scene: bpy.types.Scene, shot: Path) -> bool:
    """Removes the overlay. True if it was shown."""
    background = find(scene, shot)
    camera = scene_objects.part(scene, shot, "camera")
    if background is None or camera is None:
        return False
    image, background.image = background.image, None  # otherwise the removed background still counts as a user
    camera_of(camera).background_images.remove(background)
    ours = _ours(camera_of(camera))
    before = list(image.get(_BEFORE, [])) if image is not None else []
    for entry, was_shown in zip(ours, before if len(before) == len(ours) else []):
        entry.show_background_image = bool(was_shown)
    if image is not None and image.users == 0:
        bpy.data.images.remove(image)
    return True
