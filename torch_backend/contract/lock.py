"""One writer per shot: the content of its lock, and the error for a second writer."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from .errors import ExitCode, JobError
from .files import SHORT_JSON, checked_name, printable, read_json
from .jobs import STATUS_FILE, WORK
from .processes import computer_name, runs_still
from .shot_folder import ShotFolder
from .typed import CONTRACT_VERSION, check_version, from_dict


@dataclass
class Writer:
    """lock.json of a shot: the process that writes into it. The file exists only while a process writes."""

    host: str
    """Computer on which the process runs, as `computer_name` returns."""
    pid: int
    """Process id."""
    process_started: float
    """`Process.started` of the process."""
    kind: str
    """Kind of job."""
    job: str
    """Name of the job's folder."""
    since: float
    """Time at which the process took the lock, seconds since the epoch."""
    version: int = CONTRACT_VERSION
    """Version of this contract."""

    def works(self) -> bool:
        """True if the process lives, even if it is suspended. A process on another computer counts as alive."""
        # Processes of another computer cannot be seen from here.
        return self.host != computer_name() or runs_still(self.pid, self.process_started)


def read_writer(shot: Path) -> Writer | None:
    """Content of a shot's lock, even of a dead process; None without a lock. ValueError if the lock is damaged."""
    path = ShotFolder(shot).lock
    try:
        data = read_json(path, SHORT_JSON)
    except FileNotFoundError:
        return None
    check_version(data, str(path))
    return from_dict(Writer, data)


def is_ending(shot: Path, writer: Writer) -> bool:
    """True if the job that holds the lock has reported its end, so that it is about to release the lock."""
    try:
        status = read_json(ShotFolder(shot).jobs / checked_name(writer.job, "job") / STATUS_FILE, SHORT_JSON)
    except (OSError, ValueError):
        return False
    return status.get("state") in ("done", "failed", "cancelled") and status.get("pid") == writer.pid


def busy(shot: Path, writer: Writer) -> JobError:
    """The error for a job that finds the shot locked: which job holds it, since when, where, and what to do."""
    try:
        now, then = time.localtime(), time.localtime(writer.since)
        since = time.strftime("%H:%M" if now[:3] == then[:3] else "%Y-%m-%d %H:%M", then)
    except (OSError, OverflowError, ValueError):
        since = "an unknown time"
    what, where = WORK.get(writer.kind, "A step"), printable(writer.host.partition(" (")[0], 80)
    hint, lock = "Wait for it or cancel it.", ShotFolder(shot).lock
    if writer.host != computer_name():
        hint = f"Wait for it, or cancel it there. If {where} is certainly not working on it any more, delete {lock}."
    return JobError(f"{what} of {shot.name} has been running on {where} since {since}.", hint, ExitCode.USAGE)
