"""Shows the frozen frames as the solved camera's background instead of the plate, which stays there, switched off."""

from __future__ import annotations

from pathlib import Path

import bpy

from ...torch_backend import contract
from ..access import camera_of, holds
from ..scene import sequences
from ..scene.ownership import TAG
from ..shot import scene_objects


def show(scene: bpy.types.Scene, shot: Path, name: str, first: int, last: int) -> list[str]:
    """Shows the previews of the take `name`, and hides the solve's points in all view layers.

    Returns the changes as sentences; empty without a solved camera.
    """
    camera = scene_objects.part(scene, shot, "camera")
    path = contract.TakeFolder(contract.ShotFolder(shot).takes / name).preview(first)  # faster than the EXR
    if camera is None or not path.is_file():
        return []
    data = camera_of(camera)
    image = sequences.load_sequence(path, f"Frozen {name}", "srgb")
    shown = next((b for b in data.background_images if b.image == image), None)
    background = shown or data.background_images.new()
    for entry in data.background_images:
        if entry.image is not None and entry.image.get(TAG) and entry.display_depth == "BACK":
            entry.show_background_image = entry == background
    background.image = image
    sequences.show_sequence(background.image_user, image, first, last)
    background.frame_method, background.display_depth, background.alpha = "FIT", "BACK", 1.0
    data.show_background_images = True
    points = scene_objects.part(scene, shot, "points")
    for layer in scene.view_layers:
        if points is not None and holds(layer.objects, points):
            points.hide_set(True, view_layer=layer)  # they would cover the image
    return [f"The camera shows the frames of take {name}. The points are hidden."]
