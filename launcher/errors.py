"""The one exception of the launcher."""

from __future__ import annotations

from torch_backend.contract import ExitCode


class LauncherError(Exception):
    """A failure of the launcher itself: what is wrong and where, and what to do, in one sentence."""

    def __init__(self, message: str, exit_code: int = ExitCode.ENVIRONMENT) -> None:
        super().__init__(message)
        self.exit_code = int(exit_code)
