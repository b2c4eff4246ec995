"""Sets up how a window shows a shot.blend that was created without a window.

The 3D viewport looks through the solved camera at t*, with the freeze as its background image and a light for added
objects. The solve's points are hidden, because they would cover the image. Applies only to scenes that this add-on
created, never to an artist's file.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from ..bake import take_files
from ..freeze import shown_frames
from ..shot import inventory, scene_objects
from ..solve import cameras

# Rotation of the light: from above, behind and to one side of a camera that looks along y.
_SUN = (math.radians(50.0), 0.0, math.radians(-40.0))
# Strength of the light in W/m2: a white surface facing it renders as about white.
_STRENGTH = 3.0


def set_up(scene: bpy.types.Scene, shot: Path, name: str) -> None:
    """Prepares a new scene, whose compositor shows the take `name`, to be saved and opened in a window."""
    camera = cameras.find(scene, shot, "CAMERA")
    if camera is None:
        return
    facts = inventory.read(shot).takes.get(name, {})
    if not facts.get("camera_path"):  # otherwise the frames have another camera's view
        take = take_files.take_of(contract.ShotFolder(shot).takes / name)
        shown_frames.show(scene, shot, name, take.first, take.last)
    instant = facts.get("t_star_frame")
    if isinstance(instant, int):
        scene.frame_set(min(max(instant, scene.frame_start), scene.frame_end))
    _light(scene, shot)
    for screen in bpy.data.screens:
        for area in screen.areas:
            space: Any = area.spaces.active
            if area.type == "VIEW_3D" and space.region_3d is not None:
                space.region_3d.view_perspective = "CAMERA"


def _light(scene: bpy.types.Scene, shot: Path) -> None:
    """Adds a sun if the scene has no light."""
    if any(item.type == "LIGHT" for item in scene.objects):
        return
    name = f"{scene_objects.name_of(shot)} light"
    data: Any = bpy.data.lights.new(name, "SUN")
    data.energy = _STRENGTH
    light = bpy.data.objects.new(name, data)
    light.rotation_euler = _SUN
    scene.collection.objects.link(light)
