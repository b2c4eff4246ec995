"""Settings of the training."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...torch_backend import contract
from .. import compat
from ..access import scene_holding
from ..process import job_timer
from ..properties import EnumProperty, IntProperty, StringProperty
from ..shot import selection
from ..translations import tr

if TYPE_CHECKING:
    import bpy

PRESETS: list[tuple[str, str, str]] = contract.panel(contract.TrainParams, "preset")["items"]
"""(identifier, name, tooltip) of each preset."""


def runs_of(props: bpy.types.bpy_struct) -> list[tuple[str, str]]:
    """(name, description) of each run of the shot that `props` belongs to, for the field's search list."""
    folder = selection.shot_folder(scene_holding(props))
    state = job_timer.watch_of(folder).state if folder else None
    runs = state.runs.items() if state is not None else ()
    return [
        (name, tr(f"{run.get('heldout_psnr_db') or 0:.1f} dB, {run.get('gaussians', 0):,} Gaussians"))
        for name, run in runs
    ]


def _third_of(steps: int) -> int:
    return round(steps / 3)


def _preset_chosen(props: TrainSettings, context: bpy.types.Context) -> None:
    """Update callback: resets the number of additional steps to a third of the preset's steps."""
    props.extend_steps = _third_of(contract.PRESET_STEPS[props.preset])


class TrainSettings:
    """Preset and run of a shot."""

    preset = EnumProperty(
        **contract.panel(contract.TrainParams, "preset"),
        options=set(),
        update=_preset_chosen,
    )
    extend_steps = IntProperty(
        **contract.panel(contract.TrainParams, "extend", _third_of(contract.PRESET_STEPS["preview"])),
        min=10,
        soft_max=30_000,
        options=set(),
    )
    depth = StringProperty(
        **contract.panel(contract.TrainParams, "depth"),
        subtype="DIR_PATH",
        options=compat.PATH_OPTIONS,
    )
    run_name = StringProperty(
        **contract.panel(contract.TrainParams, "run"),
        options=set(),
        search=lambda props, context, text: runs_of(props),
        search_options={"SUGGESTION"},
    )
