"""Records of the time and memory that tasks took, for `farm measure`: one small file per task in the shot."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..contract import JobError, ShotFolder, computer_name, read_json, write_json


def write(shot: Path, step: str, t_star: str, first: int, frames: int, amount: float, began: float) -> None:
    """Writes the record of the task that ends now, over an earlier one of the same task. Ignores failed writes.

    Args:
        shot: the shot folder.
        step: step of the template.
        t_star: instant of its take, as in the template; empty: none.
        first: first frame of its part; ignored if `frames` is 0.
        frames: number of frames in its part; 0: the step has no parts.
        amount: amount of work, in the units of `work.Step.amounts`.
        began: time at which this process began, seconds since the epoch.
    """
    times = os.times()
    data: dict[str, Any] = {
        "version": 1,
        "step": step,
        "t_star": t_star,
        "first": first if frames else 0,
        "frames": frames,
        "ended": time.time(),
        "amount": amount,
        "seconds": round(time.time() - began, 3),
        "cpu_seconds": round(times.user + times.system + times.children_user + times.children_system, 3),
        "memory_mib": _peak_mib(),
        "host": computer_name(),
        "cores": os.cpu_count(),
    }
    name = "-".join(filter(None, (step, t_star, str(first) if frames else "")))
    with contextlib.suppress(OSError, JobError):  # JobError: the folder is a link to elsewhere
        folder = ShotFolder(shot)
        write_json(folder.own(folder.farm) / f"{name}.json", data)


def read(shot: Path) -> Iterator[dict[str, Any]]:
    """Records of a shot's tasks, as `write` wrote them; damaged files are skipped."""
    for path in sorted(ShotFolder(shot).farm.glob("*.json")):
        with contextlib.suppress(OSError, ValueError):
            yield read_json(path)


def _peak_mib() -> int:
    """Peak memory of this process or of one of its children, in MiB; 0 if the system does not report it."""
    if sys.platform == "win32":
        return 0
    import resource

    most = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return int(most / (1024 * 1024 if sys.platform == "darwin" else 1024))
