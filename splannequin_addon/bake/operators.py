"""The operators of the Bake step: the whole bake, and each of its parts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from ..access import Outcome, scene_in, settings_of
from ..freeze import own_camera, takes
from ..process import backend, begin, job_timer, jobs
from ..shot import selection
from ..translations import tr
from ..ui import step_operator
from . import cg_camera, freeze_group, insertion, progress, rendering


class SPLANNEQUIN_OT_bake(step_operator.StepOperator, bpy.types.Operator):
    """Freeze missing or outdated frames of the scene's range, insert the freeze before the output of the scene's
    compositor, and render the range to the scene's output path"""

    bl_idname = "splannequin.bake"
    bl_label = "Bake and Render"
    bl_options = {"REGISTER"}
    step = "bake"

    def perform(self, context: bpy.types.Context) -> Outcome:
        """Bakes the shot. A complete take needs no backend."""
        scene = scene_in(context)
        folder = selection.shot_folder(scene)
        take = settings_of(scene).take_name
        if folder is None or backend.available() or not takes.complete(folder, take, rendering.frames_of(scene)):
            if folder is not None and not bpy.app.background and own_camera.follows_camera(scene):
                takes.read_in_turns(scene, folder, self.step)
                return {"FINISHED"}
            return super().perform(context)
        if not bpy.app.background:
            insertion.bring_in(scene, folder, take)
            return {"FINISHED"}
        outcome = step_operator.edit(
            self, context, "bake", lambda scene, shot: insertion.insert_freeze(scene, shot, take)
        )
        if outcome == {"FINISHED"}:
            try:
                ops: Any = bpy.ops  # our operators are not in the stubs
                ops.splannequin.render("EXEC_DEFAULT")
            except RuntimeError as error:
                self.report({"ERROR"}, str(error).strip())
                return {"CANCELLED"}
        return outcome

    def params(self, scene: bpy.types.Scene) -> contract.FreezeParams | None:
        """Freeze parameters after a new reading of the artist's camera, if the take uses one; else None.

        Frames whose camera pose has changed since the freeze are stale.
        """
        return takes.read_camera(scene, self.step) if own_camera.follows_camera(scene) else None

    def after(self, scene: bpy.types.Scene, job: jobs.Job) -> list[str]:
        """Inserts the freeze, then renders."""
        notes = super().after(scene, job)
        notes += rendering.choose_output(scene, job.shot, job.params["take"])
        run = rendering.Run(scene, check=cg_camera.check)
        run.begin(scene)
        try:
            bpy.ops.render.render(animation=True, scene=scene.name)
        except RuntimeError as error:
            run.refused(error)
        run.finish(scene)
        return notes + run.notes


class SPLANNEQUIN_OT_render(bpy.types.Operator):
    """Render the scene's range through the compositor to its output path"""

    bl_idname = "splannequin.render"
    bl_label = "Render Baked Shot"
    bl_options = {"REGISTER"}

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Renders and blocks until all frames are written."""
        return self._render(context, "EXEC_DEFAULT")

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> Outcome:
        """Renders without blocking the window, as Blender's Render Animation does."""
        return self._render(context, "INVOKE_DEFAULT")

    def _render(self, context: bpy.types.Context, how: str) -> Outcome:
        scene = scene_in(context)
        folder = selection.shot_folder(scene)
        if folder is None:
            self.report({"ERROR"}, "No shot is chosen: import a clip first")
            return {"CANCELLED"}
        notes = rendering.choose_output(scene, folder, settings_of(scene).take_name)
        if notes:
            job_timer.undo_step("bake", wait=False)  # before the render changes settings for its duration
        run = rendering.Run(scene, check=cg_camera.check)
        try:
            run.begin(scene)
        except contract.JobError as error:
            self.report({"ERROR"}, tr(f"{error.message} {error.hint}".strip()))
            return {"CANCELLED"}
        progress.began(folder, run)
        try:
            if "CANCELLED" in bpy.ops.render.render(how, animation=True, scene=scene.name) and not run.done:
                run.refused(RuntimeError("the render was cancelled"))
        except RuntimeError as error:
            run.refused(error)
        if how == "EXEC_DEFAULT" or run.error is not None:
            progress.finish(folder)
        if run.error is not None or (how == "EXEC_DEFAULT" and "bake" in job_timer.watch_of(folder).failures):
            self.report({"ERROR"}, tr(" ".join(job_timer.watch_of(folder).failures["bake"])))
            return {"CANCELLED"}
        for note in (*notes, *run.notes):
            self.report({"INFO"}, tr(note))
        return {"FINISHED"}


class SPLANNEQUIN_OT_insert_freeze(bpy.types.Operator):
    """Insert the frozen take before the output of the scene's compositor, or update it, without rendering"""

    bl_idname = "splannequin.insert_freeze"
    bl_label = "Insert Freeze in Compositor"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Inserts or updates the group."""
        take = settings_of(scene_in(context)).take_name
        return step_operator.edit(self, context, "bake", lambda scene, shot: insertion.insert_freeze(scene, shot, take))


class SPLANNEQUIN_OT_freeze_as_warp(bpy.types.Operator):
    """Freeze the image that is linked to the group instead of showing the take's frames, so that your plate keeps its
    grade, highlights and grain. Press again to show the take's frames"""

    bl_idname = "splannequin.freeze_as_warp"
    bl_label = "Freeze as Warp"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Toggles between the take's frames and its warp, and inserts or updates the group."""
        take, warp = settings_of(scene_in(context)).take_name, not freeze_group.wants_warp(scene_in(context))
        return step_operator.edit(
            self, context, "bake", lambda scene, shot: insertion.insert_freeze(scene, shot, take, warp)
        )


class SPLANNEQUIN_OT_combine_cg(bpy.types.Operator):
    """Link the scene's render into the freeze, so that your objects appear in front of or behind the frozen people by
    depth. Makes the film transparent and turns on the depth pass"""

    bl_idname = "splannequin.combine_cg"
    bl_label = "Combine with Scene Objects"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Adds a Render Layers node and its two links."""
        return step_operator.edit(self, context, "bake", insertion.combine_cg)


class SPLANNEQUIN_OT_remove_shot(bpy.types.Operator):
    """Remove the camera, points and compositor group of this shot from the file, and restore the scene's settings. The
    shot folder on disk is kept"""

    bl_idname = "splannequin.remove_shot"
    bl_label = "Remove Shot from Scene"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Removes everything that Splannequin added to the file."""

        def remove(scene: bpy.types.Scene, shot: Path) -> list[str]:
            notes = begin.remove_all(scene, shot)
            job_timer.watch_of(shot).notes.clear()  # the notes describe what was just removed
            return notes

        return step_operator.edit(self, context, "bake", remove)


CLASSES = (
    SPLANNEQUIN_OT_bake,
    SPLANNEQUIN_OT_render,
    SPLANNEQUIN_OT_insert_freeze,
    SPLANNEQUIN_OT_freeze_as_warp,
    SPLANNEQUIN_OT_combine_cg,
    SPLANNEQUIN_OT_remove_shot,
)
