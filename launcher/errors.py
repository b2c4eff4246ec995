"""The launcher's exception."""

from __future__ import annotations

from torch_backend.contract import ExitCode


class LauncherError(Exception):
    """A failure of the launcher. The message is one sentence: what is wrong, where, and what to do."""

    def __init__(self, message: str, exit_code: int = ExitCode.ENVIRONMENT) -> None:
        super().__init__(message)
        self.exit_code = int(exit_code)
