"""The panel of the Bake step."""

from __future__ import annotations

import bpy

from ..access import scene_in, settings_of
from ..ui import icons, step_panel
from . import freeze_group


class BakePanel(step_panel.StepPanel):
    """Step 5: bake."""

    title = "5  Bake"
    step = "bake"
    operator = "splannequin.bake"
    folds = "bake"

    def draw_settings(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        """The take, and the scene's frame range and step."""
        layout.prop(settings_of(scene_in(context)), "take_name")
        row = layout.row(align=True)
        row.prop(scene_in(context), "frame_start", text="First")
        row.prop(scene_in(context), "frame_end", text="Last")
        row.prop(scene_in(context), "frame_step", text="Step")

    def draw_advanced(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        """Colours, and the operators of the single parts of the step."""
        layout.prop(settings_of(scene_in(context)), "keep_colours")
        layout.prop(settings_of(scene_in(context)), "insert_at")
        softness = freeze_group.cg_softness(scene_in(context))
        if softness is not None:
            layout.prop(softness, "default_value", text="CG Softness")
        name = "splannequin.insert_freeze"
        layout.operator(name, text="Insert in Compositor Only", icon=icons.of(name))
        for name in (
            "splannequin.freeze_as_warp", "splannequin.combine_cg", "splannequin.export_for_farm",
            "splannequin.remove_shot",
        ):  # fmt: skip
            layout.operator(name, icon=icons.of(name))


PANEL = BakePanel()
