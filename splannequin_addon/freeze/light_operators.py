"""Operators that make the light of a take the scene's world, and that restore the previous world."""

from __future__ import annotations

from pathlib import Path

import bpy

from ...torch_backend import contract
from ..access import Outcome, scene_in, settings_of
from ..process import begin
from ..shot import scene_objects, selection
from ..translations import tr
from ..ui import step_operator
from . import lights, takes


class SPLANNEQUIN_OT_add_light(takes.NeedsTake, step_operator.StepOperator, bpy.types.Operator):
    """Render a panorama of the chosen take's frozen scene from the 3D cursor, and use it as the scene's world, as
    bright as the plate. It is an estimate: areas that no plate shows are filled smoothly. Removing the light restores
    the previous world"""

    bl_idname = "splannequin.add_light"
    bl_label = "Add Light from the Shot"
    bl_options = {"REGISTER"}
    step = "freeze"

    def perform(self, context: bpy.types.Context) -> Outcome:
        """Starts the job for the panorama, which becomes the world when the job ends."""
        scene = scene_in(context)
        scene_objects.check_root(scene, begin.needed(scene, self.step))
        return super().perform(context)

    def params(self, scene: bpy.types.Scene) -> contract.LightParams:
        """The selected take, and the position of the 3D cursor."""
        position = ",".join(repr(float(value)) for value in scene.cursor.location)
        return contract.LightParams(take=settings_of(scene).take_name, position=position)


class SPLANNEQUIN_OT_remove_light(bpy.types.Operator):
    """Remove the light of this shot and restore the scene's previous world"""

    bl_idname = "splannequin.remove_light"
    bl_label = "Remove Light"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Disabled without a light."""
        scene = scene_in(context)
        folder = selection.shot_folder(scene)
        if folder is None or lights.find(scene, folder) is None:
            cls.poll_message_set(tr("This shot has no light in this scene"))
            return False
        return True

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Restores the previous world."""
        return step_operator.edit(self, context, "freeze", _removed)


def _removed(scene: bpy.types.Scene, shot: Path) -> list[str]:
    lights.remove(scene, shot)
    return ["The light was removed."]


CLASSES = (SPLANNEQUIN_OT_add_light, SPLANNEQUIN_OT_remove_light)
