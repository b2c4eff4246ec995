"""Plumbing of running jobs: cancel, see the log."""

from __future__ import annotations

import stat
from pathlib import Path
from typing import Any

import bpy
from bpy.props import StringProperty

from ...torch_backend import contract
from ..process import jobs, supervisor
from ..shot import chosen
from ..translations import tr


class SPLANNEQUIN_OT_cancel(bpy.types.Operator):
    """Stop this step. It saves what it has first, so that it can go on later; pressed again after 20 seconds, it is
    ended by force"""

    bl_idname = "splannequin.cancel"
    bl_label = "Cancel Step"
    bl_options = {"REGISTER"}

    step: StringProperty(
        name="Step", description="Name of the step to cancel; empty: the one that runs", options={"SKIP_SAVE"}
    )

    def execute(self, context: Any) -> set[str]:
        """Asks the job to stop."""
        folder = chosen.shot_folder(context.scene)
        watch = supervisor.watch_of(folder) if folder else None
        job = watch.jobs.get(self.step or watch.running() or "") if watch else None
        if job is None or job.ended:
            self.report({"WARNING"}, "Nothing is running")
            return {"CANCELLED"}
        try:
            jobs.cancel(job)
        except (contract.JobError, OSError) as error:
            self.report({"ERROR"}, tr(f"{getattr(error, 'message', error)} {getattr(error, 'hint', '')}".strip()))
            return {"CANCELLED"}
        return {"FINISHED"}


class SPLANNEQUIN_OT_open_log(bpy.types.Operator):
    """Open the log of this step in the system's viewer"""

    bl_idname = "splannequin.open_log"
    bl_label = "Open Log"
    bl_options = {"INTERNAL"}

    step: StringProperty(name="Step", description="Name of the step", options={"SKIP_SAVE"})

    def execute(self, context: Any) -> set[str]:
        """Opens it."""
        folder = chosen.shot_folder(context.scene)
        log = log_of(supervisor.watch_of(folder), self.step) if folder else None
        if log is None:
            self.report({"WARNING"}, "There is no log")
            return {"CANCELLED"}
        bpy.ops.wm.path_open(filepath=str(log))
        return {"FINISHED"}


def log_of(watch: supervisor.Watch, step: str) -> Path | None:
    """The log of a step's newest job that has something in it: the job's own, else what COLMAP said; None without."""
    job = watch.jobs.get(step)
    if job is None:
        return None
    logs = [job.folder / contract.LOG_FILE, *([contract.ShotFolder(watch.shot).colmap_log] if step == "camera" else [])]
    return next((log for log in logs if _written(log)), None)


def _written(log: Path) -> bool:
    try:
        return stat.S_ISREG(log.stat().st_mode) and log.stat().st_size > 0
    except OSError:
        return False


CLASSES = (SPLANNEQUIN_OT_cancel, SPLANNEQUIN_OT_open_log)
