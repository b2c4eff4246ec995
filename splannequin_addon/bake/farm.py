"""Export for Farm: the shot and what the artist set, handed to the backend, which writes the job."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from ..access import Outcome, scene_in, settings_of
from ..freeze import own_camera, takes
from ..process import backend, children, job_timer, steps
from ..properties import BoolProperty, IntProperty, StringProperty
from ..shot import inventory, selection
from ..translations import tr

REQUEST = "request.json"
"""Parameters of the steps, in the job's folder."""


@dataclass(frozen=True)
class Words:
    """What a job for a farm is asked for, besides the parameters of its steps; as `contract.verbs.FarmWords`."""

    action: str = "export"
    """export or measure."""
    t_star: str = ""
    """Instants with commas; empty: the scene's."""
    t_star_list: str = ""
    """File with instants of each shot; empty: none."""
    frames: int = 10
    """Frames of a task."""
    bake: bool = False
    """Takes go through Blender, too."""
    shots_folder: str = ""
    """Where shots of clips are made; empty: beside each."""
    shots_per_job: int = 0
    """Shots of one template; 0: the backend's own number."""
    rates: str = ""
    """Rates to estimate with; empty: the backend's own."""


def begin(shots: Sequence[str], output: Path, words: Words, requests: dict[str, Any]) -> children.Question:
    """Has the backend write a job, without waiting.

    Args:
        shots: shot folders and clips.
        output: folder for the job.
        words: what it is asked for.
        requests: step -> its parameters, those of `contract.PARAMS` or dicts of some of them; written into `output`.

    Raises:
        contract.JobError: there is no backend, or it cannot be started; OSError: the folder cannot be written.
    """
    backend.python()  # before anything is written
    said = ["farm", words.action, *shots, "--output", str(output)]
    if words.action == "export":
        told = {
            kind: params if isinstance(params, dict) else dataclasses.asdict(params)
            for kind, params in requests.items()
        }
        contract.write_json(output / REQUEST, told)
        said += ["--request", str(output / REQUEST), "--frames", str(words.frames)]
        if told.get("freeze", {}).get("device"):
            said += ["--device", told["freeze"]["device"]]
        if words.shots_per_job:
            said += ["--shots-per-job", str(words.shots_per_job)]
        for flag, value in (
            ("--t-star", words.t_star),
            ("--t-star-list", words.t_star_list),
            ("--shots-folder", words.shots_folder),
            ("--rates", words.rates),
        ):
            said += [f"{flag}={value}"] if value else []
        said += ["--bake"] if words.bake else []
    return backend.ask(*said)


def written(asked: children.Question) -> list[str]:
    """What the backend says of the job that it wrote, line by line. JobError with its own sentence if it failed."""
    return [line.rstrip() for line in asked.answer("{}").splitlines() if line.strip()]


def requests_of(scene: bpy.types.Scene, shot: Path) -> dict[str, Any]:
    """Step -> parameters of what is to be done for the scene's shot: the freeze, and what it lacks before it.

    The artist's camera is read, if the take is seen from one.
    """
    state = inventory.read(shot)
    found: dict[str, Any] = {}
    if not state.solve:
        found["solve"] = steps.STEPS["solve"].params(scene)
    if settings_of(scene).run_name not in state.runs:
        found["train"] = steps.STEPS["train"].params(scene)
    camera = takes.read_camera(scene, "freeze") if own_camera.follows_camera(scene) else None
    found["freeze"] = camera or steps.STEPS["freeze"].params(scene)
    return found


class SPLANNEQUIN_OT_export_for_farm(bpy.types.Operator):
    """Write this shot as a job for a render farm, as Open Job Description: what it lacks, the take in parts, and what
    that will cost"""

    bl_idname = "splannequin.export_for_farm"
    bl_label = "Export for Farm"
    bl_options = {"REGISTER"}

    directory = StringProperty(
        name="Folder", description="Folder to write the job into", subtype="DIR_PATH", options={"SKIP_SAVE"}
    )
    filter_folder = BoolProperty(
        name="Folders", description="Show folders", default=True, options={"HIDDEN", "SKIP_SAVE"}
    )
    instants = StringProperty(
        name="Instants", description="Frames at which time stands still, with commas, a take for each; empty: t*"
    )
    frames = IntProperty(
        name="Frames per Task", description="Frames of the take that one task freezes", default=10, min=1, max=100_000
    )
    bake = BoolProperty(
        name="Bake", description="Render the take through Blender's compositor on the farm, too", default=False
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Off without a shot."""
        folder = selection.shot_folder(scene_in(context))
        if folder is None or not inventory.read(folder).info:
            cls.poll_message_set(tr("Import a clip first"))
            return False
        return True

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> Outcome:
        """Asks for a folder."""
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Has the backend write; in a window the panel tells when it is done."""
        scene = scene_in(context)
        shot = selection.shot_folder(scene)
        if shot is None or not self.directory:
            self.report({"ERROR"}, "No folder was given")
            return {"CANCELLED"}
        folder = Path(os.path.abspath(bpy.path.abspath(self.directory)))
        words = Words(t_star=self.instants, frames=self.frames, bake=self.bake)
        try:
            asked = begin([str(shot)], folder, words, requests_of(scene, shot))
            if bpy.app.background:
                for line in written(asked):
                    self.report({"INFO"}, line)
                return {"FINISHED"}
        except (contract.JobError, OSError, ValueError) as error:
            sentence = f"{getattr(error, 'message', error)} {getattr(error, 'hint', '')}".strip()
            self.report({"ERROR"}, tr(sentence))
            return {"CANCELLED"}
        job_timer.watch_of(shot).failures.pop("bake", None)
        job_timer.when_answered(asked, lambda: _tell(shot, asked))
        return {"FINISHED"}


def _tell(shot: Path, asked: children.Question) -> None:
    """Puts what came of an export onto the panel."""
    watch = job_timer.watch_of(shot)
    try:
        watch.notes["bake"] = written(asked)
    except contract.JobError as error:
        watch.failures["bake"] = (error.message, error.hint)


CLASSES = (SPLANNEQUIN_OT_export_for_farm,)
