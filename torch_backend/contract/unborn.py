"""A shot folder before its first import: where it may be made, and how to clean up after a failed import."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path

from .errors import ExitCode, JobError
from .files import read_json
from .jobs import LOG_FILE, STATUS_FILE, Status
from .lock import read_writer
from .shot_folder import (
    FRAMES_FOLDER,
    INFO_FILE,
    JOBS_FOLDER,
    RUNS_FOLDER,
    SHOT_NAMES,
    SOLVE_FOLDER,
    TAKES_FOLDER,
    ShotFolder,
)
from .typed import from_dict

_UNBORN = {INFO_FILE, JOBS_FOLDER, FRAMES_FOLDER}
"""Files that a failed import may leave in a shot folder."""
_WORK = {SOLVE_FOLDER, RUNS_FOLDER, TAKES_FOLDER}


def refuse_foreign(folder: Path) -> None:
    """Raises JobError if a folder that is to become a shot contains files that do not belong to a shot.

    Hidden files, which file managers leave anywhere, and files of an earlier import are allowed.
    """
    try:
        names = sorted(p.name for p in folder.iterdir() if not p.name.startswith("."))
    except OSError:  # the folder does not exist yet, or making it will fail with its own error
        return
    foreign = [name for name in names if name not in SHOT_NAMES]
    if INFO_FILE not in names and foreign:
        named = foreign[0] if len(foreign) == 1 else f"{foreign[0]} and {len(foreign) - 1} more"
        raise JobError(
            f"{folder} is not a shot folder and contains other files ({named}).",
            "Choose an empty or new folder, so that the shot's files stay separate.",
            ExitCode.USAGE,
        )


def discard_unborn(shot: Path) -> bool:
    """Removes what a failed first import left in a shot folder. True if it did; files that cannot be removed stay.

    A shot with a frame or other work is left alone, and so are files of other programs. A shot is also left alone if a
    job in it failed without a message, because its log is needed.
    """
    shot_folder = ShotFolder(shot)
    try:
        names = {p.name for p in shot.iterdir()}
        frames = [p for p in shot_folder.frames.rglob("*") if not p.is_dir()] if FRAMES_FOLDER in names else []
        jobs = list(shot_folder.jobs.iterdir()) if JOBS_FOLDER in names else []
        if INFO_FILE not in names or frames or names & _WORK or shot_folder.jobs.is_symlink():
            return False
        if not all("-import-" in job.name and not job.is_symlink() and _is_explained(job) for job in jobs):
            return False
        writer = read_writer(shot)
        if writer is not None and writer.works():
            return False
        for name in _UNBORN & names - {INFO_FILE}:
            shutil.rmtree(shot / name, ignore_errors=True)  # does not remove links
        shot_folder.lock.unlink(missing_ok=True)
        shot_folder.info_path.unlink()
        with contextlib.suppress(OSError):  # the folder holds files of the artist
            shot.rmdir()
    except (OSError, ValueError):
        return False
    return True


def _is_explained(job: Path) -> bool:
    """True if a job ended with a message, was cancelled, or logged nothing, so that its log is not needed."""
    status = from_dict(Status, read_json(job / STATUS_FILE)) if (job / STATUS_FILE).is_file() else None
    log = job / LOG_FILE
    if status is not None and not status.ended:
        return False
    named = status is not None and (status.state == "cancelled" or status.exit_code != ExitCode.INTERNAL)
    return named or not log.is_file() or not log.stat().st_size
