"""How long a training will take on the processor, told from its own first steps.

A step takes so long for each pixel of its image and so long for each Gaussian, however few or many there are: their
ratio is a figure of two long runs (`GAUSSIAN_PIXELS`), how long a pixel takes here is measured, and how many Gaussians
there will be is the schedule of growth. A run that ends its growth or itself early takes less.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from ..contract import duration
from ..gaussians import Densifier
from .config import PRESETS

STEPS = 20
"""Steps that are timed; the first of them, in which memory is taken for the first time, counts for nothing."""
GAUSSIAN_PIXELS = 3.0
"""Time per Gaussian, in pixels that take as long. In a run that grew fast, at 640 x 360, as 3.8: 76 ms of CPU a step
with 19,000, 127 with 58,000, 180 with 122,000. In long ones they become small, and take less."""
LONG_SECONDS = 3600.0
"""A run that takes longer says so in a warning, and what would take less."""
_SAMPLES = 256


@dataclass(frozen=True)
class Outlook:
    """Steps of a run that are still to be taken."""

    pixels: int
    """Of a training image."""
    begin: int
    """Steps that are done."""
    end: int
    """Steps after which it is over."""
    gaussians: Callable[[int], float]
    """How many there are after so many steps."""

    def work(self) -> float:
        """All of those steps, in pixels."""
        steps = max(0, self.end - self.begin)
        parts = min(steps, _SAMPLES)
        at = (self.begin + int((n + 0.5) * steps / parts) for n in range(parts))
        return sum(step_work(self.pixels, self.gaussians(step)) for step in at) * steps / max(1, parts)


def step_work(pixels: int, gaussians: float) -> float:
    """What a step comes to, in pixels."""
    return pixels + GAUSSIAN_PIXELS * gaussians


class Stopwatch:
    """Times steps as they are taken, one after the other with nothing between them."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self.begin()

    def begin(self) -> None:
        """Times the next `STEPS` steps: called where something else was done."""
        self._since: float | None = None
        self._steps, self._work = 0, 0.0

    def step(self, work: float) -> float | None:
        """After a step of so much work: seconds that a pixel of it takes, when `STEPS` are done; else None."""
        self._steps += 1
        if self._since is None:
            self._since = self._clock()
            return None
        self._work += work
        return (self._clock() - self._since) / self._work if self._steps == STEPS else None


@dataclass(frozen=True)
class Alternative:
    """A preset that takes less."""

    preset: str
    """Its name."""
    seconds: float
    """That it takes."""
    width: int
    """Pixels of its training images."""


def smaller_presets(preset: str, size: tuple[int, int], initial: int, each: float) -> list[Alternative]:
    """Those that come to less than `preset`, the largest first.

    Args:
        preset: of the run.
        size: (width, height) of the working frames in pixels.
        initial: Gaussians that a run begins with, about.
        each: seconds that a pixel takes.
    """
    found: list[Alternative] = []
    for name in list(PRESETS)[: list(PRESETS).index(preset)]:
        config = PRESETS[name]()
        width = min(config.width or size[0], size[0])
        pixels = width * max(1, round(size[1] * width / size[0]))
        grown = Densifier(config.densify, 0)
        first, steps = min(initial, config.densify.budget), config.iterations

        def count(step: int, grown: Densifier = grown, first: int = first, steps: int = steps) -> float:
            return grown.target(first, step / steps)

        found.append(Alternative(name, each * Outlook(pixels, 0, steps, count).work(), width))
    return found[::-1]


def warning_of(seconds: float, width: int, resumed: bool, smaller: list[Alternative]) -> tuple[str, str] | None:
    """(sentence, hint) for a run that will take longer than `LONG_SECONDS`; None for another.

    Args:
        seconds: until it is over.
        width: pixels of its training images.
        resumed: does it go on with what was trained before?
        smaller: those that take less, the largest first.
    """
    if seconds <= LONG_SECONDS:
        return None
    long = duration(seconds)
    sentence = f"The training takes about {long} on the processor."
    if resumed:
        sentence = f"The training takes about {long} more on the processor."
    less = "A smaller width or fewer Gaussians take less."
    if smaller:
        other = next((row for row in smaller if row.seconds <= LONG_SECONDS), smaller[-1])
        takes = duration(other.seconds)
        less = f"The preset {other.preset} would take about {takes}."
        if other.width >= width:  # then more steps are all that it saves: on one clip of 640 pixels they gained nothing
            less = f"The preset {other.preset} would take about {takes} on pictures of the same size."
    kept = "It can be paused at any time and goes on where it stopped."
    return sentence, f"{kept} {less}"
