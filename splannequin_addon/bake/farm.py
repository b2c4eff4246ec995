"""Export for Farm: passes the shot and the artist's settings to the backend, which writes the job."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from ..access import Outcome, scene_in, settings_of
from ..freeze import own_camera, takes
from ..process import children, job_timer, steps
from ..properties import BoolProperty, IntProperty, StringProperty
from ..shot import inventory, selection
from ..translations import tr
from . import farm_job


def requests_of(scene: bpy.types.Scene, shot: Path) -> dict[str, Any]:
    """Step -> parameters of each step the scene's shot still needs: the freeze, and missing steps before it.

    Reads the artist's camera if the take uses one.
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
    """Write this shot as an Open Job Description for a render farm: the missing steps, the take in parts, and an
    estimate of the cost"""

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
        name="Instants",
        description="Frames at which time stands still, separated by commas, with one take each; empty: t*",
    )
    frames = IntProperty(
        name="Frames per Task", description="Number of frames that one task freezes", default=10, min=1, max=100_000
    )
    bake = BoolProperty(
        name="Bake", description="Also render the take through Blender's compositor on the farm", default=False
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Disabled without a shot."""
        folder = selection.shot_folder(scene_in(context))
        watch = job_timer.watch_of(folder) if folder is not None else None
        if watch is not None and bpy.app.background:
            job_timer.refresh(watch)  # no timer runs in background mode
        if watch is None or watch.state is None or not watch.state.info:
            cls.poll_message_set(tr("Import a clip first"))
            return False
        return True

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> Outcome:
        """Asks for a folder."""
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Starts the export in the backend. With a window, the panel reports when it is done."""
        scene = scene_in(context)
        shot = selection.shot_folder(scene)
        if shot is None or not self.directory:
            self.report({"ERROR"}, "No folder is chosen")
            return {"CANCELLED"}
        folder = Path(os.path.abspath(bpy.path.abspath(self.directory)))
        words = contract.FarmWords(
            shots=(str(shot),), output=str(folder), t_star=self.instants, frames=self.frames, bake=self.bake
        )
        try:
            question = farm_job.begin(words, requests_of(scene, shot))
            if bpy.app.background:
                for line in farm_job.written(question):
                    self.report({"INFO"}, tr(line))
                return {"FINISHED"}
        except (contract.JobError, OSError, ValueError) as error:
            sentence = f"{getattr(error, 'message', error)} {getattr(error, 'hint', '')}".strip()
            self.report({"ERROR"}, tr(sentence))
            return {"CANCELLED"}
        job_timer.watch_of(shot).failures.pop("bake", None)
        job_timer.when_answered(question, lambda: _tell(shot, question))
        return {"FINISHED"}


def _tell(shot: Path, question: children.Question) -> None:
    """Shows the result of an export on the panel."""
    watch = job_timer.watch_of(shot)
    try:
        watch.notes["bake"] = farm_job.written(question)
    except contract.JobError as error:
        watch.failures["bake"] = (error.message, error.hint)


CLASSES = (SPLANNEQUIN_OT_export_for_farm,)
