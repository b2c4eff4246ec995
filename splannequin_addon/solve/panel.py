"""The panel of the Solve step."""

from __future__ import annotations

import bpy

from ...torch_backend import contract
from ..access import scene_in, settings_of
from ..process import steps
from ..shot import inventory, selection
from ..ui import icons, step_panel
from ..ui.sentences import wrap
from . import align_operators, cameras, matte_operators, motion_overlay, scale


def can_load_camera(running: str | None) -> bool:
    """True unless a step is running that replaces the solve."""
    return running not in ("import", "solve")


class SolvePanel(step_panel.StepPanel):
    """Step 2: camera solve."""

    title = "2  Solve"
    step = "solve"
    operator = "splannequin.solve_camera"
    folds = "camera"

    def draw_body(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        """The step's body, masks, motion matte and alignment."""
        super().draw_body(context, layout)
        watch = self._watch(context)
        body = step_panel.sub_panel(layout, "camera_masks", "Masks")
        if body is not None:
            self._masks(context, body)
        body = step_panel.sub_panel(layout, "camera_motion", "Motion Matte")
        if body is not None:
            shown = watch is not None and motion_overlay.find(scene_in(context), watch.shot) is not None
            matte_operators.draw(body, shown)
        if watch is None or cameras.find(scene_in(context), watch.shot, "EMPTY") is None:
            return
        if not scale.scaled(scene_in(context), watch.shot):
            if scale.guessed_scale(scene_in(context), watch.shot):
                wrap(layout, context, "The scale is estimated from the camera's height.", "INFO")
            else:
                wrap(layout, context, "The scale is arbitrary. Set it if you need real-world units.", "INFO")
            layout.operator("splannequin.align_scale", icon=icons.of("splannequin.align_scale")).selected = False
        body = step_panel.sub_panel(layout, "camera_alignment", "Alignment")
        if body is not None:
            align_operators.draw(body)

    def draw_advanced(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        """The lens, the source of the cameras, and exports."""
        props = settings_of(scene_in(context))
        row = layout.row()
        row.enabled = not (props.st_map and props.cameras_from == "SOLVE")  # the map defines the lens
        row.prop(props, "camera_model")
        layout.prop(props, "focal_mm")
        if props.focal_mm > 0.0:
            for name in ("sensor_mm", "refine_focal"):
                layout.prop(props, name)
        layout.prop(props, "cameras_from", text="Cameras")
        if props.cameras_from == "SOLVE":
            layout.prop(props, "st_map")
            if props.st_map:
                for name in ("st_map_way", "st_map_layer"):
                    layout.prop(props, name)
            layout.prop(props, "retry")
        elif props.cameras_from == "FILE":
            layout.prop(props, "cameras_path", text="")
        elif props.cameras_from == "TRACKING":
            layout.prop(props, "tracking_clip", text="")
        elif props.cameras_from == "SCENE":
            layout.prop(props, "scene_camera", text="")
        for name in ("splannequin.export_cameras", "splannequin.write_stmaps"):
            layout.operator(name, icon=icons.of(name))

    def _masks(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        """The masks of ignored and of moving areas."""
        scene = scene_in(context)
        props, shot = settings_of(scene), selection.shot_folder(scene)
        if props.ignore_from in ("NONE", "FOUND") and shot is not None and inventory.burnt_in(shot) is not None:
            wrap(layout, context, "The clip has a burnt-in logo or caption.", "INFO")
            if props.ignore_from == "FOUND":
                wrap(layout, context, "It is ignored.")
            else:
                wrap(layout, context, "It is not ignored and will smear in frozen frames.")
        for kind in contract.MASK_KINDS:
            layout.prop(props, f"{kind}_from")
            shown = {"FILE": "path", "DRAWN": "drawn"}.get(getattr(props, f"{kind}_from"))
            if shown is not None:
                layout.prop(props, f"{kind}_{shown}", text="")

    def _button(
        self, context: bpy.types.Context, layout: bpy.types.UILayout, view: steps.View, running: str | None
    ) -> None:
        watch = self._watch(context)
        if view.done and watch and cameras.find(scene_in(context), watch.shot, "CAMERA") is None:
            row = layout.row()
            row.scale_y = 1.4
            row.enabled = can_load_camera(running)
            row.operator("splannequin.load_camera", icon=icons.of("splannequin.load_camera"))
            return
        super()._button(context, layout, view, running)


PANEL = SolvePanel()
