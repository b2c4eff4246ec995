"""What a finished solve changes in the scene."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ..footage import arrival, plate
from ..scene import rollback
from ..shot import inventory, selection
from . import cameras, motion_overlay, scale

if TYPE_CHECKING:
    import bpy


def load_camera(scene: bpy.types.Scene, shot: Path) -> list[str]:
    """Brings the solve into the scene. FileNotFoundError if there is none."""
    state = inventory.read(shot)
    selection.see(scene, state)
    is_new = cameras.find(scene, shot, "EMPTY") is None
    with rollback.scene_of(scene):
        motion_overlay.hide(scene, shot)  # it is of the mattes of before
        camera = cameras.build(scene, shot)
        notes = scale.guess_scale(scene, shot, is_new)
        changes = arrival.fit(scene, state, force_k=True)
    plate.remove(scene, shot)
    return [f"{camera.name} is the scene's camera, with the plate behind it.", *notes, *changes]
