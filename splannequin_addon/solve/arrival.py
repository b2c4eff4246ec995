"""Changes to the scene after a solve."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ..footage import arrival, plate
from ..process import steps
from ..scene import rollback
from ..shot import inventory, scene_objects, selection
from . import cameras, motion_overlay, scale

if TYPE_CHECKING:
    import bpy


def load_camera(scene: bpy.types.Scene, shot: Path) -> list[str]:
    """Loads the solve into the scene. Raises FileNotFoundError without a solve."""
    state = inventory.read(shot)
    selection.see(scene, state)
    is_new = cameras.find(scene, shot, "EMPTY") is None
    entry, size = scene_objects.of(scene, shot), scene_objects.depth_scale(scene, shot)
    has_new_world = not is_new and entry is not None and entry.world != inventory.solve_world(shot)
    with rollback.scene_of(scene):
        motion_overlay.hide(scene, shot)  # it shows the previous mattes
        camera = cameras.build(scene, shot)
        notes = scale.guess_scale(scene, shot, is_new or has_new_world)
        if has_new_world and abs(scene_objects.depth_scale(scene, shot) / size - 1.0) > 1e-6:
            notes += [note for step in steps.STEPS.values() for note in step.scaled(scene, shot)]
        changes = arrival.fit(scene, state, force_k=True)
    plate.remove(scene, shot)
    return [f"{camera.name} is the scene's camera, with the plate behind it.", *notes, *changes]
