"""Runs and takes of a shot: pick one, remove one."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import bpy
from bpy.props import StringProperty

from ...torch_backend import contract
from ..freeze import viewport
from ..process import jobs, supervisor
from ..settings import PRESETS
from ..shot import chosen
from ..translations import tr
from . import listing


def _known(context: Any) -> tuple[supervisor.Watch | None, Any]:
    """The shot's watch and what its folder holds."""
    folder = chosen.shot_folder(context.scene)
    watch = supervisor.watch_of(folder) if folder else None
    return watch, watch.state if watch else None


class _Pick:
    """What picking a run and picking a take share."""

    @classmethod
    def poll(cls, context: Any) -> bool:
        """Off while a step of this shot runs: what it works on is named by the settings."""
        watch, state = _known(context)
        if watch is None or state is None:
            cls.poll_message_set(tr("No shot is chosen: import a clip first"))  # type: ignore[attr-defined]
            return False
        if watch.running():
            cls.poll_message_set(tr("A step of this shot is running"))  # type: ignore[attr-defined]
            return False
        return True


class SPLANNEQUIN_OT_pick_run(_Pick, bpy.types.Operator):
    """Work with this run: it is shown, frozen from, and trained on"""

    bl_idname = "splannequin.pick_run"
    bl_label = "Pick Run"
    bl_options = {"REGISTER", "UNDO"}

    name: StringProperty(name="Run", description="Name of the run", options={"SKIP_SAVE"})

    def execute(self, context: Any) -> set[str]:
        """Sets the run's name, and the preset that it was trained with."""
        state = _known(context)[1]
        run = state.runs.get(self.name) or state.unfinished.get(self.name)
        if run is None:
            refusal = state.damaged["run"].get(self.name) or f"This shot has no run {self.name!r}"
            self.report({"ERROR"}, tr(refusal))
            return {"CANCELLED"}
        settings = context.scene.splannequin
        settings.run_name = self.name
        if run.get("preset") in [preset[0] for preset in PRESETS]:
            settings.preset = run["preset"]
        return {"FINISHED"}


class SPLANNEQUIN_OT_pick_take(_Pick, bpy.types.Operator):
    """Work with this take: it is shown, and baked next"""

    bl_idname = "splannequin.pick_take"
    bl_label = "Pick Take"
    bl_options = {"REGISTER", "UNDO"}

    name: StringProperty(name="Take", description="Name of the take", options={"SKIP_SAVE"})

    def execute(self, context: Any) -> set[str]:
        """Sets the take's name."""
        state = _known(context)[1]
        if self.name not in state.takes:
            refusal = state.damaged["take"].get(self.name) or f"This shot has no take {self.name!r}"
            self.report({"ERROR"}, tr(refusal))
            return {"CANCELLED"}
        context.scene.splannequin.take_name = self.name
        return {"FINISHED"}


class _Remove(_Pick):
    """What removing a run and removing a take share: a question, a refusal in words, the folder gone."""

    kind = ""
    question = ""
    warning = ""

    def invoke(self, context: Any, event: Any) -> set[str]:
        """Asks first: what is removed from disk does not come back with undo."""
        return context.window_manager.invoke_confirm(
            self, event, title=self.question, message=self.warning, confirm_text="Remove", icon="WARNING"
        )

    def execute(self, context: Any) -> set[str]:
        """Removes the folder."""
        watch, state = _known(context)
        name: str = self.name  # type: ignore[attr-defined]
        if watch is None or state is None:
            return {"CANCELLED"}
        # Only what is listed, whose names come from the folder itself: any other may lead to somewhere else.
        folder = watch.shot / f"{self.kind}s" / name
        there = name in state.listed(self.kind)
        refusal = self.refusal(watch.shot, folder) if there else f"This shot has no {self.kind} {name!r}"
        if not refusal:
            try:
                jobs.refuse_second_writer(watch.shot)  # also one that was started from a command line
                listing.remove(watch.shot, folder, wait=bpy.app.background)
            except contract.JobError as error:
                refusal = f"{error.message} {error.hint}"
            except OSError as error:
                refusal = f"{folder} cannot be removed: {error.strerror or error}"
        if refusal:
            self.report({"ERROR"}, refusal)  # type: ignore[attr-defined]
            return {"CANCELLED"}
        supervisor.refresh(watch)
        supervisor.redraw()
        return {"FINISHED"}

    def refusal(self, shot: Path, folder: Path) -> str:
        """Why it cannot be removed now; empty if it can."""
        return ""


class SPLANNEQUIN_OT_remove_run(_Remove, bpy.types.Operator):
    """Delete this run from the shot folder on disk, after a question. Takes that were frozen from it stay"""

    bl_idname = "splannequin.remove_run"
    bl_label = "Remove Run"
    bl_options = {"REGISTER", "INTERNAL"}
    kind = "run"
    question = "Delete this training run from disk?"
    warning = "Takes that were frozen from it stay, but cannot be completed. This cannot be undone."

    name: StringProperty(name="Run", description="Name of the run to delete", options={"SKIP_SAVE"})

    def refusal(self, shot: Path, folder: Path) -> str:
        """A run that is scrubbed through is in use."""
        session = viewport.session()
        if session is not None and (session.shot, session.run) == (shot, folder.name):
            return "You are scrubbing through this run: stop scrubbing first"
        return ""


class SPLANNEQUIN_OT_remove_take(_Remove, bpy.types.Operator):
    """Delete the frozen frames of this take from the shot folder on disk, after a question"""

    bl_idname = "splannequin.remove_take"
    bl_label = "Remove Take"
    bl_options = {"REGISTER", "INTERNAL"}
    kind = "take"
    question = "Delete the frozen frames of this take from disk?"
    warning = "It can be frozen again from its run. This cannot be undone."

    name: StringProperty(name="Take", description="Name of the take to delete", options={"SKIP_SAVE"})

    def refusal(self, shot: Path, folder: Path) -> str:
        """A take whose frames are shown in this file is in use."""
        if shown(folder):
            return "The compositor shows this take: bake another one, or remove the shot from the scene, first"
        return ""


def shown(take: Path) -> bool:
    """True if an image of this file that something uses is a frame of the take."""
    wanted = os.path.abspath(take)
    return any(
        image.users and image.filepath and os.path.dirname(os.path.abspath(bpy.path.abspath(image.filepath))) == wanted
        for image in bpy.data.images
    )


CLASSES = (
    SPLANNEQUIN_OT_pick_run,
    SPLANNEQUIN_OT_pick_take,
    SPLANNEQUIN_OT_remove_run,
    SPLANNEQUIN_OT_remove_take,
)
