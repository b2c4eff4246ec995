"""Operators of the motion matte: show it, paint on it, save or clear the paint."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from ..access import OperatorBase, Outcome, scene_in
from ..process import job_timer
from ..scene import sequences
from ..shot import inventory, selection
from ..translations import tr
from ..ui import icons
from . import mattes, motion_overlay


def _in_editor(context: bpy.types.Context, image: bpy.types.Image, mode: str) -> Any | None:
    """Shows an image in an Image Editor of this window, else of another one, else in a new window. None in background
    mode."""
    if bpy.app.background:
        return None
    windows = sorted(context.window_manager.windows, key=lambda window: window != context.window)
    areas = [area for window in windows for area in window.screen.areas if area.type == "IMAGE_EDITOR"]
    if not areas:
        bpy.ops.wm.window_new()
        areas = [context.window_manager.windows[-1].screen.areas[0]]
        areas[0].type = "IMAGE_EDITOR"
    space = areas[0].spaces.active
    space.image = image
    space.ui_mode = mode
    return space


class _Matte(OperatorBase):
    """Base class of the operators: disabled without a solve, gets the scene's shot, reports errors."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Disabled without a solve."""
        folder = selection.shot_folder(scene_in(context))
        state = job_timer.watch_of(folder).state if folder else None
        if state is None or not state.solve:
            cls.poll_message_set(tr("Solve the camera first"))
            return False
        return True

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Runs `act`; reports an error."""
        shot = selection.shot_folder(scene_in(context))
        if shot is None:
            return {"CANCELLED"}
        try:
            self.report({"INFO"}, tr(self.act(context, shot)))
        except contract.JobError as error:
            self.report({"ERROR"}, f"{tr(error.message)} {tr(error.hint)}".strip())
            return {"CANCELLED"}
        return {"FINISHED"}

    def act(self, context: bpy.types.Context, shot: Path) -> str:
        """Does the operator's work. Returns a sentence about it."""
        raise NotImplementedError


class SPLANNEQUIN_OT_show_motion(_Matte, bpy.types.Operator):
    """Show the motion matte from the solve in an Image Editor: black stands still, white moves, grey is unknown"""

    bl_idname = "splannequin.show_motion"
    bl_label = "Show Motion"
    bl_options = {"REGISTER", "UNDO"}

    def act(self, context: bpy.types.Context, shot: Path) -> str:
        """Loads the mattes as an image sequence."""
        image, first, last = mattes.load_sequence(shot)
        space = _in_editor(context, image, "VIEW")
        if space is not None:
            sequences.show_sequence(space.image_user, image, first, last)
        return f"The motion matte has frames {first} to {last}."


class SPLANNEQUIN_OT_motion_over_plate(_Matte, bpy.types.Operator):
    """Tint the moving areas found by the solve over the plate, seen through the solved camera. Press again to turn the
    tint off"""

    bl_idname = "splannequin.motion_over_plate"
    bl_label = "Motion over Plate"
    bl_options = {"REGISTER", "UNDO"}

    def act(self, context: bpy.types.Context, shot: Path) -> str:
        """Shows or hides the overlay. In a window, missing tinted frames are first written by the timer, one per
        step."""
        scene = scene_in(context)
        if motion_overlay.hide(scene, shot):
            return "The plate is shown without the tint."
        turns = mattes.tint_in_turns(shot)
        first = next(turns, None)
        if first is None or bpy.app.background:
            for _ in turns:
                pass
            return " ".join(mattes.show_over_plate(scene, shot))
        job_timer.work(shot, "solve", _tint(shot, turns, scene.session_uid))
        return "Tinting the motion."


def _tint(shot: Path, turns: Iterator[tuple[int, int]], scene_uid: int) -> Iterator[job_timer.Progress]:
    """Tints the remaining frames, one per step, then shows them."""
    for done, total in turns:
        yield job_timer.Progress(f"Tinting the motion, frame {done} of {total}", done, total)
    job_timer.change(
        job_timer.watch_of(shot), "solve", lambda scene: mattes.show_over_plate(scene, shot), only=scene_uid
    )


class SPLANNEQUIN_OT_paint_motion(_Matte, bpy.types.Operator):
    """Paint on the motion matte of the current frame in an Image Editor: black stands still, white moves"""

    bl_idname = "splannequin.paint_motion"
    bl_label = "Paint Motion"
    bl_options = {"REGISTER", "UNDO"}

    def act(self, context: bpy.types.Context, shot: Path) -> str:
        """Creates the image to paint on."""
        frame = scene_in(context).frame_current
        _in_editor(context, mattes.paint_image(shot, frame), "PAINT")
        return f"Paint on frame {frame}, then press Save Paint."


class SPLANNEQUIN_OT_save_motion(_Matte, bpy.types.Operator):
    """Save the painted motion matte of the current frame in the shot. Later freezes use it"""

    bl_idname = "splannequin.save_motion"
    bl_label = "Save Motion Paint"
    bl_options = {"REGISTER", "UNDO"}

    def act(self, context: bpy.types.Context, shot: Path) -> str:
        """Saves the current frame's image."""
        frame = scene_in(context).frame_current
        image = mattes.find_image(shot, frame)
        if image is None:
            message = f"Nothing is painted on frame {frame}."
            raise contract.JobError(message, "Press Paint Motion first.", contract.ExitCode.USAGE)
        mattes.save_paint(image)
        return f"Frame {frame} uses your painted motion matte."


class SPLANNEQUIN_OT_clear_motion(_Matte, bpy.types.Operator):
    """Delete the painted motion matte of the current frame from the shot folder on disk, after confirmation. The matte
    from the solve is used again"""

    bl_idname = "splannequin.clear_motion"
    bl_label = "Clear Motion Paint"
    bl_options = {"REGISTER"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> Outcome:
        """Asks for confirmation."""
        # Undo does not restore deleted files.
        return context.window_manager.invoke_confirm(
            self, event, title="Delete the painted matte of this frame from disk?",
            message="The matte from the solve is used again. This cannot be undone.", confirm_text="Remove",
            icon="WARNING",
        )  # fmt: skip

    def act(self, context: bpy.types.Context, shot: Path) -> str:
        """Deletes the current frame's file."""
        frame = scene_in(context).frame_current
        try:
            gone = mattes.clear_paint(shot, frame)
        except OSError as error:
            raise inventory.unwritable(
                mattes.painted_file(shot, frame), error, "Close it in other programs, then try again."
            ) from error
        if not gone:
            raise contract.JobError(f"Nothing is painted on frame {frame}.", "", contract.ExitCode.USAGE)
        return f"Frame {frame} uses the motion matte from the solve."


def draw(layout: bpy.types.UILayout, is_over_plate: bool) -> None:
    """Draws the buttons of the motion matte."""
    name = "splannequin.motion_over_plate"
    layout.operator(name, icon=icons.of(name), depress=is_over_plate)
    row = layout.row(align=True)
    for name in ("splannequin.show_motion", "splannequin.paint_motion"):
        row.operator(name, icon=icons.of(name))
    row = layout.row(align=True)
    row.operator("splannequin.save_motion", text="Save Paint", icon=icons.of("splannequin.save_motion"))
    row.operator("splannequin.clear_motion", text="Clear", icon=icons.of("splannequin.clear_motion"))


CLASSES = (
    SPLANNEQUIN_OT_show_motion,
    SPLANNEQUIN_OT_motion_over_plate,
    SPLANNEQUIN_OT_paint_motion,
    SPLANNEQUIN_OT_save_motion,
    SPLANNEQUIN_OT_clear_motion,
)
