"""The overlay of what moves among the backgrounds of a solved camera: finding it and taking it away."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..access import camera_of
from ..scene.ownership import TAG
from ..shot import scene_objects

OVERLAY = "motion overlay"
"""Mark of its image, as the value of `TAG`."""
_BEFORE = "splannequin_shown_before"
"""Property of its image: which backgrounds of ours were shown before it came."""


def find(scene: bpy.types.Scene, shot: Path) -> bpy.types.CameraBackgroundImage | None:
    """The overlay behind the shot's camera, if it is shown."""
    camera = scene_objects.part(scene, shot, "camera")
    backgrounds = camera_of(camera).background_images if camera is not None else ()
    return next((b for b in backgrounds if b.image is not None and b.image.get(TAG) == OVERLAY), None)


def bare_plate(data: bpy.types.Camera, overlay: bpy.types.Image) -> None:
    """Shows the plate of a camera, and not the freeze before it; the overlay's image keeps what `hide` puts back."""
    ours = _ours(data)
    overlay[_BEFORE] = [int(background.show_background_image) for background in ours]
    for place, background in enumerate(ours):
        background.show_background_image = place == 0  # the plate is there first


def _ours(data: bpy.types.Camera) -> list[bpy.types.CameraBackgroundImage]:
    """Backgrounds of ours but the overlay."""
    images = [(b, b.image) for b in data.background_images]
    return [b for b, image in images if image is not None and image.get(TAG) and image.get(TAG) != OVERLAY]


def hide(scene: bpy.types.Scene, shot: Path) -> bool:
    """Takes the overlay away. True if it was shown."""
    background = find(scene, shot)
    camera = scene_objects.part(scene, shot, "camera")
    if background is None or camera is None:
        return False
    image, background.image = background.image, None  # removing it alone leaves the image with a user
    camera_of(camera).background_images.remove(background)
    ours = _ours(camera_of(camera))
    before = list(image.get(_BEFORE, [])) if image is not None else []
    for other, was_shown in zip(ours, before if len(before) == len(ours) else []):
        other.show_background_image = bool(was_shown)
    if image is not None and image.users == 0:
        bpy.data.images.remove(image)
    return True
