"""The panel of the Freeze step."""

from __future__ import annotations

from typing import Any

import bpy

from ..access import camera_of, present, scene_in, settings_of
from ..process import steps
from ..shot import markers
from ..translations import tr
from ..ui import icons, listing, step_panel
from ..ui.sentences import wrap
from . import lights, viewport


def can_scrub(view: steps.View, running: str | None) -> bool:
    """True if scrubbing can start, and always while a session can be stopped."""
    return viewport.session() is not None or (view.ready and running is None)


class FreezePanel(step_panel.StepPanel):
    """Step 4: the freeze."""

    title = "4  Freeze"
    step = "freeze"
    operator = "splannequin.freeze"
    folds = "freeze"

    def draw_settings(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        """The instant t*."""
        props = settings_of(scene_in(context))
        row = layout.row()
        if props.choose_t_star:
            row.prop(props, "choose_t_star", text="t*")
            row.prop(props, "t_star", text="")
        else:
            at = self._suggested(context)
            words = tr(f"t*: {at}, suggested") if at is not None else tr("t* as suggested")
            row.prop(props, "choose_t_star", text=words, translate=False)
        row.operator("splannequin.t_star_here", text="", icon="EYEDROPPER")
        shown = scene_in(context).timeline_markers.get(markers.NAME) is not None
        row.operator("splannequin.t_star_marker", text="", icon="MARKER_HLT" if shown else "MARKER", depress=shown)
        watch = self._watch(context)
        if props.choose_t_star and watch is not None and watch.state is not None and watch.state.frames:
            first, last = watch.state.frame_range
            if not first <= props.t_star <= last:
                wrap(
                    layout,
                    context,
                    f"Frame {props.t_star} is outside the clip, which has frames {first} to {last}.",
                    "ERROR",
                )

    def _suggested(self, context: bpy.types.Context) -> int | None:
        """The suggested instant used if none is chosen; None until scrubbing or a freeze has determined it."""
        session, watch, props = viewport.session(), self._watch(context), settings_of(scene_in(context))
        at = (
            viewport.instant(scene_in(context))
            if session is not None and watch and session.shot == watch.shot
            else None
        )
        if at is not None:
            return round(at)
        take = watch.state.takes.get(props.take_name) if watch is not None and watch.state is not None else None
        return props.t_star if take is not None and take["t_star_frame"] == props.t_star else None

    def draw_always(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        """Scrubbing. It can be stopped in any state of the shot."""
        watch, live = self._watch(context), layout.column()
        live.enabled = can_scrub(self._view(context), watch.running() if watch else None)
        self._live(context, live)

    def draw_body(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        """The step's body, and lists of mattes and takes."""
        super().draw_body(context, layout)
        watch = self._watch(context)
        if watch is None or watch.state is None or not watch.state.listed("take"):
            return
        chosen = watch.state.takes.get(settings_of(scene_in(context)).take_name)
        body = step_panel.sub_panel(layout, "mattes", "Mattes") if chosen is not None else None
        if body is not None and chosen is not None:
            self._mattes(context, body, chosen)
        body = step_panel.sub_panel(layout, "takes", "Takes")
        if body is not None:
            listing.draw(body, "take", watch.state, settings_of(scene_in(context)).take_name)
            for damage in watch.state.damaged["take"].values():
                wrap(body, context, damage, "ERROR")
            body.operator("splannequin.add_splats", icon=icons.of("splannequin.add_splats"))
            body.operator("splannequin.add_surface", icon=icons.of("splannequin.add_surface"))
            row = body.row(align=True)
            row.operator("splannequin.add_light", icon=icons.of("splannequin.add_light"))
            if lights.find(scene_in(context), watch.shot) is not None:
                row.operator("splannequin.remove_light", text="", icon=icons.of("splannequin.remove_light"))

    def _mattes(self, context: bpy.types.Context, layout: bpy.types.UILayout, take: dict[str, Any]) -> None:
        """The mask for a new matte, and the list of mattes."""
        column = layout.column()
        column.enabled = self._idle(context)
        column.operator("splannequin.draw_matte", icon=icons.of("splannequin.draw_matte"))
        column.prop(settings_of(scene_in(context)), "matte_mask")
        column.operator("splannequin.matte_from_mask", icon=icons.of("splannequin.matte_from_mask"))
        for name, frames in take["mattes"].items():
            row = column.row(align=True)
            lassoed = ", ".join(str(frame) for frame in sorted(set(frames)))
            row.label(text=tr(f"{name}, drawn at {lassoed}"), translate=False)
            row.operator("splannequin.combine_takes", text="", icon=icons.of("splannequin.combine_takes")).name = name
            row.operator("splannequin.insert_matte", text="", icon="NODE_COMPOSITING").name = name
            row.operator("splannequin.remove_matte", text="", icon="TRASH").name = name

    def _idle(self, context: bpy.types.Context) -> bool:
        """True if no step of the shot runs."""
        watch = self._watch(context)
        return watch is not None and watch.running() is None

    def _live(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        """Scrubbing: on or off, the displayed layer, and suggestions with their reasons."""
        session = viewport.session()
        row = layout.row(align=True)
        icon = "PAUSE" if session is not None else "HIDE_OFF"
        text = "Stop Scrubbing" if session is not None else "Scrub in View"
        row.operator("splannequin.live", text=text, icon=icon, depress=session is not None)
        if session is None:
            failure = viewport.failure()
            if failure is not None:
                wrap(layout, context, f"{failure[0]} {failure[1]}".strip(), "ERROR")
            return
        row.operator("splannequin.suggested_instant", text="", icon="TRIA_LEFT").step = -1
        row.operator("splannequin.suggested_instant", text="", icon="TRIA_RIGHT").step = 1
        layout.row().prop(settings_of(scene_in(context)), "live_show", expand=True)
        wrap(layout, context, viewport.reason(scene_in(context)), "INFO")
        if viewport.note():
            wrap(layout, context, viewport.note(), "ERROR")

    def draw_advanced(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        """The take's name, contents and size, and its camera."""
        props = settings_of(scene_in(context))
        for name in ("take_name", "detail", "develop", "freeze_width", "overscan", "passes", "deep"):
            layout.prop(props, name)
        if props.overscan == "PERCENT":
            layout.prop(props, "overscan_percent")
        layout.prop(props, "path_camera")
        grid = layout.grid_flow(row_major=True, columns=2, even_columns=True, align=True)
        for name in ("smooth", "retime", "hold", "orbit"):
            grid.operator(f"splannequin.move_{name}", icon=icons.of(f"splannequin.move_{name}"))
        if props.path_camera is not None:
            row = layout.row()
            row.prop(props, "motion_blur")
            shutter = row.row()
            shutter.active = props.motion_blur
            shutter.prop(scene_in(context).render, "motion_blur_shutter")
            layout.operator("splannequin.check_move", icon=icons.of("splannequin.check_move"))
        if props.path_camera is not None and present(camera_of(props.path_camera).dof).use_dof:
            wrap(
                layout,
                context,
                "Frozen frames are sharp throughout. They do not have the camera's depth of field.",
                "INFO",
            )


PANEL = FreezePanel()
