"""The sidebar panel: the list of a scene's shots, the button for all steps, and the five steps."""

from __future__ import annotations

from pathlib import Path

import bpy

from ...torch_backend import contract
from ..access import Outcome, layout_of, scene_in, settings_of
from ..process import all_steps, begin, job_timer, steps
from ..properties import BoolProperty, StringProperty
from ..scene import paths
from ..shot import places, selection
from ..translations import tr
from . import folds, icons
from .sentences import wrap


class SPLANNEQUIN_UL_shots(bpy.types.UIList):
    """Shots of the scene"""

    bl_idname = "SPLANNEQUIN_UL_shots"

    def draw_item(  # pyright: ignore[reportIncompatibleMethodOverride]
        self,
        context: bpy.types.Context,
        layout: bpy.types.UILayout,
        data: bpy.types.AnyType,
        item: bpy.types.AnyType,
        icon: int,
        active_data: bpy.types.AnyType,
        active: str,
        index: int,
    ) -> None:
        """Draws a shot's name, with an icon that shows whether a step is running."""
        one = selection.settings(scene_in(context))[index]
        folder = selection.folder_of(one)
        running = job_timer.watch_of(folder).running() if folder is not None else None
        layout.label(
            text=selection.labels(scene_in(context))[index],
            icon="SORTTIME" if running else "FILE_MOVIE",
            translate=False,
        )


class SPLANNEQUIN_OT_shot_add(bpy.types.Operator):
    """Add another shot to this scene. Existing shots keep their settings, cameras and frames"""

    bl_idname = "splannequin.shot_add"
    bl_label = "New Shot"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Disabled while the selected shot has no clip, because it is new."""
        if selection.shot_folder(scene_in(context)) is None:
            cls.poll_message_set(tr("Choose a clip for this shot first"))
            return False
        return True

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Adds a shot and selects it."""
        selection.add(scene_in(context))
        return {"FINISHED"}


class SPLANNEQUIN_OT_shot_remove(bpy.types.Operator):
    """Remove the chosen shot from the list. Its folder on disk is kept"""

    bl_idname = "splannequin.shot_remove"
    bl_label = "Remove Shot from List"
    bl_options = {"REGISTER", "UNDO"}

    things = BoolProperty(
        name="Remove Shot Data from File",
        description="Also remove its camera, points, markers and compositor group from the file",
        default=True,
        options={"SKIP_SAVE"},
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled with two or more shots."""
        if len(settings_of(scene_in(context)).shots) < 2:
            cls.poll_message_set(tr("This is the only shot of the scene"))
            return False
        return True

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> Outcome:
        """Asks whether to remove the shot's objects."""
        return context.window_manager.invoke_props_dialog(self)

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Removes the selected shot from the list."""
        scene = scene_in(context)
        folder = selection.shot_folder(scene)
        if self.things and selection.folders(scene).count(folder) > 1:
            self.report({"INFO"}, "The shot's data is kept, because another shot in the list has the same folder")
        elif self.things and folder is not None:
            for note in begin.remove_all(scene, folder):
                self.report({"INFO"}, tr(note))
        selection.remove(scene, settings_of(scene).loaded_shot)
        return {"FINISHED"}


class SPLANNEQUIN_OT_locate_shot(bpy.types.Operator):
    """Set the new location of this shot's folder. The camera, the points and the compositor's frames are updated"""

    bl_idname = "splannequin.locate_shot"
    bl_label = "Locate Shot Folder"
    bl_options = {"REGISTER", "UNDO"}

    directory = StringProperty(
        name="Folder", description="Folder of the shot, which contains shot.json", subtype="DIR_PATH"
    )
    filter_folder = BoolProperty(name="Folders", description="Show folders", default=True, options={"HIDDEN"})

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> Outcome:
        """Opens the file browser at the folder's last location."""
        folder = selection.shot_folder(scene_in(context))
        if folder is not None:
            existing = next((p for p in folder.parents if p.is_dir()), None)
            self.directory = f"{existing}/" if existing is not None else ""
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> Outcome:
        """Sets the folder if it contains a shot."""
        try:
            places.locate(scene_in(context), Path(paths.absolute(self.directory)))
        except contract.JobError as error:
            self.report({"ERROR"}, tr(f"{error.message} {error.hint}".strip()))
            return {"CANCELLED"}
        return {"FINISHED"}


class SPLANNEQUIN_PT_shots(bpy.types.Panel):
    """The chosen shot of the scene, with the five steps in it"""

    bl_label = ""
    bl_idname = "SPLANNEQUIN_PT_shots"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Splannequin"

    def draw_header(self, context: bpy.types.Context) -> None:
        """Draws the name of the selected shot."""
        chosen = settings_of(scene_in(context)).loaded_shot
        layout_of(self).label(text=selection.labels(scene_in(context))[chosen], icon="FILE_MOVIE", translate=False)

    def draw_header_preset(self, context: bpy.types.Context) -> None:
        """Draws the button that adds a shot."""
        layout_of(self).operator("splannequin.shot_add", text="", icon="ADD", emboss=False)

    def draw(self, context: bpy.types.Context) -> None:
        """Draws the list of several shots, the button for all steps, and each step."""
        layout = layout_of(self)
        if len(settings_of(scene_in(context)).shots) > 1:
            self._list(context, layout)
        self._all_steps(context, layout)
        current_step = folds.current_step(scene_in(context))
        for name, step in steps.STEPS.items():
            step.panel.draw(context, layout, name == current_step)

    def _all_steps(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        """Draws the button that runs all remaining steps up to the freeze, or their progress."""
        folder, remaining = selection.shot_folder(scene_in(context)), all_steps.missing(scene_in(context))
        if folder is None:
            return
        now = all_steps.progress(folder)
        if now is not None:
            row = layout.split(factor=0.7, align=True)
            share, left = now
            row.progress(factor=share, type="BAR", text=tr(f"All steps {100 * share:.0f} %"))
            row.operator("splannequin.cancel", text="Cancel", icon=icons.of("splannequin.cancel")).step = ""
            wrap(layout, context, f"about {contract.duration(left)} left", "INFO")
        elif len(remaining) > 1 and job_timer.watch_of(folder).running() is None:
            row = layout.row()
            row.scale_y = 1.4
            text = "Train and Freeze" if "solve" not in remaining else "Solve, Train and Freeze"
            row.operator("splannequin.all_steps", text=text, icon=icons.of("splannequin.all_steps"))

    def _list(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        props = settings_of(scene_in(context))
        row = layout.row()
        row.template_list(
            "SPLANNEQUIN_UL_shots", "", props, "shots", props, "active_shot", rows=min(len(props.shots), 5)
        )
        column = row.column(align=True)
        column.operator("splannequin.shot_add", text="", icon="ADD")
        column.operator("splannequin.shot_remove", text="", icon="REMOVE")


CLASSES = (
    SPLANNEQUIN_UL_shots,
    SPLANNEQUIN_OT_shot_add,
    SPLANNEQUIN_OT_shot_remove,
    SPLANNEQUIN_OT_locate_shot,
    SPLANNEQUIN_PT_shots,
)
