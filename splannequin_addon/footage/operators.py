"""The operators that choose or import the clip, including a drop on the 3D view and the Movie Clip editor's button."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from ..access import OneShot, Outcome, layout_of, scene_in, settings_of
from ..process import job_timer, jobs, steps
from ..properties import BoolProperty, StringProperty
from ..scene import paths
from ..shot import selection, source
from ..translations import tr
from ..ui import icons, step_operator

# Dropped images are left to Blender, because they are often references.
VIDEO = ".mp4;.mov;.m4v;.mkv;.avi;.mxf;.mts;.webm;.mpg;.mpeg"
"""Extensions of files that are accepted when dropped."""


class SPLANNEQUIN_OT_use_clip(bpy.types.Operator):
    """Make this video the clip of the scene's shot; nothing is imported yet"""

    bl_idname = "splannequin.use_clip"
    bl_label = "Use as Splannequin Clip"
    bl_options = {"REGISTER", "UNDO"}

    filepath = StringProperty(name="File", description="Video to use", subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_movie = BoolProperty(name="Movies Only", description="Show videos only", default=True, options={"HIDDEN"})
    filter_folder = BoolProperty(name="Folders", description="Show folders", default=True, options={"HIDDEN"})

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> Outcome:
        """Uses a dropped file, or opens the file browser."""
        if self.filepath:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Sets the clip. If the selected shot is already imported, another clip starts a new shot."""
        props = settings_of(scene_in(context))
        if not self.filepath:
            self.report({"ERROR"}, "No file is chosen")
            return {"CANCELLED"}
        clip = paths.absolute(self.filepath)
        known = [i for i, one in enumerate(selection.settings(scene_in(context))) if _is_of(one, clip)]
        if known:
            selection.choose(scene_in(context), known[0])
            props.clip = props.clip or self.filepath
        else:
            folder = selection.shot_folder(scene_in(context))
            state = job_timer.watch_of(folder).state if folder is not None else None
            if state is not None and state.frames:
                selection.add(scene_in(context))
            props.clip, props.shot_path = self.filepath, ""
        self.report({"INFO"}, "Clip chosen: press Import Clip in the Splannequin tab")
        return {"FINISHED"}


def _is_of(one: OneShot, clip: str) -> bool:
    """True if a shot has this clip (an absolute path), or has no clip and lies at the clip's default shot folder."""
    if one.clip:
        return os.path.normcase(paths.absolute(one.clip)) == os.path.normcase(clip)
    return selection.folder_of(one) == selection.folder_of_clip(Path(clip))


class SPLANNEQUIN_OT_use_movie_clip(bpy.types.Operator):
    """Make the clip that this editor shows the clip of the scene's shot"""

    bl_idname = "splannequin.use_movie_clip"
    bl_label = "Use This Clip"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled if the editor shows a clip."""
        return getattr(context.space_data, "clip", None) is not None

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Passes the clip's file to `use_clip`."""
        ops: Any = bpy.ops  # our operators are not in the stubs
        return ops.splannequin.use_clip(filepath=bpy.path.abspath(context.space_data.clip.filepath))


class SPLANNEQUIN_PT_movie_clip(bpy.types.Panel):
    """The clip of this editor for a frozen shot"""

    bl_label = "Splannequin"
    bl_idname = "SPLANNEQUIN_PT_movie_clip"
    bl_space_type = "CLIP_EDITOR"
    bl_region_type = "UI"
    bl_category = "Splannequin"

    def draw(self, context: bpy.types.Context) -> None:
        """One button. The five steps are in the 3D view."""
        layout_of(self).operator("splannequin.use_movie_clip", icon=icons.of("splannequin.use_movie_clip"))
        layout_of(self).label(text="Continue in the 3D view's sidebar.", icon="INFO")


class SPLANNEQUIN_FH_video(bpy.types.FileHandler):
    """A video dropped on the 3D view"""

    bl_idname = "SPLANNEQUIN_FH_video"
    bl_label = "Splannequin Clip"
    bl_import_operator = "splannequin.use_clip"
    bl_file_extensions = VIDEO

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        """Accepts drops in the 3D view only."""
        return context.area is not None and context.area.type == "VIEW_3D"


class SPLANNEQUIN_OT_import_clip(step_operator.StepOperator, bpy.types.Operator):
    """Import the clip's frames into the shot folder and check them"""

    bl_idname = "splannequin.import_clip"
    bl_label = "Import Clip"
    bl_options = {"REGISTER"}
    step = "import"

    replace = BoolProperty(
        name="Replace",
        description="Import other frames into a shot that already has results. The results move to a folder in "
        "the shot",
        default=False,
        options={"SKIP_SAVE"},
    )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> Outcome:
        """Asks for confirmation before an import replaces frames that other work depends on. Scripts pass `replace`
        instead."""
        question = replaces(scene_in(context))
        if not question:
            return self.execute(context)
        self.replace = True
        return context.window_manager.invoke_confirm(
            self, event, title="Import Other Frames", message=tr(question), confirm_text="Import", icon="WARNING"
        )

    def params(self, scene: bpy.types.Scene) -> jobs.Params | None:
        """Import parameters from the scene's settings, with the confirmation to replace."""
        params = steps.STEPS[self.step].params(scene)
        return dataclasses.replace(params, replace=self.replace)


def replaces(scene: bpy.types.Scene) -> str:
    """Sentence about the work in the shot that an import would or may replace; empty if there is none."""
    clip, folder = paths.absolute(settings_of(scene).clip), selection.shot_folder(scene)
    if folder is None:
        return ""
    work = ", ".join(contract.work_words(contract.ShotFolder(folder)))
    if clip and source.is_of(folder, clip) is False:
        source_name = contract.printable(source.named(folder))
        question = f"{folder.name} is the shot of {source_name}. Its frames will be replaced."
        return f"{question} Earlier results move to the shot's folder replaced: {work}." if work else question
    if not work:
        return ""
    return f"{folder.name} contains results. Importing other frames moves them to the shot's folder replaced: {work}."


CLASSES = (
    SPLANNEQUIN_OT_use_clip,
    SPLANNEQUIN_OT_use_movie_clip,
    SPLANNEQUIN_PT_movie_clip,
    SPLANNEQUIN_FH_video,
    SPLANNEQUIN_OT_import_clip,
)
