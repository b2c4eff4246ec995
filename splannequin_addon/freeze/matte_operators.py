"""Operators for mattes: draw on a frozen frame, make a matte from a mask, remove a matte, combine takes."""

from __future__ import annotations

from typing import Any

import bpy

from ...torch_backend import contract
from ..access import Outcome, scene_in, settings_of
from ..process import backend, begin
from ..properties import StringProperty
from ..scene import sequences
from ..shot import selection
from ..translations import tr
from ..ui import step_operator
from . import mattes, takes


class SPLANNEQUIN_OT_draw_matte(takes.NeedsTake, bpy.types.Operator):
    """Show the frozen frames in an Image Editor, to draw a mask around a person or an object"""

    bl_idname = "splannequin.draw_matte"
    bl_label = "Draw on Frozen Frame"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Loads the frames, and adds a mask if none is selected. In a window, an editor shows both."""
        scene = scene_in(context)
        folder, props = selection.shot_folder(scene), settings_of(scene)
        assert folder is not None
        try:
            image, first, last = mattes.frozen_sequence(folder, props.take_name)
        except (contract.JobError, OSError, ValueError, RuntimeError) as error:
            self.report({"ERROR"}, tr(f"{getattr(error, 'message', error)} {getattr(error, 'hint', '')}".strip()))
            return {"CANCELLED"}
        if props.matte_mask is None:
            props.matte_mask = bpy.data.masks.new("Matte")
        space = None if bpy.app.background else _editor(context)
        if space is not None:
            space.image, space.ui_mode, space.mask = image, "MASK", props.matte_mask
            sequences.show_sequence(space.image_user, image, first, last)
        self.report({"INFO"}, tr(f"You can draw on frames {first} to {last}."))
        return {"FINISHED"}


def _editor(context: bpy.types.Context) -> Any:
    """An Image Editor: in this window if it has one, else in another window, else in a new window."""
    windows = sorted(context.window_manager.windows, key=lambda window: window != context.window)
    areas = [area for window in windows for area in window.screen.areas if area.type == "IMAGE_EDITOR"]
    if not areas:
        bpy.ops.wm.window_new()
        areas = [context.window_manager.windows[-1].screen.areas[0]]
        areas[0].type = "IMAGE_EDITOR"
    return areas[0].spaces.active


class SPLANNEQUIN_OT_matte_from_mask(takes.NeedsTake, step_operator.StepOperator, bpy.types.Operator):
    """Create a matte for every frame of the take from the area inside the mask at the current frame. It gets the mask's
    name. Drawing the mask again at another frame adds to the matte"""

    bl_idname = "splannequin.matte_from_mask"
    bl_label = "Matte from Mask"
    bl_options = {"REGISTER"}
    step = "freeze"

    def params(self, scene: bpy.types.Scene) -> contract.MatteParams:
        """Matte parameters with the lassos of the mask."""
        return mattes.params_of(scene, begin.needed(scene, self.step))


class SPLANNEQUIN_OT_remove_matte(step_operator.StepOperator, bpy.types.Operator):
    """Delete a matte of the take from the shot folder on disk, after confirmation"""

    bl_idname = "splannequin.remove_matte"
    bl_label = "Remove Matte"
    bl_options = {"REGISTER", "INTERNAL"}
    step = "freeze"

    name = StringProperty(name="Matte", description="Name of the matte to delete", options={"SKIP_SAVE"})

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> Outcome:
        """Asks for confirmation."""
        # Undo does not restore deleted files.
        return context.window_manager.invoke_confirm(
            self, event, title="Delete this matte from disk?",
            message="It can be drawn again. This cannot be undone.", confirm_text="Remove", icon="WARNING",
        )  # fmt: skip

    def params(self, scene: bpy.types.Scene) -> contract.MatteParams:
        """Matte parameters that remove the matte."""
        return contract.MatteParams(take=settings_of(scene).take_name, remove=self.name, device=backend.device())


class SPLANNEQUIN_OT_combine_takes(step_operator.StepOperator, bpy.types.Operator):
    """Create a take that shows this object as in another take, or live as in the clip. Everything else comes from the
    chosen take"""

    bl_idname = "splannequin.combine_takes"
    bl_label = "Separate Instant"
    bl_options = {"REGISTER", "INTERNAL"}
    step = "freeze"

    name = StringProperty(name="Matte", description="Name of the object's matte", options={"SKIP_SAVE"})
    source = StringProperty(
        name="From",
        description="Take that shows this object as you want it, with a matte of the same name; live: the object moves "
        "as in the clip",
        default=contract.LIVE_SOURCE,
        options=set(),
        search=lambda self, context, text: mattes.sources_of(scene_in(context), str(getattr(self, "name", ""))),
        search_options={"SUGGESTION"},
    )
    result = StringProperty(name="Into", description="Name of the new take", default="combined", options=set())

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> Outcome:
        """Asks for the source take and for a name."""
        return context.window_manager.invoke_props_dialog(self)

    def params(self, scene: bpy.types.Scene) -> contract.CombineParams:
        """Combine parameters for this thing, together with those that the combined take already has."""
        return mattes.combination(scene, begin.needed(scene, self.step), self.name, self.source, self.result)


CLASSES = (
    SPLANNEQUIN_OT_combine_takes,
    SPLANNEQUIN_OT_draw_matte,
    SPLANNEQUIN_OT_matte_from_mask,
    SPLANNEQUIN_OT_remove_matte,
)
