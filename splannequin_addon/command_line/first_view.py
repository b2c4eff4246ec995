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
from ..bake import take_files
from ..freeze import shown_frames
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
    """A sun, if the scene has no light."""
    if any(item.type == "LIGHT" for item in scene.objects):
        return
    name = f"{scene_objects.name_of(shot)} light"
    data: Any = bpy.data.lights.new(name, "SUN")
    data.energy = _STRENGTH
    light = bpy.data.objects.new(name, data)
    light.rotation_euler = _SUN
    scene.collection.objects.link(light)
