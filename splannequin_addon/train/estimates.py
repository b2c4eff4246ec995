"""What a preset costs on this machine, from what the shot's own runs took. No bpy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ...torch_backend import contract
from ..shot.shot_state import ShotState


@dataclass(frozen=True)
class Cost:
    """What training with a preset comes to."""

    preset: str
    """preview, standard or final."""
    width: int
    """Width in pixels of the training images; 0: the working frames', of which nothing is known yet."""
    steps: int
    """Training steps."""
    seconds: float | None
    """How long it takes; None if nothing was timed yet."""
    measured: bool
    """A run of this preset was timed; else `seconds` is based on pixels and steps of another's."""


def costs(state: ShotState | None, pace: float | None = None) -> tuple[list[Cost], dict[str, Any] | None]:
    """The cost of every preset, and the run that it was estimated from, None if the shot has none that was timed.

    Without such a run it is estimated from `pace`, that of this machine's earlier trainings (`contract.paces`).
    """
    timed = sorted((r for r in state.runs.values() if _per_step(r)), key=_size) if state is not None else []
    # Where nothing may move a step is several times as fast.
    timed = [run for run in timed if run.get("method") != "static"] or timed
    across = state.size[0] if state is not None else 0
    rows: list[Cost] = []
    for preset, steps in contract.PRESET_STEPS.items():
        width = contract.PRESET_WIDTHS[preset] or across
        width = min(width, across) if across else width
        same = [run for run in timed if run.get("preset") == preset]
        if preset == "final" and same and same[-1].get("device") == "cuda":
            width = same[-1]["width_px"]  # a card's may be finer than the working frames
        own = [run for run in same if run.get("width_px") == width]
        nearest = own[-1:] or timed[-1:]
        seconds = None
        for run in nearest:
            seconds = steps * _per_step(run) * (width / run["width_px"]) ** 2
        if not nearest and pace is not None and state is not None and state.frames:
            size = contract.ShotSize(state.frames, state.size, state.size)
            expected = contract.expected_seconds("train", contract.TrainParams(preset=preset), size)
            seconds = None if expected is None else pace * expected
        rows.append(Cost(preset, width, steps, seconds, bool(own)))
    return rows, timed[-1] if timed else None


def _size(run: dict[str, Any]) -> tuple[int, int]:
    """Sort key of runs: the time of a larger and longer run predicts that of other runs best."""
    return run["width_px"], run["iterations"]


def _per_step(run: dict[str, Any]) -> float:
    """Seconds a step of a run took; 0 if its figures do not tell."""
    spent, steps, width = run.get("train_seconds"), run.get("iterations"), run.get("width_px")
    if not all(isinstance(n, int | float) and n > 0 for n in (spent, steps, width)):
        return 0.0
    return float(spent) / float(steps)  # type: ignore[arg-type]
