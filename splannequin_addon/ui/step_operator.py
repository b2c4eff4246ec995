"""Base class of the steps' operators, and `edit` for operators that change the scene.

Without a window, `execute` blocks until the work is done. In a window, the timer monitors the work.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import bpy

from ...torch_backend import contract
from ..access import OperatorBase, Outcome, scene_in
from ..process import begin, job_timer, jobs, steps
from ..shot import selection
from ..translations import tr


class StepOperator(OperatorBase):
    """Base class of the steps' operators: starts the job, then waits for it or lets the timer monitor it."""

    step = ""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Disabled while a step of this shot runs."""
        folder = selection.shot_folder(scene_in(context))
        if folder is not None and job_timer.watch_of(folder).running():
            cls.poll_message_set(tr("A step of this shot is running"))
            return False
        return True

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Runs the step; reports an error."""
        try:
            return self.perform(context)
        except contract.Cancelled:
            self.report({"WARNING"}, "Cancelled: finished work is kept")
        except (contract.JobError, ValueError, OSError, RuntimeError, KeyError) as error:
            folder = selection.shot_folder(scene_in(context))
            sentence = getattr(error, "message", str(error))
            if folder is not None:
                job_timer.watch_of(folder).fail(self.step, error)
            self.report({"ERROR"}, tr(f"{sentence} {getattr(error, 'hint', '')}".strip()))
        return {"CANCELLED"}

    def perform(self, context: bpy.types.Context) -> Outcome:
        """Starts the job. Without a window, waits for it. `execute` reports exceptions."""
        scene = scene_in(context)
        job = begin.begin(scene, self.step, self.params(scene))
        job_timer.follow(self.step, job)
        if not bpy.app.background:
            return {"FINISHED"}
        begin.wait(job)
        for note in self.after(scene, job):
            self.report({"INFO"}, tr(note))
        return {"FINISHED"}

    def params(self, scene: bpy.types.Scene) -> jobs.Params | None:
        """Parameters of the job; None to use the scene's settings."""
        return None

    def after(self, scene: bpy.types.Scene, job: jobs.Job) -> list[str]:
        """Work after the job in blocking mode. Returns the changes as sentences."""
        return steps.STEPS[self.step].finish(scene, job)


def edit(
    operator: bpy.types.Operator,
    context: bpy.types.Context,
    step: str,
    change: Callable[[bpy.types.Scene, Path], list[str]],
) -> Outcome:
    """Runs a change of the scene. Reports the changes or the error."""
    folder = selection.shot_folder(scene_in(context))
    if folder is None:
        operator.report({"ERROR"}, "No shot is chosen: import a clip first")
        return {"CANCELLED"}
    try:
        notes = change(scene_in(context), folder)
    except (contract.JobError, OSError, ValueError, RuntimeError, KeyError) as error:
        operator.report({"ERROR"}, tr(f"{getattr(error, 'message', error)} {getattr(error, 'hint', '')}".strip()))
        return {"CANCELLED"}
    job_timer.watch_of(folder).notes[step] = notes
    job_timer.redraw()
    for note in notes:
        operator.report({"INFO"}, tr(note))
    return {"FINISHED"}
