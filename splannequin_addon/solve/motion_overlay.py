"""The overlay of what moves among the backgrounds of a solved camera: finding it and taking it away."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..access import camera_of
from ..scene.ownership import TAG
from ..shot import scene_objects

OVERLAY = "motion overlay"
"""Mark of its image, as the value of `TAG`."""


def find(scene: bpy.types.Scene, shot: Path) -> bpy.types.CameraBackgroundImage | None:
    """The overlay behind the shot's camera, if it is shown."""
    camera = scene_objects.part(scene, shot, "camera")
    backgrounds = camera_of(camera).background_images if camera is not None else ()
    return next((b for b in backgrounds if b.image is not None and b.image.get(TAG) == OVERLAY), None)


def hide(scene: bpy.types.Scene, shot: Path) -> bool:
    """Takes the overlay away. True if it was shown."""
    background = find(scene, shot)
    camera = scene_objects.part(scene, shot, "camera")
    if background is None or camera is None:
        return False
    image, background.image = background.image, None  # removing it alone leaves the image with a user
    camera_of(camera).background_images.remove(background)
    if image is not None and image.users == 0:
        bpy.data.images.remove(image)
    return True
