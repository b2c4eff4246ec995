"""Estimates how long jobs take on this machine, from their amount of work and the speed of earlier jobs.

The unit of work is a megapixel of pictures. The fixed cost of each picture is added in the same unit. The farm's
estimate uses this unit, too.
"""

from __future__ import annotations

import contextlib
import math
import statistics
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from .files import SHORT_JSON, is_json_object, read_json
from .installed import SETUP_NOTES
from .option_choices import PRESET_STEPS, PRESET_WIDTHS
from .shot_folder import ShotFolder
from .take_options import FreezeParams
from .train_options import TrainParams
from .writing import write_json

PACES_FILE = "paces.json"
"""File in the `SETUP_NOTES` folder of the backend's environment: kind of job -> its last paces on this machine. A
pace is the ratio of actual to expected seconds."""
VERSION = 1
PER_STEP, PER_SOLVED = 0.16, 0.13
"""Fixed cost of a training step and of a solved frame, in megapixels; measured, see docs/farm.md."""
PER_WORKING, FIRST_FRAMES = 3.6, 3.5
"""Cost of a megapixel of working frames, at whose size masks and visibility are computed, in megapixels of frozen
frames; extra cost of a take's first frame, which loads most plates, in frames. From "What a frame costs" in
docs/benchmarks.md."""
# Kind of job -> (fixed seconds, seconds per unit of work), for `sitting.mp4` on two cores of an EPYC.
_SECONDS = {"import": (1.0, 0.18), "solve": (3.0, 1.7), "train": (3.0, 0.116), "freeze": (15.0, 0.28)}
BEGINS_WITH = {"import": "import", "solve": "solve", "train": "training", "freeze": "developing"}
"""Kind of job -> its first stage. A job that reports the first percents of this stage started from nothing."""
LASTING_STAGES = ("solve", "training", "freezing")
"""Stages that last until the end of a job, so that their estimate is also the job's."""
# A job that exceeds its expected seconds is expected to take this share of its elapsed time in addition.
_OVERDUE = 0.1
# A job that takes less than this share of its expected seconds has reused earlier work: its pace is ignored.
_BEGUN_BEFORE = 0.5
# Paces kept per kind; fewest expected seconds of a job whose pace counts; range of plausible paces.
_KEPT, _LEAST_SECONDS, _FACTORS = 8, 5.0, (0.01, 100.0)


@dataclass(frozen=True)
class ShotSize:
    """Sizes that determine the amount of work on a shot."""

    frames: int
    """Number of frames in the clip's range."""
    working: tuple[int, int]
    """Width and height of the working frames in pixels."""
    source: tuple[int, int]
    """Width and height of the footage in pixels."""

    @classmethod
    def of(cls, shot: ShotFolder) -> ShotSize:
        """Size of an imported shot. OSError or ValueError if its listing of frames cannot be read."""
        listing = read_json(shot.listing)
        try:
            working = int(listing["width"]), int(listing["height"])
            source = listing.get("source_size") or working
            return cls(len(listing["frames"]), working, (int(source[0]), int(source[1])))
        except (KeyError, TypeError, IndexError) as error:
            raise ValueError(f"{shot.listing} lists no frames: {error}") from error

    @property
    def megapixels(self) -> float:
        """Megapixels of a working frame."""
        return self.working[0] * self.working[1] / 1e6

    def import_work(self) -> float:
        """Work of an import."""
        return self.frames * self.source[0] * self.source[1] / 1e6

    def solve_work(self) -> float:
        """Work of a solve."""
        return self.frames * (self.megapixels + PER_SOLVED)

    def train_work(self, steps: int, width: int) -> float:
        """Work of `steps` training steps on pictures `width` pixels wide."""
        return steps * (width**2 * self.working[1] / self.working[0] / 1e6 + PER_STEP)

    def freeze_work(self, frames: int, width: int) -> float:
        """Work of one part of a take: `frames` frozen frames, `width` pixels wide."""
        megapixels = width * self.take_height(width) / 1e6
        return frames * megapixels + (frames + FIRST_FRAMES) * PER_WORKING * self.megapixels

    def take_height(self, width: int) -> int:
        """Height in pixels of a frozen frame `width` pixels wide, without overscan."""
        return max(16, round(self.source[1] * width / self.source[0]))

    def trained_width(self, width: int, preset: str) -> int:
        """Width in pixels of the training images; `width`: as configured, 0 for the preset's."""
        return min(width or PRESET_WIDTHS[preset] or self.working[0], self.working[0])


def expected_seconds(kind: str, params: Any, size: ShotSize) -> float | None:
    """Seconds that a job from nothing takes at the usual pace; None for a kind without an estimate.

    Args:
        kind: kind of job.
        params: its dataclass of parameters.
        size: size of the shot.
    """
    if kind not in _SECONDS:
        return None
    work = size.import_work() if kind == "import" else size.solve_work()
    if isinstance(params, TrainParams):
        steps = params.iterations or PRESET_STEPS[params.preset]
        work = size.train_work(steps, size.trained_width(params.width, params.preset))
    elif isinstance(params, FreezeParams):
        frames = size.frames
        if params.first is not None and params.last is not None:
            frames = params.last - params.first + 1
        work = size.freeze_work(max(1, frames // max(1, params.step)), params.width or size.source[0])
    fixed, per_unit = _SECONDS[kind]
    return fixed + per_unit * work


def learn_pace(environment: Path, kind: str, seconds: float, expected: float) -> None:
    """Stores the pace of a job in the backend's environment. Ignores short jobs. An environment without a `SETUP_NOTES`
    folder was not set up by Splannequin and is left unchanged."""
    if expected < _LEAST_SECONDS or not (environment / SETUP_NOTES).is_dir():
        return
    known = _read(environment)
    known[kind] = [*known.get(kind, []), round(seconds / expected, 4)][-_KEPT:]
    with contextlib.suppress(OSError):  # a full or read-only disk must not fail a finished job
        write_json(environment / SETUP_NOTES / PACES_FILE, {"version": VERSION, "paces": known})


def paces(environment: Path) -> dict[str, float]:
    """Kind of job -> median pace of the machine's earlier jobs (ratio of actual to expected seconds)."""
    return {kind: statistics.median(values) for kind, values in _read(environment).items()}


def _read(environment: Path) -> dict[str, list[float]]:
    try:
        record = read_json(environment / SETUP_NOTES / PACES_FILE, SHORT_JSON)
    except (OSError, ValueError):
        return {}
    found: dict[str, list[float]] = {}
    rows = record.get("paces") if record.get("version") == VERSION else None
    for kind, values in rows.items() if is_json_object(rows) else ():
        listed = cast(list[Any], values) if isinstance(values, list) else []
        numbers = [float(v) for v in listed if isinstance(v, int | float) and _FACTORS[0] <= v <= _FACTORS[1]]
        if kind in _SECONDS and numbers:
            found[kind] = numbers[-_KEPT:]
    return found


class TotalProgress:
    """Progress and estimate of several jobs that run one after the other."""

    def __init__(self, expected: Mapping[str, float], spent: float = 0.0) -> None:
        """`expected`: kind of job -> its expected seconds, in order; `spent`: seconds spent before these jobs."""
        self._expected, self._earlier = dict(expected), spent
        self._kind, self._spent = "", 0.0
        self._measured = (0.0, 0.0)
        """Expected and actual seconds of the jobs that have ended."""
        self._share = 0.0

    def at(self, kind: str, spent: float, left: float | None) -> tuple[float, float]:
        """(finished share, which never decreases; seconds left) of all jobs while one of them runs.

        Args:
            kind: kind of the running job.
            spent: seconds since this job began.
            left: seconds left by the job's own estimate; None if it has none.
        """
        if kind != self._kind:
            self._end_job()
            self._kind = kind
        self._spent = spent
        expected_of_job = self._expected.get(kind, 0.0)
        expected, actual = self._measured
        remaining = left
        if remaining is None:
            mean = expected_of_job * (actual / expected if expected > 0.0 else 1.0)
            remaining = max(mean - spent, _OVERDUE * max(mean, spent))
        if spent + remaining >= _BEGUN_BEFORE * expected_of_job:
            expected, actual = expected + expected_of_job, actual + spent + remaining
        # Later jobs run at the pace of the jobs so far, which takes a busy machine into account.
        pace = actual / expected if expected > 0.0 else 1.0
        order = list(self._expected)
        follows = order[order.index(kind) + 1 :] if kind in self._expected else []
        total_left = remaining + pace * sum(self._expected[name] for name in follows)
        done = self._earlier + spent
        self._share = max(self._share, done / max(done + total_left, 1e-9))
        return self._share, total_left

    def _end_job(self) -> None:
        expected_of_job = self._expected.get(self._kind, 0.0)
        if expected_of_job > 0.0 and self._spent >= _BEGUN_BEFORE * expected_of_job:
            expected, actual = self._measured
            self._measured = expected + expected_of_job, actual + self._spent
        self._earlier += self._spent


def duration(seconds: float) -> str:
    """A duration for people: "45 s", "3 min", "1.5 h"."""
    if seconds < 90.0:
        return f"{max(1, round(seconds))} s"
    return f"{round(seconds / 60.0)} min" if seconds < 5400.0 else f"{math.floor(seconds / 360.0 + 0.5) / 10:g} h"
