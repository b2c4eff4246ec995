"""What lies between an imported clip and its frozen frames, one step begun when the one before has ended.

Nothing of bpy is kept between two turns of the timer: only a shot folder, and names of steps.
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
"""Step -> its operator, in the order of the work."""
_READ_SECONDS = 5.0


@dataclass
class Chain:
    """The steps that are begun one after the other for a shot."""

    ahead: list[str]
    """Names of the steps still to be begun, in order."""
    way: contract.WholeWay
    """How long they take."""
    step: str = ""
    """Name of the step at work."""
    began: float = field(default_factory=time.monotonic)
    """When it began, monotonic seconds."""


_chains: dict[Path, Chain] = {}
_paces: tuple[dict[str, float], float] = ({}, 0.0)
"""Those of this machine, and when they were read, monotonic seconds."""


def paces() -> dict[str, float]:
    """As `contract.paces`, of the backend's environment; read every few seconds, since panels ask at every redraw."""
    global _paces
    if not _paces[1] or time.monotonic() - _paces[1] > _READ_SECONDS:
        found: dict[str, float] = {}
        with contextlib.suppress(contract.JobError):
            found = contract.paces(Path(backend.python()).parents[1])
        _paces = found, time.monotonic()
    return _paces[0]


def missing(scene: bpy.types.Scene) -> list[str]:
    """Names of the steps that are still to be done until there are frozen frames; empty before the import."""
    folder = selection.shot_folder(scene)
    state = job_timer.watch_of(folder).state if folder is not None else None
    if state is None or not state.frames:
        return []
    return [name for name in BUTTONS if not steps.STEPS[name].view(scene, state).done]


def begin(scene: bpy.types.Scene, shot: Path) -> None:
    """Begins the first of the missing steps; the timer begins the others. Headless, all of them are done on return."""
    ahead = missing(scene)
    chain = _chains[shot] = Chain(ahead, contract.WholeWay(_expected(scene, shot, ahead)))
    if not bpy.app.background:
        _begin_next(chain, scene)
        job_timer.meanwhile(lambda: _turn(shot, chain))
        return
    try:
        while chain.ahead:
            _begin_next(chain, scene)
            if _failed(job_timer.watch_of(shot), chain.step):
                return
            job_timer.refresh(job_timer.watch_of(shot))
    finally:
        stop(shot)


def stop(shot: Path) -> bool:
    """Begins no further step of a shot; the one at work goes on. False if none was to be begun."""
    return _chains.pop(shot, None) is not None


def progress(shot: Path) -> tuple[float, float] | None:
    """(share that is done, seconds left) of all steps of a shot together; None if they are not done as one."""
    chain = _chains.get(shot)
    if chain is None:
        return None
    job = job_timer.watch_of(shot).jobs.get(chain.step)
    status = job.status if job is not None and not job.ended else None
    lasts = status is not None and status.stage in contract.LASTING_STAGES
    return chain.way.at(chain.step, time.monotonic() - chain.began, status.eta_seconds if status and lasts else None)


def _turn(shot: Path, chain: Chain) -> bool:
    """Begins the next step if the one before has ended well. False when there is nothing more to look after."""
    if _chains.get(shot) is not chain:
        return False
    watch = job_timer.watch_of(shot)
    if watch.running() is not None:
        return True
    scenes = selection.scenes_of(shot)
    if not scenes and selection.scenes_with(shot) and not _failed(watch, chain.step):
        return True  # until the shot is chosen again
    if not scenes or not chain.ahead or _failed(watch, chain.step):
        stop(shot)
        job_timer.redraw()
        return False
    _begin_next(chain, scenes[0])
    job_timer.redraw()
    return True


def _begin_next(chain: Chain, scene: bpy.types.Scene) -> None:
    """Presses the button of the next step; what keeps it from that, its panel says."""
    chain.step, chain.began = chain.ahead.pop(0), time.monotonic()
    ops: Any = bpy.ops  # ours are not in its types
    window = job_timer.window_of(scene) or next(iter(bpy.context.window_manager.windows), None)
    with contextlib.suppress(RuntimeError):  # which is how Blender hands on what an operator reports as an error
        with bpy.context.temp_override(window=window, scene=scene):  # pyright: ignore[reportUnknownMemberType]
            getattr(ops.splannequin, BUTTONS[chain.step])()


def _failed(watch: job_timer.Watch, step: str) -> bool:
    job = watch.jobs.get(step)
    return step in watch.failures or job is None or job.state != "done"


def _expected(scene: bpy.types.Scene, shot: Path, names: list[str]) -> dict[str, float]:
    """Seconds that steps take on this machine; none of a step whose settings cannot be read, which its button says."""
    found: dict[str, float] = {}
    with contextlib.suppress(contract.JobError, OSError, ValueError, KeyError):
        size, pace = contract.ShotSize.of(contract.ShotFolder(shot)), paces()
        for name in names:
            seconds = contract.expected_seconds(name, steps.STEPS[name].params(scene), size)
            found[name] = (seconds or 0.0) * pace.get(name, 1.0)
    return found
