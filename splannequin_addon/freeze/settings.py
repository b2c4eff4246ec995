"""Settings of the freeze."""

from __future__ import annotations

import bpy

from ...torch_backend import contract
from ..access import OneShot, scene_holding, settings_of
from ..process import job_timer
from ..properties import BoolProperty, EnumProperty, FloatProperty, IntProperty, PointerProperty, StringProperty
from ..shot import selection
from ..translations import tr


def takes_of(props: bpy.types.bpy_struct) -> list[tuple[str, str]]:
    """(name, description) of each take of the shot that `props` belongs to, for the field's search list."""
    folder = selection.shot_folder(scene_holding(props))
    state = job_timer.watch_of(folder).state if folder else None
    takes = state.takes.items() if state is not None else ()
    return [(name, tr(f"t* {take['t_star_frame']}, run {take['run']}")) for name, take in takes]


def _instant_chosen(props: OneShot, context: bpy.types.Context) -> None:
    """Update callback: the artist chose to set t*. An unset instant becomes the current frame instead of frame 1."""
    if props.choose_t_star and not props.is_property_set("t_star"):
        props.t_star = scene_holding(props).frame_current


def _instant_set(props: OneShot, context: bpy.types.Context) -> None:
    """Update callback: clamps t* to the clip's range."""
    scene = scene_holding(props)
    if props != settings_of(scene) or selection.is_switching():  # settings of a shot that is not selected
        return
    folder = selection.shot_folder(scene)
    state = job_timer.watch_of(folder).state if folder else None
    if state is not None and state.frames:
        first, last = state.frame_range
        within = min(max(props.t_star, first), last)
        if within != props.t_star:  # this assignment calls the function again
            props.t_star = within


class FreezeSettings:
    """Instant, camera and take of a shot."""

    choose_t_star = BoolProperty(
        name="Choose the Instant",
        description="Choose the frame at which time stands still; off: use the frame with the best support",
        default=False,
        options=set(),
        update=_instant_chosen,
    )
    t_star = IntProperty(
        **contract.panel(contract.FreezeParams, "t_star", 1),
        options={"ANIMATABLE"},
        update=_instant_set,
    )
    path_camera = PointerProperty(
        name="Camera",
        description="Animated camera that views the frozen instant; empty: the camera move of the clip",
        type=bpy.types.Object,
        poll=lambda _, item: getattr(item, "type", "") == "CAMERA",
        options=set(),
    )
    motion_blur = BoolProperty(
        name="Motion Blur",
        description="Add motion blur from your camera move, with the shutter of the scene's render settings. "
        "The render "
        "time of a frame grows with the length of its blur in pixels, up to 33 times",
        default=False,
        options=set(),
    )
    detail = BoolProperty(
        **contract.panel(contract.FreezeParams, "detail"),
        options=set(),
    )
    develop = BoolProperty(
        **contract.panel(contract.FreezeParams, "develop"),
        options=set(),
    )
    passes = BoolProperty(
        **contract.panel(contract.FreezeParams, "passes"),
        options=set(),
    )
    deep = BoolProperty(
        **contract.panel(contract.FreezeParams, "deep"),
        options=set(),
    )
    freeze_width = IntProperty(
        **contract.panel(contract.FreezeParams, "width"),
        min=0,
        max=16384,
        options=set(),
    )
    overscan = EnumProperty(
        name="Overscan",
        description="Image area beyond the frame, needed to restore the original's lens distortion. The "
        "compositor still "
        "shows only the frame",
        items=[
            ("OFF", "Off", "Frozen frames end where the plate ends"),
            (
                "LENS",
                "What the Lens Needs",
                "Extra image area on every side, as much as the original, distorted frame shows",
            ),
            ("PERCENT", "In Percent", "Extra image area on every side, in percent of width and height"),
        ],
        options=set(),
    )
    overscan_percent = FloatProperty(
        name="Percent",
        description="Image area beyond the frame on every side, in percent of the frame's width and height",
        default=10.0,
        min=0.0,
        max=100.0,
        options=set(),
    )
    live_show = EnumProperty(
        name="Show",
        description="What is drawn over the view while scrubbing",
        items=[(name, *words) for name, words in contract.LIVE_SHOWS.items()],
        options=set(),
    )
    matte_mask = PointerProperty(
        name="Mask",
        description="Mask drawn around a person or an object in a frozen frame. The matte gets its name",
        type=bpy.types.Mask,
        options=set(),
    )
    take_name = StringProperty(
        **contract.panel(contract.FreezeParams, "take"),
        options=set(),
        search=lambda props, context, text: takes_of(props),
        search_options={"SUGGESTION"},
    )
