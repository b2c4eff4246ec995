"""Operators of the Train step: the training, and the list of runs."""

from __future__ import annotations

import bpy

from ..access import Outcome, scene_in, settings_of
from ..properties import StringProperty
from ..translations import tr
from ..ui import pick_operators, step_operator
from .settings import PRESETS


class SPLANNEQUIN_OT_train(step_operator.StepOperator, bpy.types.Operator):
    """Learn the scene and what moves in it from the clip"""

    bl_idname = "splannequin.train"
    bl_label = "Train"
    bl_options = {"REGISTER"}
    step = "train"


class SPLANNEQUIN_OT_pick_run(pick_operators.Pick, bpy.types.Operator):
    """Use this run for display, freezing and further training"""

    bl_idname = "splannequin.pick_run"
    bl_label = "Pick Run"
    bl_options = {"REGISTER", "UNDO"}

    name = StringProperty(name="Run", description="Name of the run", options={"SKIP_SAVE"})

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Sets the scene's run and the preset it was trained with."""
        state = pick_operators.known(context)[1]
        run = state.runs.get(self.name) or state.unfinished.get(self.name)
        if run is None:
            refusal = state.damaged["run"].get(self.name) or f"This shot has no run {self.name!r}"
            self.report({"ERROR"}, tr(refusal))
            return {"CANCELLED"}
        settings = settings_of(scene_in(context))
        settings.run_name = self.name
        if run.get("preset") in [preset[0] for preset in PRESETS]:
            settings.preset = run["preset"]
        return {"FINISHED"}


class SPLANNEQUIN_OT_remove_run(pick_operators.Remove, bpy.types.Operator):
    """Delete this run from the shot folder on disk, after confirmation. Takes frozen from it are kept"""

    bl_idname = "splannequin.remove_run"
    bl_label = "Remove Run"
    bl_options = {"REGISTER", "INTERNAL"}
    kind = "run"
    question = "Delete this training run from disk?"
    warning = "Takes frozen from it are kept but cannot be completed. This cannot be undone."

    name = StringProperty(name="Run", description="Name of the run to delete", options={"SKIP_SAVE"})


CLASSES = (
    SPLANNEQUIN_OT_train,
    SPLANNEQUIN_OT_pick_run,
    SPLANNEQUIN_OT_remove_run,
)
