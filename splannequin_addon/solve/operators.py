"""Operators of the Solve step: the solve, loading its camera, and exports of cameras and ST maps."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import bpy

from ...torch_backend import contract
from ..access import Outcome, scene_in, settings_of
from ..process import children, job_timer, steps
from ..properties import BoolProperty, EnumProperty, IntProperty, StringProperty
from ..shot import inventory, placement, selection
from ..translations import tr
from ..ui import step_operator
from . import arrival, exchange, stmaps

FORMATS = [
    ("colmap", "COLMAP", "Cameras, images and points3D as .bin, of the plates in the shot's folder frames"),
    ("colmap_text", "COLMAP Text", "The same files as .txt"),
    ("nerfstudio", "nerfstudio", "A transforms.json that points to the plates, and points.ply"),
    ("chan", "Nuke Chan", "The animated camera as a table, in the scene's units and Nuke's axes: camera.chan"),
    ("nk", "Nuke Script", "The animated camera with its lens as nodes to paste, in Nuke's axes: camera.nk"),
    ("ply", "Splats", "The splats of the chosen take, placed as the shot is in this scene: frozen.ply"),
    (
        "usd",
        "USD",
        "The splats of the chosen take and the animated camera, placed as the shot is in this scene: frozen.usdc",
    ),
]


class SPLANNEQUIN_OT_export_cameras(bpy.types.Operator):
    """Write the solved cameras and points of the undistorted frames, or the splats of a take, for other programs"""

    bl_idname = "splannequin.export_cameras"
    bl_label = "Export Cameras"
    bl_options = {"REGISTER"}

    directory = StringProperty(
        name="Folder", description="Folder to write into", subtype="DIR_PATH", options={"SKIP_SAVE"}
    )
    filter_folder = BoolProperty(
        name="Folders", description="Show folders", default=True, options={"HIDDEN", "SKIP_SAVE"}
    )
    format = EnumProperty(name="Format", description="What to write", items=FORMATS)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Disabled without a solve."""
        folder = selection.shot_folder(scene_in(context))
        state = job_timer.watch_of(folder).state if folder else None
        if state is None or not state.solve:
            cls.poll_message_set(tr("Solve the camera first"))
            return False
        return True

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> Outcome:
        """Asks for a folder."""
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Starts the export in the backend. With a window, the panel reports when it is done."""
        shot = selection.shot_folder(scene_in(context))
        if shot is None or not self.directory:
            self.report({"ERROR"}, "No folder is chosen")
            return {"CANCELLED"}
        folder = Path(os.path.abspath(bpy.path.abspath(self.directory)))
        kind, _, text = self.format.partition("_")
        words = contract.ExportWords(shot=str(shot.absolute()), format=kind, text=bool(text), output=str(folder))
        words.take = settings_of(scene_in(context)).take_name
        try:
            placement.write(scene_in(context), shot)
            question = exchange.begin_export(words)
            if bpy.app.background:
                self.report({"INFO"}, tr(exchange.exported(question, folder)))
                return {"FINISHED"}
        except contract.JobError as error:
            self.report({"ERROR"}, tr(f"{error.message} {error.hint}".strip()))
            return {"CANCELLED"}
        except OSError as error:
            refusal = inventory.unwritable(shot, error, "Make sure that the disk is not full or read-only.")
            self.report({"ERROR"}, tr(f"{refusal.message} {refusal.hint}".strip()))
            return {"CANCELLED"}
        job_timer.watch_of(shot).failures.pop("solve", None)
        job_timer.when_answered(question, lambda: tell(shot, lambda: [exchange.exported(question, folder)]))
        return {"FINISHED"}


class SPLANNEQUIN_OT_solve_camera(step_operator.StepOperator, bpy.types.Operator):
    """Find where the camera was on every frame, and add it as an animated camera with the plate behind it"""

    bl_idname = "splannequin.solve_camera"
    bl_label = "Solve Camera"
    bl_options = {"REGISTER"}
    step = "solve"

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Runs the step. In a window, the timer first renders drawn masks and reads cameras, one frame per step."""
        scene = scene_in(context)
        folder = selection.shot_folder(scene)
        turns = steps.STEPS[self.step].in_turns(scene, folder) if folder is not None else None
        if folder is None or turns is None or bpy.app.background:
            return super().execute(context)
        job_timer.work(folder, self.step, turns)
        return {"FINISHED"}


class SPLANNEQUIN_OT_load_camera(bpy.types.Operator):
    """Load the solved camera, its plate and the points into this scene. Replaces an earlier solve of this shot"""

    bl_idname = "splannequin.load_camera"
    bl_label = "Load Camera"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Builds the camera and the points."""
        outcome = step_operator.edit(self, context, "solve", arrival.load_camera)
        if outcome == {"FINISHED"} and context.window is not None:
            job_timer.look_through_camera(context.window)
        return outcome


class SPLANNEQUIN_OT_write_stmaps(bpy.types.Operator):
    """Write two ST maps into the shot's solve folder: one removes the original's lens distortion, the other applies it
    to work done over the undistorted plate"""

    bl_idname = "splannequin.write_stmaps"
    bl_label = "Write ST Maps"
    bl_options = {"REGISTER"}

    width = IntProperty(
        name="Width", description="Width of the maps in pixels; 0: width of the working frames", default=0, min=0
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Disabled without a solve, while a step runs, and while the maps are being written."""
        folder = selection.shot_folder(scene_in(context))
        watch = job_timer.watch_of(folder) if folder else None
        if watch is None or watch.state is None or not watch.state.solve:
            cls.poll_message_set(tr("Solve the camera first"))
            return False
        if watch.running():
            cls.poll_message_set(tr("A step of this shot is running"))
            return False
        if folder in writing:
            cls.poll_message_set(tr("The maps are being written"))
            return False
        return True

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Starts the backend. Without a window, waits for it."""
        folder = selection.shot_folder(scene_in(context))
        if folder is None:
            return {"CANCELLED"}
        try:
            question = stmaps.begin(folder, self.width)
        except contract.JobError as error:
            self.report({"ERROR"}, tr(f"{error.message} {error.hint}".strip()))
            return {"CANCELLED"}
        watch = job_timer.watch_of(folder)
        watch.failures.pop("solve", None)
        if not bpy.app.background:
            watch.notes["solve"] = ["Writing the ST maps."]
            follow_stmaps(folder, question)
            return {"FINISHED"}
        question.wait()
        tell(folder, lambda: stmaps.sentences(stmaps.answer(question)))
        if "solve" in watch.failures:
            self.report({"ERROR"}, tr(watch.failures["solve"][0]))
            return {"CANCELLED"}
        for line in watch.notes["solve"]:
            self.report({"INFO"}, tr(line))
        return {"FINISHED"}


writing: set[Path] = set()
"""Shots whose ST maps are being written."""


def follow_stmaps(shot: Path, question: children.Question) -> None:
    """Reports on the panel when a shot's ST maps are written."""

    def written() -> None:
        writing.discard(shot)
        tell(shot, lambda: stmaps.sentences(stmaps.answer(question)))

    writing.add(shot)
    job_timer.when_answered(question, written)


def tell(shot: Path, say: Callable[[], list[str]]) -> None:
    """Shows the backend's answer, from `say`, or its error on the panel of the step."""
    watch = job_timer.watch_of(shot)
    watch.notes.pop("solve", None)
    try:
        watch.notes["solve"] = say()
    except (contract.JobError, ValueError, KeyError) as error:
        watch.fail("solve", error)


def register() -> None:
    """Does nothing: no maps are being written yet."""


def unregister() -> None:
    """Stops waiting. A backend that is writing maps finishes independently."""
    writing.clear()


CLASSES = (
    SPLANNEQUIN_OT_solve_camera,
    SPLANNEQUIN_OT_load_camera,
    SPLANNEQUIN_OT_export_cameras,
    SPLANNEQUIN_OT_write_stmaps,
)
