"""Tasks of a job, and the amount of work of each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from ..contract import PRESET_STEPS, ShotSize
from ..freeze.instant.develop import DevelopConfig
from .shots import FarmShot

STEPS = ("import", "solve", "train", "open", "freeze", "finish", "bake", "deliver")
"""Steps of a shot, in order. Each begins when all tasks of the previous one have succeeded."""
MOST_VALUES = 1024
"""Largest number of values of a task parameter in Open Job Description."""


@dataclass(frozen=True)
class Step:
    """One step of one shot."""

    shot: FarmShot
    kind: str
    """One of `STEPS`."""
    t_stars: list[str]
    """Instants, each with tasks in this step; empty: the step does not depend on takes."""
    starts: list[int]
    """First frames of the parts into which each take is split; empty: one task per take."""
    part: int
    """Frames of a part."""
    amounts: dict[int, float]
    """First frame of a part, 0 without parts -> amount of work of a task: megapixels of pictures, plus the fixed cost
    of each solved frame and training step."""

    @property
    def name(self) -> str:
        """Name of the step in the template."""
        return f"{self.shot.name}: {self.kind}"

    def sessions(self, session_tasks: int) -> int:
        """Number of sessions for all tasks, if one session has `session_tasks` tasks; 0: one session for all."""
        tasks = max(1, len(self.t_stars)) * max(1, len(self.starts))
        return -(-tasks // session_tasks) if session_tasks else 1

    def tasks(self) -> Iterator[float]:
        """The amount of work of each task."""
        for _ in self.t_stars or [""]:
            yield from (self.amounts[start] for start in self.starts or [0])


def steps_of(shot: FarmShot, part: int, bake: bool) -> list[Step]:
    """Steps that a shot still needs, in order.

    `part`: frames per task of freeze and bake. It is raised if a take would have more than 1024 tasks.
    """
    part = max(1, part, -(-shot.frames // MOST_VALUES))
    starts = list(range(shot.first, shot.last + 1, part))
    size, (wide, high) = _size(shot), take_size(shot)
    megapixels = wide * high / 1e6
    lengths = {start: min(part, shot.last + 1 - start) for start in starts}
    frozen = {start: size.freeze_work(n, wide) for start, n in lengths.items()}
    baked = {start: n * megapixels for start, n in lengths.items()}
    full = {0: shot.frames * megapixels}
    takes = list(shot.takes)
    plain: list[tuple[str, float]] = []
    if shot.clip:
        plain.append(("import", size.import_work()))
    if not shot.solved:
        plain.append(("solve", size.solve_work()))
    if not shot.trained:
        plain.append(("train", _training(shot)))
    steps = [Step(shot, kind, [], [], part, {0: amount}) for kind, amount in plain]
    steps.append(Step(shot, "open", takes, [], part, {0: _developing(shot)}))
    steps.append(Step(shot, "freeze", takes, starts, part, frozen))
    steps.append(Step(shot, "finish", takes, [], part, full))
    if bake:
        steps.append(Step(shot, "bake", takes, starts, part, baked))
        steps.append(Step(shot, "deliver", takes, [], part, full))
    return steps


def take_size(shot: FarmShot) -> tuple[int, int]:
    """Width and height in pixels of a shot's frozen frames, without overscan."""
    width = int(shot.requests["freeze"]["width"]) or shot.source[0]
    return width, _size(shot).take_height(width)


def _size(shot: FarmShot) -> ShotSize:
    return ShotSize(shot.frames, shot.working, shot.source)


def _training(shot: FarmShot) -> float:
    params: dict[str, Any] = shot.requests["train"]
    return _size(shot).train_work(params["iterations"] or PRESET_STEPS[params["preset"]], _trained_width(shot))


def _trained_width(shot: FarmShot) -> int:
    """Width in pixels of the training images."""
    params: dict[str, Any] = shot.requests["train"]
    return _size(shot).trained_width(params["width"], params["preset"])


def _developing(shot: FarmShot) -> float:
    """Work of developing an instant; 0 if it is not developed."""
    if shot.requests["freeze"]["develop"] != "on":
        return 0.0
    usual, trained = DevelopConfig(), _trained_width(shot)
    width = min(max(usual.width, trained), shot.working[0])
    steps = round(usual.steps * max(1.0, trained / usual.width))
    return steps * width**2 * shot.working[1] / shot.working[0] / 1e6


def disk_bytes(shot: FarmShot, bake: bool) -> float:
    """Disk space of a shot's takes and of intermediate files, in bytes."""
    wide, high = take_size(shot)
    freeze = shot.requests["freeze"]
    frame_bytes = wide * high * (20.0 + (6.0 if freeze["grain"] else 0.0) + (24.0 if freeze["detail"] == "on" else 0.0))
    take_bytes = shot.frames * (frame_bytes + (3.0 * wide * high if bake else 0.0)) * len(shot.takes)
    working = shot.working[0] * shot.working[1] * 4.0 * shot.frames
    return take_bytes + (working if shot.clip else 0.0) + (0.0 if shot.trained else 100e6)
