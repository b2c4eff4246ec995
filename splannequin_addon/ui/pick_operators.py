"""Base classes of operators that select and remove runs and takes of a shot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from ..access import OperatorBase, Outcome, scene_in
from ..process import job_timer, jobs, steps
from ..shot import selection
from ..translations import tr
from . import listing


def known(context: bpy.types.Context) -> tuple[job_timer.Watch | None, Any]:
    """(the shot's watch, content of its folder)."""
    folder = selection.shot_folder(scene_in(context))
    watch = job_timer.watch_of(folder) if folder else None
    return watch, watch.state if watch else None


class Pick(OperatorBase):
    """Base class of the operators that select a run or a take."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Disabled while a step of this shot runs."""
        watch, state = known(context)
        if watch is None or state is None:
            cls.poll_message_set(tr("No shot is chosen: import a clip first"))
            return False
        if watch.running():  # the step uses the names in the settings
            cls.poll_message_set(tr("A step of this shot is running"))
            return False
        return True


class Remove(Pick):
    """Base class of the operators that remove a run or a take: asks for confirmation and deletes its folder."""

    kind = ""
    question = ""
    warning = ""

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> Outcome:
        """Asks for confirmation."""
        # Undo does not restore deleted files.
        return context.window_manager.invoke_confirm(
            self, event, title=self.question, message=self.warning, confirm_text="Remove", icon="WARNING"
        )

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Removes the folder."""
        watch, state = known(context)
        name: str = self.name
        if watch is None or state is None:
            return {"CANCELLED"}
        # Accept only listed names, which come from the folder. Any other name could lead to another location.
        folder = watch.shot / f"{self.kind}s" / name
        exists = name in state.listed(self.kind)
        refusal = _in_use(watch.shot, folder) if exists else f"This shot has no {self.kind} {name!r}"
        if not refusal:
            try:
                jobs.refuse_second_writer(watch.shot)  # includes writers started from a command line
                listing.remove(watch.shot, folder, wait=bpy.app.background)
            except contract.JobError as error:
                refusal = f"{error.message} {error.hint}"
            except OSError as error:
                refusal = f"{folder} cannot be removed: {error.strerror or error}"
        if refusal:
            self.report({"ERROR"}, tr(refusal))
            return {"CANCELLED"}
        job_timer.refresh(watch)
        job_timer.redraw()
        return {"FINISHED"}


def _in_use(shot: Path, folder: Path) -> str:
    """The reason why a run or take cannot be removed now, from any step; empty if it can."""
    return next(filter(None, (step.in_use(shot, folder) for step in steps.STEPS.values())), "")
