"""Estimates the duration of a training on the CPU from its first steps.

The time of a step is modelled as linear in its pixels and Gaussians. The ratio of the two costs is a constant
(`GAUSSIAN_PIXELS`), measured in two long runs. The time per pixel is measured on this machine, and the number of
Gaussians follows the densification schedule. A run that ends its growth early, or stops early, takes less.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from ..contract import duration
from ..gaussians import Densifier
from .config import PRESETS

STEPS = 20
"""Number of steps per measurement, with the first, untimed step in which memory is allocated."""
GAUSSIAN_PIXELS = 3.0
"""Time per Gaussian divided by time per pixel. A fast-growing run at 640 x 360 had a ratio of 3.8 (76 ms of CPU time
per step with 19,000 Gaussians, 127 with 58,000, 180 with 122,000). In long runs, Gaussians are smaller and faster."""
LONG_SECONDS = 3600.0
"""Duration in seconds above which a warning names faster settings."""
_SAMPLES = 256
"""Number of steps at which the remaining work is sampled."""


@dataclass(frozen=True)
class Outlook:
    """Remaining steps of a run."""

    pixels: int
    """Number of pixels of a training image."""
    begin: int
    """Number of finished steps."""
    end: int
    """Step at which the run ends."""
    gaussians: Callable[[int], float]
    """Step -> number of Gaussians at that step."""

    def work(self) -> float:
        """Work of the remaining steps, as an equivalent number of pixels."""
        steps = max(0, self.end - self.begin)
        parts = min(steps, _SAMPLES)
        at = (self.begin + int((n + 0.5) * steps / parts) for n in range(parts))
        return sum(step_work(self.pixels, self.gaussians(step)) for step in at) * steps / max(1, parts)


def step_work(pixels: int, gaussians: float) -> float:
    """Work of one step, as an equivalent number of pixels."""
    return pixels + GAUSSIAN_PIXELS * gaussians


class Stopwatch:
    """Times consecutive steps."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self.begin()

    def begin(self) -> None:
        """Restarts the measurement over the next `STEPS` steps. Call it after work that is not a step."""
        self._since: float | None = None
        self._steps, self._work = 0, 0.0

    def step(self, work: float) -> float | None:
        """Call it after each step. Returns seconds per unit of `work` once `STEPS` steps are done, otherwise None."""
        self._steps += 1
        if self._since is None:
            self._since = self._clock()
            return None
        self._work += work
        return (self._clock() - self._since) / self._work if self._steps == STEPS else None


@dataclass(frozen=True)
class Alternative:
    """A faster preset."""

    preset: str
    """Name of the preset."""
    seconds: float
    """Estimated duration in seconds."""
    width: int
    """Width of its training images in pixels."""


def smaller_presets(preset: str, size: tuple[int, int], initial: int, seconds_per_pixel: float) -> list[Alternative]:
    """Presets below `preset`, the largest first.

    Args:
        preset: preset of the run.
        size: (width, height) of the working frames in pixels.
        initial: approximate initial number of Gaussians.
        seconds_per_pixel: seconds per pixel.
    """
    found: list[Alternative] = []
    for name in list(PRESETS)[: list(PRESETS).index(preset)]:
        config = PRESETS[name]()
        width = min(config.width or size[0], size[0])
        pixels = width * max(1, round(size[1] * width / size[0]))
        densifier = Densifier(config.densify, 0)
        first, steps = min(initial, config.densify.budget), config.iterations

        def count(step: int, densifier: Densifier = densifier, first: int = first, steps: int = steps) -> float:
            return densifier.target(first, step / steps)

        found.append(Alternative(name, seconds_per_pixel * Outlook(pixels, 0, steps, count).work(), width))
    return found[::-1]


def warning_of(seconds: float, width: int, resumed: bool, smaller: list[Alternative]) -> tuple[str, str] | None:
    """(sentence, hint) of a warning for a run that will take longer than `LONG_SECONDS`; None for shorter runs.

    Args:
        seconds: estimated remaining time.
        width: width of the training images in pixels.
        resumed: whether the run was resumed.
        smaller: faster presets, the largest first.
    """
    if seconds <= LONG_SECONDS:
        return None
    long = duration(seconds)
    sentence = f"The training takes about {long} on the processor."
    if resumed:
        sentence = f"The training takes about {long} more on the processor."
    less = "To make it faster, reduce the width or the number of Gaussians."
    if smaller:
        alternative = next((row for row in smaller if row.seconds <= LONG_SECONDS), smaller[-1])
        takes = duration(alternative.seconds)
        less = f"The preset {alternative.preset} would take about {takes}."
        # At the same width, the preset only saves steps; on a clip 640 pixels wide, the extra steps gained nothing.
        if alternative.width >= width:
            less = f"The preset {alternative.preset} would take about {takes} on pictures of the same size."
    kept = "It can be paused at any time and continues where it stopped."
    return sentence, f"{kept} {less}"
