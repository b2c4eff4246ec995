"""Operators of the Freeze step: the freeze, the instant, scrubbing, and the list of takes."""

from __future__ import annotations

import bpy

from ...torch_backend import contract
from ..access import Outcome, scene_in, settings_of
from ..process import job_timer
from ..properties import IntProperty, StringProperty
from ..shot import markers, selection
from ..translations import tr
from ..ui import pick_operators, step_operator
from . import own_camera, splats, takes, viewport


class SPLANNEQUIN_OT_freeze(step_operator.StepOperator, bpy.types.Operator):
    """Render the scene frozen at t*, from every camera pose of the clip or from your own animated camera"""

    bl_idname = "splannequin.freeze"
    bl_label = "Freeze"
    bl_options = {"REGISTER"}
    step = "freeze"

    def perform(self, context: bpy.types.Context) -> Outcome:
        """Runs the step. In a window, the timer reads the artist's camera in steps of a few frames."""
        scene = scene_in(context)
        folder = selection.shot_folder(scene)
        if not own_camera.name_of(scene) or folder is None or bpy.app.background:
            return super().perform(context)
        takes.read_in_turns(scene, folder, self.step)
        return {"FINISHED"}

    def params(self, scene: bpy.types.Scene) -> contract.FreezeParams | None:
        """Reads the artist's camera without interruption, if one is selected."""
        return takes.read_camera(scene, self.step)


class SPLANNEQUIN_OT_t_star_here(bpy.types.Operator):
    """Freeze time at the current frame"""

    bl_idname = "splannequin.t_star_here"
    bl_label = "Set t* from Current Frame"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Sets t* to the current frame, clamped to the clip's range."""
        scene = scene_in(context)
        folder = selection.shot_folder(scene)
        frame = scene.frame_current
        state = job_timer.watch_of(folder).state if folder else None
        if state is not None and state.frames:
            first, last = state.frame_range
            frame = min(max(frame, first), last)
        settings_of(scene).t_star = frame
        settings_of(scene).choose_t_star = True
        return {"FINISHED"}


class SPLANNEQUIN_OT_t_star_marker(bpy.types.Operator):
    """Show t* as a draggable marker on the timeline. Press again to remove it"""

    bl_idname = "splannequin.t_star_marker"
    bl_label = "Marker for t*"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Adds or removes the marker."""
        markers.toggle(scene_in(context))
        return {"FINISHED"}


class SPLANNEQUIN_OT_live(bpy.types.Operator):
    """Draw the frozen instant over the 3D view while you scrub t* and move the view. Press again to stop"""

    bl_idname = "splannequin.live"
    bl_label = "Scrub in View"
    bl_options = {"REGISTER"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Disabled without a trained run, and without a 3D view."""
        if viewport.session() is not None:
            return True  # a running session can be stopped even if the run is gone
        if bpy.app.background:
            cls.poll_message_set(tr("There is no 3D view"))
            return False
        folder = selection.shot_folder(scene_in(context))
        state = job_timer.watch_of(folder).state if folder else None
        if state is None or settings_of(scene_in(context)).run_name not in state.runs:
            cls.poll_message_set(tr("Train first"))
            return False
        return True

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Starts or stops the session."""
        if viewport.session() is not None:
            viewport.end()
            return {"FINISHED"}
        try:
            viewport.begin(scene_in(context))
        except contract.JobError as error:
            self.report({"ERROR"}, tr(f"{error.message} {error.hint}".strip()))
            return {"CANCELLED"}
        return {"FINISHED"}


class SPLANNEQUIN_OT_suggested_instant(bpy.types.Operator):
    """Set t* to the previous or next suggested instant, whose plate is sharp and shows most of what moves"""

    bl_idname = "splannequin.suggested_instant"
    bl_label = "Suggested Instant"
    bl_options = {"REGISTER", "UNDO"}

    step = IntProperty(name="Step", description="1: next suggestion, -1: previous suggestion", default=1)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled while scrubbing, because the backend ranks the instants."""
        if not viewport.suggestions():
            cls.poll_message_set(tr("Suggestions come with Scrub in View"))
            return False
        return True

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Sets t* to the nearest suggestion in that direction. At the end it wraps around."""
        props = settings_of(scene_in(context))
        frames = sorted(s["frame"] for s in viewport.suggestions())
        now = viewport.instant(scene_in(context))
        beyond = [f for f in frames if now is None or (f - now) * self.step > 0]
        ordered = beyond or frames
        props.t_star = ordered[0] if self.step > 0 else ordered[-1]
        props.choose_t_star = True
        return {"FINISHED"}


class SPLANNEQUIN_OT_pick_take(pick_operators.Pick, bpy.types.Operator):
    """Use this take for display and for the next bake"""

    bl_idname = "splannequin.pick_take"
    bl_label = "Pick Take"
    bl_options = {"REGISTER", "UNDO"}

    name = StringProperty(name="Take", description="Name of the take", options={"SKIP_SAVE"})

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Sets the scene's take name."""
        state = pick_operators.known(context)[1]
        if self.name not in state.takes:
            refusal = state.damaged["take"].get(self.name) or f"This shot has no take {self.name!r}"
            self.report({"ERROR"}, tr(refusal))
            return {"CANCELLED"}
        settings_of(scene_in(context)).take_name = self.name
        return {"FINISHED"}


class SPLANNEQUIN_OT_remove_take(pick_operators.Remove, bpy.types.Operator):
    """Delete the frozen frames of this take from the shot folder on disk, after confirmation"""

    bl_idname = "splannequin.remove_take"
    bl_label = "Remove Take"
    bl_options = {"REGISTER", "INTERNAL"}
    kind = "take"
    question = "Delete the frozen frames of this take from disk?"
    warning = "It can be frozen again from its run. This cannot be undone."

    name = StringProperty(name="Take", description="Name of the take to delete", options={"SKIP_SAVE"})


class SPLANNEQUIN_OT_add_splats(takes.NeedsTake, bpy.types.Operator):
    """Add the frozen splats of the chosen take to the scene under the shot's root, to place objects among them. They
    are not rendered unless you turn that on"""

    bl_idname = "splannequin.add_splats"
    bl_label = "Add Frozen Splats"
    bl_options = {"REGISTER"}

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Adds the splats. In a window, the timer reads the file and the panel reports when they are added."""
        scene = scene_in(context)
        folder, take = selection.shot_folder(scene), settings_of(scene).take_name
        if bpy.app.background or folder is None:
            return step_operator.edit(self, context, "freeze", lambda scene, shot: splats.add(scene, shot, take))
        job_timer.work(folder, "freeze", splats.added_in_turns(scene.session_uid, folder, take))
        return {"FINISHED"}


CLASSES = (
    SPLANNEQUIN_OT_freeze,
    SPLANNEQUIN_OT_add_splats,
    SPLANNEQUIN_OT_t_star_here,
    SPLANNEQUIN_OT_t_star_marker,
    SPLANNEQUIN_OT_live,
    SPLANNEQUIN_OT_suggested_instant,
    SPLANNEQUIN_OT_pick_take,
    SPLANNEQUIN_OT_remove_take,
)
