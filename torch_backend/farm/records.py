"""What tasks took: one small file each in the shot, to measure by (`farm measure`)."""

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
    """Writes what the task that ends now took, over what the same task took before. What cannot be written is not.

    Args:
        shot: the shot folder.
        step: of the template.
        t_star: of its take, as the template has it; empty: none.
        first: first frame of its part; with `frames` 0 of no meaning.
        frames: of its part; 0: it is made as one.
        amount: how much it had to do, as `work.Step.amounts` counts.
        began: when this process began, seconds since the epoch.
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
    """What the tasks of a shot took, as `write` wrote it; damaged files are passed over."""
    for path in sorted(ShotFolder(shot).farm.glob("*.json")):
        with contextlib.suppress(OSError, ValueError):
            yield read_json(path)


def _peak_mib() -> int:
    """Most memory that this process, or one that it started, has held, in MiB; 0 where the system does not tell."""
    if sys.platform == "win32":
        return 0
    import resource

    most = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return int(most / (1024 * 1024 if sys.platform == "darwin" else 1024))
