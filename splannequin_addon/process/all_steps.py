"""Runs all steps from an imported clip to its frozen frames, one after the other.

Keeps no bpy data between timer steps, only a shot folder and names of steps.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from ..shot import selection
from . import backend, job_timer, steps

BUTTONS = {"solve": "solve_camera", "train": "train", "freeze": "freeze"}
"""Step -> its operator, in order of execution."""
_READ_SECONDS = 5.0


@dataclass
class Chain:
    """The remaining steps of a shot that are run one after the other."""

    remaining: list[str]
    """Names of the steps still to be started, in order."""
    way: contract.TotalProgress
    """Estimated durations of the steps."""
    step: str = ""
    """Name of the running step."""
    began: float = field(default_factory=time.monotonic)
    """Start time of the running step, monotonic seconds."""


_chains: dict[Path, Chain] = {}
# (paces of this machine, time when they were read in monotonic seconds).
_paces: tuple[dict[str, float], float] = ({}, 0.0)


def paces() -> dict[str, float]:
    """`contract.paces` of the backend's environment, read every few seconds."""
    global _paces  # cached, because panels ask at every redraw
    if not _paces[1] or time.monotonic() - _paces[1] > _READ_SECONDS:
        found: dict[str, float] = {}
        with contextlib.suppress(contract.JobError):
            found = contract.paces(Path(backend.python()).parents[1])
        _paces = found, time.monotonic()
    return _paces[0]


def missing(scene: bpy.types.Scene) -> list[str]:
    """Names of the steps that are still needed for frozen frames; empty before the import."""
    folder = selection.shot_folder(scene)
    state = job_timer.watch_of(folder).state if folder is not None else None
    if state is None or not state.frames:
        return []
    return [name for name in BUTTONS if not steps.STEPS[name].view(scene, state).done]


def begin(scene: bpy.types.Scene, shot: Path) -> None:
    """Starts the first missing step; the timer starts the others. Without a window, all steps have ended on return."""
    remaining = missing(scene)
    chain = _chains[shot] = Chain(remaining, contract.TotalProgress(_expected(scene, shot, remaining)))
    if not bpy.app.background:
        _begin_next(chain, scene)
        job_timer.call_until_false(lambda: _turn(shot, chain))
        return
    try:
        while chain.remaining:
            _begin_next(chain, scene)
            if _failed(job_timer.watch_of(shot), chain.step):
                return
            job_timer.refresh(job_timer.watch_of(shot))
    finally:
        stop(shot)


def stop(shot: Path) -> bool:
    """Cancels the steps of a shot that have not started. The running step continues. False if no chain was active."""
    return _chains.pop(shot, None) is not None


def progress(shot: Path) -> tuple[float, float] | None:
    """(fraction done, seconds left) of all steps of a shot together; None if no chain is active."""
    chain = _chains.get(shot)
    if chain is None:
        return None
    job = job_timer.watch_of(shot).jobs.get(chain.step)
    status = job.status if job is not None and not job.ended else None
    lasts = status is not None and status.stage in contract.LASTING_STAGES
    return chain.way.at(chain.step, time.monotonic() - chain.began, status.eta_seconds if status and lasts else None)


def _turn(shot: Path, chain: Chain) -> bool:
    """Starts the next step if the previous one succeeded. False when the chain has ended."""
    if _chains.get(shot) is not chain:
        return False
    watch = job_timer.watch_of(shot)
    if watch.running() is not None:
        return True
    scenes = selection.scenes_of(shot)
    if not scenes and selection.scenes_with(shot) and not _failed(watch, chain.step):
        return True  # until the shot is selected again
    if not scenes or not chain.remaining or _failed(watch, chain.step):
        stop(shot)
        job_timer.redraw()
        return False
    _begin_next(chain, scenes[0])
    job_timer.redraw()
    return True


def _begin_next(chain: Chain, scene: bpy.types.Scene) -> None:
    """Runs the operator of the next step. The step's panel shows any error."""
    chain.step, chain.began = chain.remaining.pop(0), time.monotonic()
    ops: Any = bpy.ops  # our operators are not in the stubs
    window = job_timer.window_of(scene) or next(iter(bpy.context.window_manager.windows), None)
    with contextlib.suppress(RuntimeError):  # raised by Blender for errors that an operator reports
        with bpy.context.temp_override(window=window, scene=scene):  # pyright: ignore[reportUnknownMemberType]
            getattr(ops.splannequin, BUTTONS[chain.step])()


def _failed(watch: job_timer.Watch, step: str) -> bool:
    job = watch.jobs.get(step)
    return step in watch.failures or job is None or job.state != "done"


def _expected(scene: bpy.types.Scene, shot: Path, names: list[str]) -> dict[str, float]:
    """Expected seconds of steps on this machine. Steps with unreadable settings are missing; their operators report the
    error."""
    found: dict[str, float] = {}
    with contextlib.suppress(contract.JobError, OSError, ValueError, KeyError):
        size, pace = contract.ShotSize.of(contract.ShotFolder(shot)), paces()
        for name in names:
            seconds = contract.expected_seconds(name, steps.STEPS[name].params(scene), size)
            found[name] = (seconds or 0.0) * pace.get(name, 1.0)
    return found
