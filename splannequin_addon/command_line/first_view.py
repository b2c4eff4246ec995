"""How a shot.blend that was made without a window looks when it is opened in one.

The 3D viewport looks through the solved camera at the instant's frame, the freeze stands behind it, and a light is
there for what the artist adds. The solve's points are hidden: they would cover the picture. For scenes that we made:
nothing of an artist's own file is changed.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from ..access import camera_of
from ..bake import take_files
from ..bake.take_files import Take
from ..scene import numbered, sequences
from ..scene.ownership import TAG
from ..shot import inventory, scene_objects
from ..solve import cameras

_SUN = (math.radians(50.0), 0.0, math.radians(-40.0))
"""Rotation of the light: from above, behind and beside a camera that looks along y."""
_STRENGTH = 3.0
"""Of the light, W/m2: a white surface that faces it is about as bright as white."""


def set_up(scene: bpy.types.Scene, shot: Path, name: str) -> None:
    """Prepares a new scene, in which the take `name` stands in the compositor, to be saved and opened in a window."""
    camera = cameras.find(scene, shot, "CAMERA")
    if camera is None:
        return
    facts = inventory.read(shot).takes.get(name, {})
    if not facts.get("camera_path"):  # else its frames are of another camera's view
        _show_freeze(camera_of(camera), take_files.take_of(contract.ShotFolder(shot).takes / name))
    instant = facts.get("t_star_frame")
    if isinstance(instant, int):
        scene.frame_set(min(max(instant, scene.frame_start), scene.frame_end))
    _light(scene, shot)
    points = cameras.find(scene, shot, "MESH")
    if points is not None:
        points.hide_set(True)
    for screen in bpy.data.screens:
        for area in screen.areas:
            space: Any = area.spaces.active
            if area.type == "VIEW_3D" and space.region_3d is not None:
                space.region_3d.view_perspective = "CAMERA"


def _show_freeze(data: bpy.types.Camera, take: Take) -> None:
    """The take's frames behind the camera, in place of the plate, which stays there to be switched on."""
    path = numbered.frame_path(take.folder, take.first)
    image = sequences.load_sequence(path, f"Frozen {take.folder.name}", take.light)
    shown = next((b for b in data.background_images if b.image == image), None)
    background = shown or data.background_images.new()
    for other in data.background_images:
        if other != background and other.image is not None and other.image.get(TAG):
            other.show_background_image = False
    background.image = image
    sequences.show_sequence(background.image_user, image, take.first, take.last)
    background.frame_method, background.display_depth, background.alpha = "FIT", "BACK", 1.0
    if all(take.size):
        background.scale = max(1.0 + 2.0 * beyond / size for beyond, size in zip(take.margin, take.size))
    data.show_background_images = True


def _light(scene: bpy.types.Scene, shot: Path) -> None:
    """A sun, if the scene has no light."""
    if any(item.type == "LIGHT" for item in scene.objects):
        return
    name = f"{scene_objects.name_of(shot)} light"
    data: Any = bpy.data.lights.new(name, "SUN")
    data.energy = _STRENGTH
    light = bpy.data.objects.new(name, data)
    light.rotation_euler = _SUN
    scene.collection.objects.link(light)
