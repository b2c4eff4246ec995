"""How long jobs will take on this machine, by how much there is to do and how fast its earlier jobs were.

Work is counted in megapixels of pictures, to which is added what a picture costs whatever its size. The farm's estimate
counts in the same unit.
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
"""In the notes of the backend's environment, which is this machine's: kind of job -> its last paces."""
VERSION = 1
PER_STEP, PER_SOLVED = 0.16, 0.13
"""Fixed cost of a training step and of a solved frame, in megapixels; measured, see docs/farm.md."""
PER_WORKING, FIRST_FRAMES = 3.6, 3.5
"""Cost of a megapixel of working frames, at whose size masks and visibility are computed, in megapixels of frozen
frames; and that of a take's first frame, which reads most plates first, in frames. From "What a frame costs" in
docs/benchmarks.md."""
_SECONDS = {"import": (1.0, 0.18), "solve": (3.0, 1.7), "train": (3.0, 0.116), "freeze": (15.0, 0.28)}
"""Kind of job -> seconds whatever there is to do, seconds per unit of work: `sitting.mp4` on two cores of an EPYC."""
BEGINS_WITH = {"import": "import", "solve": "solve", "train": "training", "freeze": "developing"}
"""Kind of job -> the stage by which one that begins from nothing is known: it reports its first percents."""
LASTING_STAGES = ("solve", "training", "freezing")
"""Stages that last until a job's end, so that their estimate is the job's."""
_OVERDUE = 0.1
"""Share of the time it took so far that a job which has outlasted its expected seconds is expected to take yet."""
_BEGUN_BEFORE = 0.5
"""Share of its expected seconds under which a job is taken to have gone on with earlier work: its pace says nothing."""
_KEPT, _LEAST_SECONDS, _FACTORS = 8, 5.0, (0.01, 100.0)
"""Paces that are kept of a kind; expected seconds under which a job says nothing of the machine; paces believed."""


@dataclass(frozen=True)
class ShotSize:
    """What the work on a shot depends on."""

    frames: int
    """Of the clip's range."""
    working: tuple[int, int]
    """Width and height of the working frames in pixels."""
    source: tuple[int, int]
    """Width and height of the footage in pixels."""

    @classmethod
    def of(cls, shot: ShotFolder) -> ShotSize:
        """An imported shot's. OSError or ValueError if there is no listing of frames that can be read."""
        listing = read_json(shot.listing)
        try:
            working = int(listing["width"]), int(listing["height"])
            source = listing.get("source_size") or working
            return cls(len(listing["frames"]), working, (int(source[0]), int(source[1])))
        except (KeyError, TypeError, IndexError) as error:
            raise ValueError(f"{shot.listing} lists no frames: {error}") from error

    @property
    def megapixels(self) -> float:
        """Of a working frame."""
        return self.working[0] * self.working[1] / 1e6

    def import_work(self) -> float:
        """Work of an import."""
        return self.frames * self.source[0] * self.source[1] / 1e6

    def solve_work(self) -> float:
        """Work of a solve."""
        return self.frames * (self.megapixels + PER_SOLVED)

    def train_work(self, steps: int, width: int) -> float:
        """Work of so many training steps on pictures of a width in pixels."""
        return steps * (width**2 * self.working[1] / self.working[0] / 1e6 + PER_STEP)

    def freeze_work(self, frames: int, width: int) -> float:
        """Work of frozen frames of a width in pixels, in one part."""
        each = width * self.take_height(width) / 1e6
        return frames * each + (frames + FIRST_FRAMES) * PER_WORKING * self.megapixels

    def take_height(self, width: int) -> int:
        """Pixels down a frozen frame that is so wide, without overscan."""
        return max(16, round(self.source[1] * width / self.source[0]))

    def trained_width(self, width: int, preset: str) -> int:
        """Width in pixels of a training's pictures; `width`: as configured, 0 for the preset's."""
        return min(width or PRESET_WIDTHS[preset] or self.working[0], self.working[0])


def expected_seconds(kind: str, params: Any, size: ShotSize) -> float | None:
    """Seconds that a job takes at the usual pace, begun from nothing; None of kinds that nothing is known of.

    Args:
        kind: of job.
        params: its dataclass of parameters.
        size: the shot's.
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
    """Notes in the backend's environment what a job took. A short one teaches nothing, nor does an environment without
    notes, which was not set up for us."""
    if expected < _LEAST_SECONDS or not (environment / SETUP_NOTES).is_dir():
        return
    known = _read(environment)
    known[kind] = [*known.get(kind, []), round(seconds / expected, 4)][-_KEPT:]
    with contextlib.suppress(OSError):  # a full or read-only disk is no reason to fail a job that was done
        write_json(environment / SETUP_NOTES / PACES_FILE, {"version": VERSION, "paces": known})


def paces(environment: Path) -> dict[str, float]:
    """Kind of job -> how many times the expected seconds the machine's earlier jobs took, their median."""
    return {kind: statistics.median(values) for kind, values in _read(environment).items()}


def _read(environment: Path) -> dict[str, list[float]]:
    try:
        told = read_json(environment / SETUP_NOTES / PACES_FILE, SHORT_JSON)
    except (OSError, ValueError):
        return {}
    found: dict[str, list[float]] = {}
    rows = told.get("paces") if told.get("version") == VERSION else None
    for kind, values in rows.items() if is_json_object(rows) else ():
        listed = cast(list[Any], values) if isinstance(values, list) else []
        numbers = [float(v) for v in listed if isinstance(v, int | float) and _FACTORS[0] <= v <= _FACTORS[1]]
        if kind in _SECONDS and numbers:
            found[kind] = numbers[-_KEPT:]
    return found


class WholeWay:
    """Jobs that run one after the other, as one bar with one estimate."""

    def __init__(self, expected: Mapping[str, float], spent: float = 0.0) -> None:
        """`expected`: kind of job -> its seconds, in order; `spent`: seconds of what came before them."""
        self._expected, self._earlier = dict(expected), spent
        self._kind, self._spent = "", 0.0
        self._measured = (0.0, 0.0)
        """Seconds of the jobs that have ended: as expected, and as they were."""
        self._share = 0.0

    def at(self, kind: str, spent: float, left: float | None) -> tuple[float, float]:
        """(share that is done, which never falls; seconds left of all) while a job runs.

        What follows is expected at the pace of what was done, so that a busy machine is noticed.

        Args:
            kind: the job's.
            spent: seconds since it began.
            left: seconds that it still takes by its own estimate; None where it has none.
        """
        if kind != self._kind:
            self._end_job()
            self._kind = kind
        self._spent = spent
        mine = self._expected.get(kind, 0.0)
        expected, actual = self._measured
        rest = left
        if rest is None:
            mean = mine * (actual / expected if expected > 0.0 else 1.0)
            rest = max(mean - spent, _OVERDUE * max(mean, spent))
        if spent + rest >= _BEGUN_BEFORE * mine:
            expected, actual = expected + mine, actual + spent + rest
        pace = actual / expected if expected > 0.0 else 1.0
        order = list(self._expected)
        follows = order[order.index(kind) + 1 :] if kind in self._expected else []
        left_of_all = rest + pace * sum(self._expected[each] for each in follows)
        done = self._earlier + spent
        self._share = max(self._share, done / max(done + left_of_all, 1e-9))
        return self._share, left_of_all

    def _end_job(self) -> None:
        mine = self._expected.get(self._kind, 0.0)
        if mine > 0.0 and self._spent >= _BEGUN_BEFORE * mine:
            expected, actual = self._measured
            self._measured = expected + mine, actual + self._spent
        self._earlier += self._spent


def duration(seconds: float) -> str:
    """A duration for people: "45 s", "3 min", "1.5 h"."""
    if seconds < 90.0:
        return f"{max(1, round(seconds))} s"
    return f"{round(seconds / 60.0)} min" if seconds < 5400.0 else f"{math.floor(seconds / 360.0 + 0.5) / 10:g} h"
