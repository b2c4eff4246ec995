"""The Import step: its backend request, the changes when it ends, and its texts on the panel."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING

from ...torch_backend import contract
from ..access import settings_of
from ..process import job_timer, jobs
from ..process.steps import Step, View
from ..scene import paths
from ..shot import selection
from ..shot.shot_state import ShotState
from . import arrival, operators, panel, plate

if TYPE_CHECKING:
    import bpy


class Import(Step):
    """Reads footage into a shot folder."""

    name = "import"
    label = "Import"
    kind = "import"
    button = "Import Clip"
    again = "Import Again"
    makes_shot = True
    panel = panel.PANEL
    classes = operators.CLASSES

    def params(self, scene: bpy.types.Scene) -> contract.ImportParams:
        """Import parameters for the chosen clip and range, or for the shot's clip if none is chosen. Raises JobError
        without a clip."""
        props = settings_of(scene)
        clip = paths.absolute(props.clip) if props.clip else _imported_from(scene)
        if not clip:
            raise contract.JobError("No clip is chosen.", "Choose a video or image sequence.", contract.ExitCode.USAGE)
        span = (props.first, props.last) if props.use_range else (None, None)
        params = contract.ImportParams(clip, *span, step=props.solve_step, fps=props.fps)
        params.start = props.start if props.use_start else None
        params.lut = paths.absolute(props.lut) if props.lut else ""
        params.colour_space, params.layer = props.colour_space.strip(), props.layer.strip()
        params.pixel_aspect, params.matrix, params.levels = round(props.pixel_aspect, 6), props.matrix, props.levels
        return params

    def view(self, scene: bpy.types.Scene, state: ShotState | None) -> View:
        """Panel state of Import: facts about the imported footage."""
        if state is None or not state.frames:
            chosen = bool(settings_of(scene).clip)
            return View(False, True, [], "Import the clip." if chosen else "Choose a clip of people holding still.")
        (width, height), (first, last) = state.size, state.frame_range
        lines = [
            f"{state.frames} frames, {first} to {last}",
            f"{width} x {height}, {state.info.get('fps', 0):g} fps",
            *state.read_as,
        ]
        timecode = state.timecode_at(scene.frame_current)
        if timecode:
            lines.append(f"Timecode {timecode} at frame {scene.frame_current}.")
        return View(True, True, lines, "", f"{state.frames} frames")

    def finish(self, scene: bpy.types.Scene, job: jobs.Job) -> list[str]:
        """Fits the scene to the clip and shows the clip behind a camera."""
        return arrival.imported(scene, job.shot)

    def ended(self, job: jobs.Job) -> None:
        """Deletes the empty shot folder of an import that failed or was cancelled."""
        if job.state != "done" and _discard(job):
            job_timer.call_until_false(functools.partial(_discard, job))

    def look(self, window: bpy.types.Window, scene: bpy.types.Scene, shot: Path) -> None:
        """Looks through the camera that shows the clip."""
        camera = plate.find(scene, shot)
        if camera is not None:
            job_timer.look_through_camera(window, camera)


def _discard(job: jobs.Job) -> bool:
    """Removes the remains of a failed import, unless another job is running in the shot.

    Returns True while the job's process is alive.
    """
    if any(watch.shot == job.shot and watch.running() for watch in job_timer.watches()):
        return False
    # A living process holds the shot's lock and, on Windows, its log file, which cannot be deleted.
    if job.process is not None and job.process.poll() is None:
        return True
    contract.discard_unborn(job.shot)
    return False


def _imported_from(scene: bpy.types.Scene) -> str:
    """The clip that the scene's shot was imported from, as the shot folder records it; empty without a shot."""
    folder = selection.shot_folder(scene)
    try:
        info = {} if folder is None else contract.read_json(contract.ShotFolder(folder).info_path)
        return str(info.get("source", ""))
    except (OSError, ValueError, contract.JobError):  # the import reports the error
        return ""


STEP = Import()
