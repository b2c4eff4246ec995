"""What the artist sets for the freeze."""

from __future__ import annotations

import bpy

from ...torch_backend import contract
from ..access import scene_holding
from ..process import job_timer
from ..properties import BoolProperty, EnumProperty, IntProperty, PointerProperty, StringProperty
from ..shot import selection
from ..translations import tr


def takes_of(props: bpy.types.bpy_struct) -> list[tuple[str, str]]:
    """(name, what it is) of the takes of the shot that `props` names, for the field's list."""
    folder = selection.shot_folder(scene_holding(props))
    state = job_timer.watch_of(folder).state if folder else None
    takes = state.takes.items() if state is not None else ()
    return [(name, tr(f"t* {take['t_star_frame']}, run {take['run']}")) for name, take in takes]


class FreezeSettings:
    """Instant, camera and take of a shot."""

    choose_t_star = BoolProperty(
        name="Choose the Instant",
        description="Set the frame at which time stands still yourself; off: the best supported one is taken",
        default=False,
        options=set(),
    )
    t_star = IntProperty(
        **contract.panel(contract.FreezeParams, "t_star", 1),
        options={"ANIMATABLE"},
    )
    path_camera = PointerProperty(
        name="Camera",
        description="Animated camera to see the frozen instant from; empty: the clip's own move",
        type=bpy.types.Object,
        poll=lambda _, item: getattr(item, "type", "") == "CAMERA",
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
    freeze_width = IntProperty(
        **contract.panel(contract.FreezeParams, "width"),
        min=0,
        max=16384,
        options=set(),
    )
    overscan = EnumProperty(
        name="Overscan",
        description="Picture beyond the frame, for the way back into the original's lens distortion. The compositor "
        "shows the frame as without it",
        items=[
            ("OFF", "Off", "Frozen frames end where the plate ends"),
            ("LENS", "What the Lens Needs", "As much more on every side as the original, distorted frame shows"),
        ],
        options=set(),
    )
    live_show = EnumProperty(
        name="Show",
        description="What is drawn over the view while scrubbing",
        items=[(name, *words) for name, words in contract.LIVE_SHOWS.items()],
        options=set(),
    )
    take_name = StringProperty(
        **contract.panel(contract.FreezeParams, "take"),
        options=set(),
        search=lambda props, context, text: takes_of(props),
        search_options={"SUGGESTION"},
    )
