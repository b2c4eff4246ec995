"""Exit codes of commands, and errors with messages for artists."""

from __future__ import annotations

import enum
import errno
import os
import tempfile
import traceback
from pathlib import Path


class ExitCode(enum.IntEnum):
    """Exit codes of every command, documented in docs/manual/troubleshooting.md."""

    OK = 0
    INTERNAL = 1
    USAGE = 2
    FOOTAGE = 3
    SOLVE = 4
    TRAIN = 5
    FREEZE = 6
    BAKE = 7
    DISK = 8
    ENVIRONMENT = 9
    CANCELLED = 130


class JobError(Exception):
    """An error that an artist reads: `message` is one sentence on what was wrong and where, `hint` what to do."""

    def __init__(self, message: str, hint: str = "", exit_code: int = ExitCode.INTERNAL) -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint
        self.exit_code = int(exit_code)


class UserError(JobError, ValueError):
    """An invalid value, name or file that a user can correct. Code that only tries a value may catch ValueError."""

    def __init__(self, message: str, hint: str = "", exit_code: int = ExitCode.USAGE) -> None:
        super().__init__(message, hint, exit_code)


class UnreadableFile(UserError):
    """A path that is not a readable file: a pipe, a device, a folder, or a file too large for its kind."""

    def __init__(self, path: str | Path, why: str) -> None:
        super().__init__(f"{path} {why}: replace or remove it")


class MissingError(UserError, FileNotFoundError):
    """A file or folder that a user named and that does not exist."""


def unexpected(what: str, error: BaseException, log: str | Path) -> JobError:
    """JobError for a bug of Splannequin: `what` failed, and `log` has the details."""
    text = " ".join(str(error).split())[:300]
    message = f"{what} failed: {type(error).__name__}{': ' if text else ''}{text}"
    return JobError(message, f"This is a bug; its details are in {log}.", ExitCode.INTERNAL)


def broke(what: str, error: BaseException) -> JobError:
    """`unexpected` for an error outside a job. Writes the details to a file in the temporary folder."""
    log = Path(tempfile.gettempdir()) / f"splannequin-{os.getpid()}.log"
    try:
        log.write_text("".join(traceback.format_exception(error)), encoding="utf-8", errors="backslashreplace")
    except OSError:
        traceback.print_exception(error)  # the file cannot be written, so print the details
        return unexpected(what, error, "the output above")
    return unexpected(what, error, log)


class Cancelled(Exception):
    """Raised by `Reporter.check_cancelled` when someone asked the job to stop."""


def disk_error(folder: str | Path, detail: str = "the disk is full, or limits the size of a file") -> JobError:
    """JobError for a full disk."""
    return JobError(
        f"No space left in {folder}: {detail}.",
        "Free some space or choose another output folder, then start again: finished work is kept.",
        ExitCode.DISK,
    )


def incomplete(lacks: str) -> JobError:
    """JobError for an environment with a missing or broken package. `lacks`: Python's message."""
    what = (lacks.strip().splitlines() or ["a package cannot be loaded"])[-1]  # numpy's advice fills a page before it
    return JobError(
        f"The backend's environment is incomplete: {what.rstrip('.')}.",
        "Press Repair in the add-on's preferences, or run `python3 splannequin.py setup` again.",
        ExitCode.ENVIRONMENT,
    )


def is_disk_full(error: OSError) -> bool:
    """True if the system refused to write: no space, no quota, or a file larger than the disk allows (FAT32: 4 GB)."""
    return error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


_REFUSED = {
    errno.ENAMETOOLONG: ("has a name that is too long for this system", "Choose a shorter one."),
    errno.ENOTDIR: ("has a file where a folder is needed", "Choose another place."),
    errno.EEXIST: ("is a file where a folder is needed", "Choose another place."),
    errno.EISDIR: ("is a folder where a file is needed", "Choose another place."),
    errno.ENOENT: ("does not exist", "Check the name."),
    errno.ELOOP: ("is a link to itself", "Choose another place."),
    **dict.fromkeys(
        (errno.EACCES, errno.EPERM, errno.EROFS),
        ("cannot be used: it is protected, or another program has it open", "Close it, or choose another place."),
    ),
}


def path_error(error: OSError) -> JobError | None:
    """JobError for a file or folder that the system refuses, or for a full disk; None if the error has no path."""
    where = error.filename2 or error.filename
    if is_disk_full(error):
        return disk_error(where or "the output folder")
    if where and error.errno == errno.EIO:
        message = f"{where} could not be read or written: the disk reports an error."
        return JobError(message, "Check the disk, then start again: finished work is kept.", ExitCode.DISK)
    if not where or error.errno not in _REFUSED:
        return None
    what, hint = _REFUSED[error.errno]
    return JobError(f"{where} {what}.", hint, ExitCode.USAGE)
