"""The Solve step: its backend request, the changes when it ends, and its texts on the panel."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from ..footage import plate
from ..process import begin, job_timer, jobs
from ..process.steps import Step, View
from ..scene import session
from ..shot import scene_objects, selection
from ..shot.shot_state import ShotState
from . import (
    align_operators,
    arrival,
    cameras,
    drawn_masks,
    exchange,
    guesses,
    masks,
    matte_operators,
    mattes,
    operators,
    panel,
    points,
)


class Solve(Step):
    """Finds the camera's motion, and what moves in the clip."""

    name = "solve"
    label = "Solve"
    kind = "solve"
    button = "Solve Camera"
    again = "Solve Again"
    needs = "Import the clip first."
    panel = panel.PANEL
    classes = (
        *operators.CLASSES,
        *align_operators.CLASSES,
        *matte_operators.CLASSES,
    )
    parts = (points, align_operators, operators, mattes)

    def params(self, scene: bpy.types.Scene) -> contract.SolveParams:
        """Solve parameters: the lens, the source of the cameras, and the masks."""
        return masks.params(scene)

    def in_turns(self, scene: bpy.types.Scene, shot: Path) -> Iterator[Any] | None:
        """Work before the solve: renders drawn masks and reads cameras. None if there are none that Blender must
        process."""
        has_work = masks.drawn(scene) or exchange.reads_in_turns(scene)
        return solve_in_turns(scene.session_uid, shot) if has_work else None

    def view(self, scene: bpy.types.Scene, state: ShotState | None) -> View:
        """Panel state of Solve: the quality of the solve."""
        if state is None or not state.frames:
            return View(False, False, [], self.needs)
        if not state.solve:
            return View(False, True, [], "Find where the camera was on every frame.")
        result = state.solve.get("result", state.solve)
        lines = [line for line in (result.get("quality"), guesses.sentence(result)) if line]
        word = str(result.get("quality") or "").partition(":")[0]
        brief = word if word.lower() in contract.VERDICT_WORDS else ""
        if state.lacks_motion:
            lines.append("What moves is not known yet. Training will detect it first.")
        if cameras.find(scene, state.folder, "CAMERA") is None:
            return View(
                True, True, lines, "The solve is not in this scene. Load the camera.", brief, is_unfinished=True
            )
        return View(True, True, lines, "", brief)

    def is_usable(self, job: jobs.Job) -> bool:
        """True as soon as the cameras are written, while the search for motion continues."""
        return job.cameras_known

    def finish(self, scene: bpy.types.Scene, job: jobs.Job) -> list[str]:
        """Loads camera, plate and points into the scene."""
        return arrival.load_camera(scene, job.shot)

    def look(self, window: bpy.types.Window, scene: bpy.types.Scene, shot: Path) -> None:
        """Looks through the solved camera."""
        job_timer.look_through_camera(window)

    def logs(self, job: jobs.Job) -> list[Path]:
        """The job's log, and COLMAP's log."""
        return [*super().logs(job), contract.ShotFolder(job.shot).colmap_log]

    def is_present(self, scene: bpy.types.Scene, shot: Path) -> bool:
        """True if the scene has an entry for the shot's objects."""
        return scene_objects.of(scene, shot) is not None

    def remove(self, scene: bpy.types.Scene, shot: Path, remaining: list[Path]) -> list[str]:
        """Removes camera, points and plate from the file."""
        plate.remove(scene, shot)
        return ["Camera and points were removed."] if cameras.remove(scene, shot) else []


def solve_in_turns(scene_uid: int, shot: Path) -> Iterator[job_timer.Progress | None]:
    """Renders the drawn masks of a scene and reads its cameras, one frame per step, then starts its solve."""
    chosen = _chosen(scene_uid)
    scene = session.scene_of(scene_uid)
    if scene is not None and exchange.reads_in_turns(scene):
        reading = exchange.read_in_turns(scene, shot)
        del scene
        yield from reading
    for kind, (mask_uid, name) in chosen.items():
        now = None
        with contextlib.closing(drawn_masks.in_turns(mask_uid, name, shot, kind)) as turns:
            while True:
                while bpy.app.is_job_running("RENDER"):  # wait for the artist's render: Blender runs one at a time
                    yield now
                progress = next(turns, None)
                if progress is None:
                    break
                now = job_timer.Progress(f"Rendering the mask {name}, frame {progress[0]} of {progress[1]}", *progress)
                yield now
    scene = session.scene_of(scene_uid)
    if scene is None:
        return
    if selection.shot_folder(scene) != shot:
        raise contract.JobError(
            "Another shot was chosen while this one was being prepared.", "Choose this shot and solve again."
        )
    job_timer.follow("solve", begin.begin(scene, "solve", masks.params(scene, rendered=True)))


def _chosen(scene_uid: int) -> dict[str, tuple[int, str]]:
    """Kind of mask -> (`session_uid`, name) from `masks.drawn` of a scene. Raises errors of `masks.params` before any
    render."""
    scene = session.scene_of(scene_uid)
    if scene is None:
        return {}
    masks.params(scene, rendered=True)
    return {kind: (mask.session_uid, mask.name) for kind, mask in masks.drawn(scene).items()}


STEP = Solve()
