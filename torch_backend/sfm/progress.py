"""Combines the stages of a solve into one progress bar with one estimate of the remaining time."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ..contract import FORECAST, Reporter

WHOLE = "solve"
"""Name of the single stage that is reported."""
WORDS = {
    "start": "Starting: {}",
    "masks": "Reading masks: {}",
    "lens": "Undistorting first: {}",
    "features": "Finding features: {}",
    "matches": "Matching frames: {}",
    "cameras": "Placing cameras: {}",
    "other features": "Features of the other frames: {}",
    "other matches": "Matching the other frames: {}",
    "undistort": "Undistorting frames: {}",
    "still world": "Learning what stands still: {}",
    "motion": "Finding what moves: {}",
}
"""Stages in order, without "solve: ", and their messages; {} is replaced by the progress within the stage."""
_PIXELS = 640 * 480
"""Size of the frames that the weights were measured with."""
# Share of the bar and seconds before the first estimate of the remaining time; an earlier one would be a guess.
_LEAST_SHARE, _LEAST_SECONDS = 0.03, 3.0
_INTERVAL = 2.0
"""Seconds between two estimates."""


def weights_of(frames: Mapping[str, Any]) -> dict[str, float]:
    """Approximate duration of each stage in seconds on two cores, for a frames.json; includes skipped stages.

    Only the ratios count. They were measured on the bundled clip (74 frames of 640 x 480, all of them solved).
    """
    listed = frames["frames"]
    total, solved = len(listed), sum(bool(row["solve"]) for row in listed)
    size = float(frames["width"]) * float(frames["height"]) / _PIXELS
    unsolved = total - solved
    return {
        "start": 0.0,
        "masks": 0.0,
        "lens": 0.0,
        "features": 0.27 * size * solved,
        "matches": 0.15 * solved,
        "cameras": 0.32 * solved,
        "other features": 0.27 * size * unsolved,
        "other matches": 0.1 * unsolved,
        "undistort": 0.04 * size * total,
        "still world": 0.03 * max(400.0, 2.0 * total),  # seconds per training step, times the number of steps
        "motion": 0.26 * total,  # without the optical flow that runs during "still world"
    }


class OneBar:
    """A reporter that shows the stages of a solve as one stage whose share never decreases.

    The bar jumps over a skipped stage. If a stage repeats in a retry, it shares the rest of the bar with the stages
    that follow.
    """

    def __init__(
        self, report: Reporter, weights: Mapping[str, float], clock: Callable[[], float] = time.monotonic
    ) -> None:
        """`weights`: see `weights_of`. `clock` returns seconds."""
        self._report, self._clock = report, clock
        self._order = list(weights)
        self._weights = weights
        self._stage: str = ""
        self._share = 0.0
        """Share of the stage that is done."""
        self._bar = 0.0
        """Share of the solve that is done."""
        self._entered = (0.0, 0.0)
        """Values of `_bar` and `_share` when the stage began."""
        self._worked = 0.0
        """Weight of all work before this stage, including failed attempts."""
        self._began = clock()
        self._reported = self._began

    def progress(self, stage: str, done: float, total: float, message: str = "") -> None:
        """Reports a stage's progress as progress of the solve. A stage not in `weights` changes only the message."""
        name = stage.removeprefix(f"{WHOLE}: ")
        if name not in self._weights:
            self._report.progress(WHOLE, self._bar, 1.0, message)
            return
        share = min(max(done / total, 0.0), 1.0) if total > 0 else 0.0
        begins = name != self._stage
        if begins:
            self._worked += self._work_in_stage()
            self._stage, self._entered = name, (self._bar, share)
            self._share = share
        self._share = max(self._share, share)
        left = self._left()
        remaining = self._work_in_stage() + left
        if remaining > 0.0:
            self._bar = max(self._bar, 1.0 - (1.0 - self._entered[0]) * left / remaining)
        self._forecast(left, begins)
        self._report.progress(WHOLE, self._bar, 1.0, WORDS[name].format(message or "begins"))

    def _work_in_stage(self) -> float:
        """Weight of the work since the stage began."""
        return self._weights[self._stage] * (self._share - self._entered[1]) if self._stage else 0.0

    def _left(self) -> float:
        """Weight of the remaining work, if the solve is not retried."""
        after = self._order[self._order.index(self._stage) + 1 :]
        return self._weights[self._stage] * (1.0 - self._share) + sum(self._weights[name] for name in after)

    def _forecast(self, left: float, is_due: bool) -> None:
        """Reports the remaining time, extrapolated from the pace so far."""
        now, worked = self._clock(), self._worked + self._work_in_stage()
        if worked < _LEAST_SHARE * (worked + left) or now - self._began < _LEAST_SECONDS:
            return
        if is_due or now - self._reported >= _INTERVAL:
            self._reported = now
            self.metric(FORECAST, {"of": WHOLE, "seconds_left": round((now - self._began) / worked * left, 1)})

    def metric(self, stage: str, values: Mapping[str, Any]) -> None:
        """Forwards to the wrapped reporter."""
        self._report.metric(stage, values)

    def image(self, label: str, path: str | Path) -> None:
        """Forwards to the wrapped reporter."""
        self._report.image(label, path)

    def warning(self, message: str, hint: str = "") -> None:
        """Forwards to the wrapped reporter."""
        self._report.warning(message, hint)

    def check_cancelled(self) -> None:
        """Forwards to the wrapped reporter."""
        self._report.check_cancelled()
