"""The Freeze step: its backend request, the changes when it ends, and its texts on the panel."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...torch_backend import contract
from ..access import settings_of
from ..process import job_timer, jobs
from ..process.steps import Step, View
from ..shot import scene_objects
from ..shot.shot_state import ShotState
from . import (
    hidden_points,
    light_operators,
    lights,
    matte_operators,
    mattes,
    move_check,
    move_operators,
    operators,
    own_camera,
    panel,
    shown_frames,
    splats,
    surface_operators,
    surfaces,
    takes,
    viewport,
)

if TYPE_CHECKING:
    import bpy


class Freeze(Step):
    """The frozen instant, as frames of a take."""

    name = "freeze"
    label = "Freeze"
    kind = "freeze"
    also = ("mattes", "combine", "surface", "light")
    button = "Freeze"
    again = "Freeze Again"
    needs = "Train first."
    panel = panel.PANEL
    classes = (
        *operators.CLASSES,
        *matte_operators.CLASSES,
        *move_operators.CLASSES,
        *move_check.CLASSES,
        *surface_operators.CLASSES,
        *light_operators.CLASSES,
    )
    parts = (viewport, hidden_points)

    def params(self, scene: bpy.types.Scene) -> contract.FreezeParams:
        """Freeze parameters from the scene's settings."""
        return takes.params_of(scene)

    def view(self, scene: bpy.types.Scene, state: ShotState | None) -> View:
        """Panel state of Freeze: facts about the selected take."""
        if state is None or settings_of(scene).run_name not in state.runs:
            return View(False, False, [], self.needs)
        take = state.takes.get(settings_of(scene).take_name)
        if take is None:
            if own_camera.name_of(scene):
                return View(False, True, [], "Render your camera move with time standing still.")
            return View(False, True, [], "Render the clip's move with time standing still.")
        outdated, lines = takes.outdated(scene, take), _lines(state, take)
        if outdated:
            return View(False, True, [outdated, *lines], "Freeze again to update the take.")
        verdict = contract.verdict_of(take)
        brief = verdict.word.capitalize() if verdict is not None else ""
        return View(True, True, lines, "", brief)

    def finish(self, scene: bpy.types.Scene, job: jobs.Job) -> list[str]:
        """Applies the result of a job of this step to a scene.

        A freeze sets t* if the artist has not set it, and shows its frames. Mattes are reloaded. A surface is added to
        every scene with the shot, a light only to the scene that requested it. A combined take is selected.
        """
        if job.kind == "mattes":
            return mattes.arrived(job.shot, job.result)
        if job.kind == "surface":
            has_root = scene_objects.part(scene, job.shot, "root") is not None
            return surfaces.add(scene, job.shot, str(job.result["take"])) if has_root else []
        if job.kind == "light":
            has_root = scene_objects.part(scene, job.shot, "root") is not None
            if not has_root or job.scene_uid not in (0, scene.session_uid):
                return []
            return lights.add(scene, job.shot, str(job.result["take"]), str(job.result["key"]))
        if job.kind == "combine":
            settings_of(scene).take_name = str(job.result["take"])
            return [f"The take {job.result['take']} is chosen: {job.result['frames']} frames."]
        if not settings_of(scene).choose_t_star:
            settings_of(scene).t_star = int(job.result["t_star_frame"])
        if job.result.get("camera_path"):  # the frames have another camera's view
            return []
        return shown_frames.show(
            scene, job.shot, str(job.result["take"]), int(job.result["first"]), int(job.result["last"])
        )

    def arrive(self, scene: bpy.types.Scene, job: jobs.Job) -> bool:
        """Loads a surface in steps run by the timer."""
        if job.kind != "surface" or scene_objects.part(scene, job.shot, "root") is None:
            return False
        take = str(job.result["take"])
        job_timer.work(job.shot, self.name, surfaces.added_in_turns(scene.session_uid, job.shot, take))
        return True

    def remove(self, scene: bpy.types.Scene, shot: Path, remaining: list[Path]) -> list[str]:
        """Removes splats, surfaces and the light from the file."""
        done = ["Splats were removed."] if splats.remove(scene, shot) else []
        done += ["Surfaces were removed."] if surfaces.remove(scene, shot) else []
        return [*done, "The light was removed."] if lights.remove(scene, shot) else done

    def in_use(self, shot: Path, folder: Path) -> str:
        """The reason why a run cannot be deleted: it is being scrubbed. Empty if it is not."""
        session = viewport.session()
        if session is not None and folder == contract.ShotFolder(shot).runs / session.run and session.shot == shot:
            return "You are scrubbing through this run. Stop scrubbing first."
        return ""


def _lines(state: ShotState, take: dict[str, Any]) -> list[str]:
    """Sentences about a take: its instant and the first line of its verdict, then the rest."""
    frames = f"Take {take['take']}: {take['frame_count']} frames, {take['width']} x {take['height']}"
    instant = f"Time stands still at frame {take['t_star_frame']}"
    if take["t_star_per_frame"]:
        instant = "Time follows the keyframes of t*"
    across, down = take.get("margin", (0, 0))
    beyond = [f"Overscan: {across} pixels on each side, {down} above and below"] if across or down else []
    verdict = _new_verdict_lines(state, take)
    return [instant, *verdict[:1], frames, *beyond, *verdict[1:]]


def _new_verdict_lines(state: ShotState, take: dict[str, Any]) -> list[str]:
    """Lines of a take's verdict that Train does not show already, because a take repeats the problems of its run."""
    run = contract.verdict_of(state.runs.get(take["run"], {}))
    sentences = [*run.sentences, *run.advice] if run is not None else []
    return [line for line in contract.verdict_lines(take) if line not in sentences]


STEP = Freeze()
