"""The step Solve: what it asks the backend for, what its end changes, and what the panel says of it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ...torch_backend import contract
from ..footage import plate
from ..process import job_timer, jobs
from ..process.steps import Step, View
from ..shot import scene_objects
from ..shot.shot_state import ShotState
from . import (
    align_operators,
    arrival,
    cameras,
    guesses,
    masks,
    matte_operators,
    mattes,
    operators,
    panel,
    points,
)

if TYPE_CHECKING:
    import bpy


class Solve(Step):
    """Where the camera was, and what moves."""

    name = "solve"
    label = "Solve"
    kind = "solve"
    button = "Solve Camera"
    again = "Solve Again"
    needs = "Import the clip first."
    classes = (
        *operators.CLASSES,
        *align_operators.CLASSES,
        *matte_operators.CLASSES,
        *panel.CLASSES,
    )
    parts = (points, align_operators, operators, mattes)

    def params(self, scene: bpy.types.Scene) -> contract.SolveParams:
        """The lens, where cameras come from, and what is masked."""
        return masks.params(scene)

    def view(self, scene: bpy.types.Scene, state: ShotState | None) -> View:
        """Camera: how good the solve is."""
        if state is None or not state.frames:
            return View(False, False, [], self.needs)
        if not state.solve:
            return View(False, True, [], "Find where the camera was on every frame.")
        told = state.solve.get("result", state.solve)
        lines = [line for line in (told.get("quality"), guesses.told(told)) if line]
        if cameras.find(scene, state.folder, "CAMERA") is None:
            return View(True, True, lines, "The solve is not in this scene: load it.")
        return View(True, True, lines, "Look through the camera, then train.")

    def finish(self, scene: bpy.types.Scene, job: jobs.Job) -> list[str]:
        """Camera, plate and points come into the scene."""
        return arrival.load_camera(scene, job.shot)

    def look(self, window: bpy.types.Window, scene: bpy.types.Scene, shot: Path) -> None:
        """Through the solved camera."""
        job_timer.look_through_camera(window)

    def logs(self, job: jobs.Job) -> list[Path]:
        """The job's own log, and what COLMAP said."""
        return [*super().logs(job), contract.ShotFolder(job.shot).colmap_log]

    def stands(self, scene: bpy.types.Scene, shot: Path) -> bool:
        """True if camera, points or plate of a shot are in the scene."""
        return scene_objects.of(scene, shot) is not None

    def remove(self, scene: bpy.types.Scene, shot: Path, others: list[Path]) -> list[str]:
        """Takes camera, points and plate out of the file."""
        plate.remove(scene, shot)
        return ["Camera and points were removed."] if cameras.remove(scene, shot) else []


STEP = Solve()
