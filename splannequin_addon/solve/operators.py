"""Cameras for other programs: COLMAP and nerfstudio."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import bpy
from bpy.props import EnumProperty, StringProperty

from ...torch_backend import contract
from ..process import supervisor
from ..shot import chosen
from ..translations import tr
from . import exchange

FORMATS = [
    ("colmap", "COLMAP", "Cameras, images and points3D as .bin, of the plates in the shot's folder frames"),
    ("colmap_text", "COLMAP Text", "The same as .txt"),
    ("nerfstudio", "nerfstudio", "A transforms.json that points to the plates, and points.ply"),
]


class SPLANNEQUIN_OT_export_cameras(bpy.types.Operator):
    """Write the solved cameras and points of the undistorted frames for other programs"""

    bl_idname = "splannequin.export_cameras"
    bl_label = "Export Cameras"
    bl_options = {"REGISTER"}

    directory: StringProperty(
        name="Folder", description="Folder to write into", subtype="DIR_PATH", options={"SKIP_SAVE"}
    )
    filter_folder: bpy.props.BoolProperty(
        name="Folders", description="Show folders", default=True, options={"HIDDEN", "SKIP_SAVE"}
    )
    format: EnumProperty(name="Format", description="What to write", items=FORMATS)

    @classmethod
    def poll(cls, context: Any) -> bool:
        """Off without a solve."""
        folder = chosen.shot_folder(context.scene)
        state = supervisor.watch_of(folder).state if folder else None
        if state is None or not state.solve:
            cls.poll_message_set(tr("Solve the camera first"))
            return False
        return True

    def invoke(self, context: Any, event: Any) -> set[str]:
        """Asks for a folder."""
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: Any) -> set[str]:
        """Has the backend write; in a window the panel tells when it is done."""
        shot = chosen.shot_folder(context.scene)
        if shot is None or not self.directory:
            self.report({"ERROR"}, "No folder was given")
            return {"CANCELLED"}
        folder = Path(os.path.abspath(bpy.path.abspath(self.directory)))
        kind, _, text = self.format.partition("_")
        try:
            process = exchange.begin_export(shot, kind, folder, bool(text))
            if bpy.app.background:
                self.report({"INFO"}, exchange.finish_export(process, folder))
                return {"FINISHED"}
        except contract.JobError as error:
            self.report({"ERROR"}, f"{error.message} {error.hint}".strip())
            return {"CANCELLED"}
        watch = supervisor.watch_of(shot)
        watch.failures.pop("camera", None)

        def tell(sentence: str, well: bool) -> None:
            told = supervisor.watch_of(shot)
            if well:
                told.notes["camera"] = [sentence]
            else:
                told.failures["camera"] = (sentence, "")
            told.redraw = True

        exchange.follow_export(process, folder, tell)
        return {"FINISHED"}


CLASSES = (SPLANNEQUIN_OT_export_cameras,)
