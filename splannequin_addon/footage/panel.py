"""The panel of the Import step."""

from __future__ import annotations

import bpy

from ..access import scene_in, settings_of
from ..process import backend, steps
from ..shot import selection
from ..ui import icons, preferences, step_panel
from ..ui.sentences import wrap


class ImportPanel(step_panel.StepPanel):
    """Step 1: footage into a shot folder."""

    title = "1  Import"
    step = "import"
    operator = "splannequin.import_clip"
    folds = "footage"

    def draw_settings(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        """Clip, range, first frame number."""
        props = settings_of(scene_in(context))
        layout.prop(props, "clip", text="")
        column = layout.column()
        column.use_property_split = True  # aligns the two checkboxes behind their headings
        column.use_property_decorate = False
        row = column.row(align=True, heading="Range")
        row.prop(props, "use_range", text="")
        span = row.row(align=True)
        span.enabled = props.use_range
        span.prop(props, "first", text="")
        span.prop(props, "last", text="")
        row = column.row(align=True, heading="Start")
        row.prop(props, "use_start", text="")
        start = row.row()
        start.enabled = props.use_start
        start.prop(props, "start", text="")

    def draw_trouble(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        """Problems with the backend or the shot folder, and their solutions."""
        self._backend_trouble(context, layout)
        watch = self._watch(context)
        if watch is not None and selection.missing(scene_in(context), watch.state):
            box = layout.box()
            column = box.column(align=True)
            column.alert = True
            name = watch.shot.name
            wrap(column, context, f"The shot folder {name} was moved, renamed or deleted.", "ERROR")
            box.operator("splannequin.locate_shot", text="Locate", icon=icons.of("splannequin.locate_shot"))

    def _backend_trouble(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        """Problem with the backend, or the state of its set-up."""
        trouble, setup = backend.state()[1], preferences.running_setup()
        if setup is not None:
            wrap(layout, context, "The backend is being set up.", "IMPORT")
            for line in setup.output[-1:]:
                wrap(layout, context, line)
            layout.operator("splannequin.cancel_setup", icon=icons.of("splannequin.cancel_setup"))
        elif trouble is not None:
            box = layout.box()
            column = box.column(align=True)
            column.alert = True
            wrap(column, context, trouble.message, "ERROR")
            box.operator("splannequin.set_up", icon=icons.of("splannequin.set_up"))
            box.operator("preferences.addon_show", text="Preferences", icon="PREFERENCES").module = backend.PACKAGE

    def _label(self, context: bpy.types.Context, view: steps.View) -> str:
        watch = self._watch(context)
        gone = watch is not None and selection.missing(scene_in(context), watch.state)
        return "Import from Scratch" if gone else super()._label(context, view)

    def draw_advanced(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        """Shot folder, solved frames, colour, and the option to set up the scene."""
        props = settings_of(scene_in(context))
        layout.prop(props, "shot_path", text="Folder")
        for name in ("solve_step", "fps"):
            layout.prop(props, name)
        layout.prop(props, "colour_space", text="Space")  # the full name does not fit the sidebar's default width
        for name in ("lut", "matrix", "levels", "layer", "pixel_aspect", "set_up_scene"):
            layout.prop(props, name)


PANEL = ImportPanel()
