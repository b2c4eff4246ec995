"""How a command ends: its exit codes, and the failure that an artist reads."""

from __future__ import annotations

import enum


class ExitCode(enum.IntEnum):
    """Exit codes of every command, documented in docs/troubleshooting.md."""

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
    """A failure that an artist reads: what was wrong and where, in one sentence, and what to do about it."""

    def __init__(self, message: str, hint: str = "", exit_code: int = ExitCode.INTERNAL) -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint
        self.exit_code = int(exit_code)


class Cancelled(Exception):
    """Raised by `Reporter.check_cancelled` when someone asked the job to stop."""
