"""One writer per shot: what its lock says, and what the second one who would write is told."""

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
    """lock.json of a shot: who writes into it. There is none while nobody does."""

    host: str
    """Computer that it runs on, as `computer_name` says."""
    pid: int
    """Its process."""
    process_started: float
    """`Process.started` of it."""
    kind: str
    """Kind of job."""
    job: str
    """Name of the job's folder."""
    since: float
    """When it took the shot, seconds since the epoch."""
    version: int = CONTRACT_VERSION
    """Version of this contract."""

    def works(self) -> bool:
        """True if its process lives, stopped or not. That of another computer is never said not to."""
        return self.host != computer_name() or runs_still(self.pid, self.process_started)


def read_writer(shot: Path) -> Writer | None:
    """Who writes into a shot, as its lock says, dead or alive; None without a lock. ValueError on a damaged one."""
    path = ShotFolder(shot).lock
    try:
        data = read_json(path, SHORT_JSON)
    except FileNotFoundError:
        return None
    check_version(data, str(path))
    return from_dict(Writer, data)


def gives_back(shot: Path, writer: Writer) -> bool:
    """True if the job that holds the shot has told its end: it lets go of the lock in a moment."""
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
        hint = f"Wait for it or cancel it there. If {where} surely works on it no longer, delete {lock}."
    return JobError(f"{what} of {shot.name} has been running on {where} since {since}.", hint, ExitCode.USAGE)
