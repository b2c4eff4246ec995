"""Operators for running jobs: cancel, run all steps, open the log."""

from __future__ import annotations

import shutil
import sys

import bpy

from ...torch_backend import contract
from ..access import Outcome, scene_in
from ..process import all_steps, job_timer, jobs, steps
from ..properties import StringProperty
from ..shot import selection
from ..translations import tr
from . import step_operator


class SPLANNEQUIN_OT_cancel(bpy.types.Operator):
    """Stop this step. It saves its progress first, so that it can continue later. Press again after 20 seconds to end
    it by force"""

    bl_idname = "splannequin.cancel"
    bl_label = "Cancel Step"
    bl_options = {"REGISTER"}

    step = StringProperty(
        name="Step", description="Name of the step to cancel; empty: the running step", options={"SKIP_SAVE"}
    )

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Asks the job to stop."""
        folder = selection.shot_folder(scene_in(context))
        watch = job_timer.watch_of(folder) if folder else None
        ended = folder is not None and all_steps.stop(folder)
        if watch and self.step in ("", watch.running()) and job_timer.stop_work(watch):
            job_timer.redraw()
            return {"FINISHED"}
        render = watch.work if watch is not None else None
        if watch is not None and render is not None and render.turns is None and not bpy.app.is_job_running("RENDER"):
            watch.work = None  # the render has ended without a handler call
            return {"FINISHED"}
        job = watch.jobs.get(self.step or watch.running() or "") if watch else None
        if job is None or job.ended:
            if ended:  # between two steps of a chain
                return {"FINISHED"}
            self.report({"WARNING"}, "Nothing is running")
            return {"CANCELLED"}
        try:
            jobs.cancel(job)
        except (contract.JobError, OSError) as error:
            self.report({"ERROR"}, tr(f"{getattr(error, 'message', error)} {getattr(error, 'hint', '')}".strip()))
            return {"CANCELLED"}
        return {"FINISHED"}


class SPLANNEQUIN_OT_all_steps(step_operator.StepOperator, bpy.types.Operator):
    """Solve the camera, train and freeze t*, one after the other, each with its own settings. Existing results are
    kept"""

    bl_idname = "splannequin.all_steps"
    bl_label = "Solve, Train and Freeze"
    bl_options = {"REGISTER"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Disabled before the import, while a step runs, and when all steps are done."""
        if not super().poll(context):
            return False
        if not all_steps.missing(scene_in(context)):
            cls.poll_message_set(tr("Nothing to do. Import a clip, or freeze again with the button below"))
            return False
        return True

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Starts the first missing step. Without a window, runs all missing steps."""
        scene = scene_in(context)
        folder = selection.shot_folder(scene)
        if folder is None:
            return {"CANCELLED"}
        all_steps.begin(scene, folder)
        failures = job_timer.watch_of(folder).failures
        for step in all_steps.BUTTONS:
            if step in failures:
                self.report({"ERROR"}, tr(" ".join(failures[step]).strip()))
                return {"CANCELLED"}
        return {"FINISHED"}


class SPLANNEQUIN_OT_open_log(bpy.types.Operator):
    """Open the log of this step in the system's viewer"""

    bl_idname = "splannequin.open_log"
    bl_label = "Open Log"
    bl_options = {"INTERNAL"}

    step = StringProperty(name="Step", description="Name of the step", options={"SKIP_SAVE"})

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Opens the log."""
        folder = selection.shot_folder(scene_in(context))
        job = job_timer.watch_of(folder).jobs.get(self.step) if folder else None
        log = steps.STEPS[self.step].log(job) if job is not None else None
        if log is None:
            self.report({"WARNING"}, "There is no log")
            return {"CANCELLED"}
        if sys.platform.startswith("linux") and shutil.which("xdg-open") is None:  # Blender would only print an error
            self.report({"WARNING"}, tr(f"No viewer was found (xdg-open is missing). The log is {log}"))
            return {"CANCELLED"}
        bpy.ops.wm.path_open(filepath=str(log))
        return {"FINISHED"}


CLASSES = (SPLANNEQUIN_OT_cancel, SPLANNEQUIN_OT_all_steps, SPLANNEQUIN_OT_open_log)
