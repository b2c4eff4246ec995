"""The operator that makes the surface of a take and adds it to the scene."""

from __future__ import annotations

import bpy

from ...torch_backend import contract
from ..access import Outcome, scene_in, settings_of
from ..process import begin, job_timer
from ..shot import scene_objects
from ..ui import step_operator
from . import surfaces, takes


class SPLANNEQUIN_OT_add_surface(takes.NeedsTake, step_operator.StepOperator, bpy.types.Operator):
    """Create meshes of the frozen room and people of the chosen take, and add them to the scene under the shot's root.
    They catch the shadows of added objects, hide what is behind them and appear in reflections"""

    bl_idname = "splannequin.add_surface"
    bl_label = "Add Frozen Surface"
    bl_options = {"REGISTER"}
    step = "freeze"

    def perform(self, context: bpy.types.Context) -> Outcome:
        """Adds the surface, and first makes it if the take has none. In a window, the timer does both."""
        scene = scene_in(context)
        folder, take = begin.needed(scene, self.step), settings_of(scene).take_name
        scene_objects.check_root(scene, folder)
        if not surfaces.has_surface(folder, take):
            return super().perform(context)
        if bpy.app.background:
            return step_operator.edit(self, context, self.step, lambda scene, shot: surfaces.add(scene, shot, take))
        job_timer.work(folder, self.step, surfaces.added_in_turns(scene.session_uid, folder, take))
        return {"FINISHED"}

    def params(self, scene: bpy.types.Scene) -> contract.SurfaceParams:
        """Surface parameters with the selected take."""
        return contract.SurfaceParams(take=settings_of(scene).take_name)


CLASSES = (SPLANNEQUIN_OT_add_surface,)
