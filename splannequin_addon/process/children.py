"""Starts all child processes of Blender, and defines backend processes that answer one question. No bpy.

Jobs, a set-up and a live session are started here, and monitored by other modules. A process with a single answer
(doctor, export, ST maps) is a `Question`.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...torch_backend import contract

# Variables of Blender's Python, which would lead the backend's Python to other modules.
_SCRUBBED = ("PYTHONHOME", "PYTHONPATH", "PYTHONSTARTUP", "PYTHONEXECUTABLE", "__PYVENV_LAUNCHER__", "VIRTUAL_ENV")


def _detached() -> dict[str, Any]:
    """`Popen` arguments of a child that outlives this Blender and shows no window."""
    if sys.platform == "win32":
        return {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.CREATE_NO_WINDOW}
    return {"start_new_session": True}


def start(
    placed: Mapping[str, Any],
    package_root: Path,
    outlives: bool = True,
    environ: Mapping[str, str] | None = None,
    **streams: Any,
) -> subprocess.Popen[Any]:
    """Starts a child process. Raises OSError if it cannot be started.

    Args:
        placed: `args` and `cwd` from `contract.python_child`.
        package_root: folder that contains `torch_backend`.
        outlives: the child continues when this Blender ends. Otherwise it ends with its standard input.
        environ: additional variables to those of `backend_environ`.
        streams: `stdin` and similar arguments of `Popen`. `stdin` defaults to the null device.
    """
    hidden: dict[str, Any] = {"creationflags": subprocess.CREATE_NO_WINDOW} if sys.platform == "win32" else {}
    return subprocess.Popen(
        **placed,
        **{"stdin": subprocess.DEVNULL, **streams},
        **(_detached() if outlives else hidden),
        env={**backend_environ(package_root), **(environ or {})},
    )


@dataclass
class Question:
    """A backend process that answers one question while Blender continues."""

    process: subprocess.Popen[str]
    _printed: tuple[str, str] = ("", "")
    """Its standard output and standard error."""

    def __post_init__(self) -> None:
        # Read the output while the child runs: a pipe holds 4 KB on Windows, and a child that prints more blocks.
        self._reader = threading.Thread(target=self._listen, name="splannequin answer", daemon=True)
        self._reader.start()

    def _listen(self) -> None:
        self._printed = self.process.communicate()

    @property
    def ended(self) -> bool:
        """True once the process has ended."""
        return not self._reader.is_alive()

    def wait(self, seconds: float = 600.0) -> None:
        """Blocks until the process has ended. After `seconds`, or on Ctrl-C, the process is killed."""
        until = time.monotonic() + seconds
        try:
            while not self.ended and time.monotonic() < until:
                self._reader.join(0.2)  # a wait without timeout cannot be interrupted on Windows
        finally:
            if not self.ended:
                self.process.kill()
        self._reader.join()

    def answer(self, failed: str, hint: str = "", code: int | None = None) -> str:
        """The printed answer. Raises JobError with the backend's message if it failed with one, else with `failed`.

        Args:
            failed: message with `{}` for the last line of the error output.
            hint: hint of that error.
            code: exit code of that error; None: the process's code.
        """
        self._reader.join()
        out, errors = self._printed
        if not self.process.returncode:
            return out
        last = (errors.strip().splitlines() or ["no reason given"])[-1]
        known = self.process.returncode in {one.value for one in contract.ExitCode}
        if known and last.startswith("Error: ") and code is None:
            raise contract.JobError(last.removeprefix("Error: "), "", self.process.returncode)
        exit_code = self.process.returncode if known else contract.ExitCode.INTERNAL
        raise contract.JobError(failed.format(last.removeprefix("Error: ")), hint, exit_code if code is None else code)


def ask(python: str, package_root: Path, *words: str) -> Question:
    """Runs `torch_backend WORDS` without waiting for the answer. Raises JobError if it cannot be started."""
    piped: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    piped |= {"encoding": "utf-8", "errors": "replace"}  # a library may print in another encoding
    try:
        child = start(contract.python_child(python, "torch_backend", *words), package_root, **piped)
    except OSError as error:
        raise contract.JobError(
            f"The backend did not answer: {error}.", "Set it up again.", contract.ExitCode.ENVIRONMENT
        ) from error
    return Question(child)


def import_in_background(name: str) -> None:
    """Imports a module in a thread."""
    # Otherwise the main thread, and so Blender's window, would wait for the disk at first use.
    threading.Thread(target=importlib.import_module, args=(name,), daemon=True).start()


def backend_environ(package_root: Path) -> dict[str, str]:
    """Environment variables of a backend process: this package is importable, Blender's Python settings are removed."""
    environ = {k: v for k, v in os.environ.items() if k not in _SCRUBBED}
    environ.update(
        PYTHONPATH=str(package_root),
        PYTHONUTF8="1",
        PYTHONUNBUFFERED="1",
        PYTHONNOUSERSITE="1",
        PYTHONSAFEPATH="1",  # grandchildren do not import from their working directory either
        PYTHONDONTWRITEBYTECODE="1",  # the extension's folder may be read-only
    )
    return environ
