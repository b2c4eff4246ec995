"""What picking and removing runs and takes of a shot share."""

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
    """The shot's watch and what its folder holds."""
    folder = selection.shot_folder(scene_in(context))
    watch = job_timer.watch_of(folder) if folder else None
    return watch, watch.state if watch else None


class Pick(OperatorBase):
    """What picking a run and picking a take share."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Off while a step of this shot runs: what it works on is named by the settings."""
        watch, state = known(context)
        if watch is None or state is None:
            cls.poll_message_set(tr("No shot is chosen: import a clip first"))
            return False
        if watch.running():
            cls.poll_message_set(tr("A step of this shot is running"))
            return False
        return True


class Remove(Pick):
    """What removing a run and removing a take share: a question, a refusal in words, the folder gone."""

    kind = ""
    question = ""
    warning = ""

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> Outcome:
        """Asks first: what is removed from disk does not come back with undo."""
        return context.window_manager.invoke_confirm(
            self, event, title=self.question, message=self.warning, confirm_text="Remove", icon="WARNING"
        )

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Removes the folder."""
        watch, state = known(context)
        name: str = self.name
        if watch is None or state is None:
            return {"CANCELLED"}
        # Only what is listed, whose names come from the folder itself: any other may lead to somewhere else.
        folder = watch.shot / f"{self.kind}s" / name
        exists = name in state.listed(self.kind)
        refusal = _in_use(watch.shot, folder) if exists else f"This shot has no {self.kind} {name!r}"
        if not refusal:
            try:
                jobs.refuse_second_writer(watch.shot)  # also one that was started from a command line
                listing.remove(watch.shot, folder, wait=bpy.app.background)
            except contract.JobError as error:
                refusal = f"{error.message} {error.hint}"
            except OSError as error:
                refusal = f"{folder} cannot be removed: {error.strerror or error}"
        if refusal:
            self.report({"ERROR"}, refusal)
            return {"CANCELLED"}
        job_timer.refresh(watch)
        job_timer.redraw()
        return {"FINISHED"}


def _in_use(shot: Path, folder: Path) -> str:
    """Why a run or take cannot be removed now, as any of the steps says; empty if it can."""
    return next(filter(None, (step.in_use(shot, folder) for step in steps.STEPS.values())), "")
