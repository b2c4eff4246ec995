"""Training times of presets on this machine, estimated from the shot's runs. No bpy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ...torch_backend import contract
from ..shot.shot_state import ShotState


@dataclass(frozen=True)
class Cost:
    """Cost of a training with a preset."""

    preset: str
    """preview, standard or final."""
    width: int
    """Width in pixels of the training images; 0 before the import, if it is the width of the working frames."""
    steps: int
    """Training steps."""
    seconds: float | None
    """Estimated duration; None without any measured time."""
    measured: bool
    """True if a run of this preset was timed, False if `seconds` is scaled from another run's pixels and steps."""


def costs(state: ShotState | None, pace: float | None = None) -> tuple[list[Cost], dict[str, Any] | None]:
    """(cost of every preset, run that the estimate is based on, or None without a timed run).

    Without such a run, the estimate uses `pace` of this machine's earlier trainings (`contract.paces`).
    """
    timed = sorted((r for r in state.runs.values() if _per_step(r)), key=_size) if state is not None else []
    # A step of a static run is several times faster.
    timed = [run for run in timed if run.get("method") != "static"] or timed
    across = state.size[0] if state is not None else 0
    rows: list[Cost] = []
    for preset, steps in contract.PRESET_STEPS.items():
        width = contract.PRESET_WIDTHS[preset] or across
        width = min(width, across) if across else width
        same = [run for run in timed if run.get("preset") == preset]
        if preset == "final" and same and same[-1].get("device") == "cuda":
            width = same[-1]["width_px"]  # on a graphics card it may exceed the working frames' width
        same_width = [run for run in same if run.get("width_px") == width]
        nearest = same_width[-1:] or timed[-1:]
        seconds = None
        for run in nearest:
            seconds = steps * _per_step(run) * (width / run["width_px"]) ** 2
        if not nearest and pace is not None and state is not None and state.frames:
            size = contract.ShotSize(state.frames, state.size, state.size)
            expected = contract.expected_seconds("train", contract.TrainParams(preset=preset), size)
            seconds = None if expected is None else pace * expected
        rows.append(Cost(preset, width, steps, seconds, bool(same_width)))
    return rows, timed[-1] if timed else None


def _size(run: dict[str, Any]) -> tuple[int, int]:
    """Sort key of runs: larger and longer runs give better estimates for other runs."""
    return run["width_px"], run["iterations"]


def _per_step(run: dict[str, Any]) -> float:
    """Seconds per step of a run; 0 if its figures are missing."""
    spent, steps, width = run.get("train_seconds"), run.get("iterations"), run.get("width_px")
    if not all(isinstance(n, int | float) and n > 0 for n in (spent, steps, width)):
        return 0.0
    return float(spent) / float(steps)  # type: ignore[arg-type]
