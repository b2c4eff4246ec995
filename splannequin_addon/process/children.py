"""Child processes of Blender, all of them: how they are started, and backends that answer one question. No bpy here.

Jobs, a set-up and a live session are started here and followed by their own modules; whatever answers once, the doctor,
an export, ST maps, is a `Question`.
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

_SCRUBBED = ("PYTHONHOME", "PYTHONPATH", "PYTHONSTARTUP", "PYTHONEXECUTABLE", "__PYVENV_LAUNCHER__", "VIRTUAL_ENV")


def _detached() -> dict[str, Any]:
    """What `Popen` needs for a child that outlives this Blender and shows no window."""
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
    """Starts a child of ours. OSError if it cannot be.

    Args:
        placed: `args` and `cwd`, as `contract.python_child` gives them.
        package_root: folder that holds `torch_backend`.
        outlives: it goes on when this Blender ends; else it ends with its standard input.
        environ: variables beside those of `backend_environ`.
        streams: `stdin` and so on of `Popen`; without a `stdin` there is none.
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
    """A backend process that answers one question while Blender goes on."""

    process: subprocess.Popen[str]
    _told: tuple[str, str] = ("", "")
    """What it printed on the standard output and error."""

    def __post_init__(self) -> None:
        # Its output is read while it runs: a pipe holds 4 KB on Windows, and a child that prints more blocks.
        self._reader = threading.Thread(target=self._listen, name="splannequin answer", daemon=True)
        self._reader.start()

    def _listen(self) -> None:
        self._told = self.process.communicate()

    @property
    def ended(self) -> bool:
        """True once it has answered, or failed to."""
        return not self._reader.is_alive()

    def wait(self, seconds: float = 600.0) -> None:
        """Blocks until it has ended; after `seconds`, or on Ctrl-C, it is ended by force."""
        until = time.monotonic() + seconds
        try:
            while not self.ended and time.monotonic() < until:
                self._reader.join(0.2)  # a wait without limit cannot be interrupted on Windows
        finally:
            if not self.ended:
                self.process.kill()
        self._reader.join()

    def answer(self, failed: str, hint: str = "", code: int | None = None) -> str:
        """What it printed. JobError with its own sentence if it failed by intention, else with `failed`.

        Args:
            failed: a sentence with `{}` for the last line of what it said.
            hint: what to do then.
            code: exit code of that error; None: its own.
        """
        self._reader.join()
        out, errors = self._told
        if not self.process.returncode:
            return out
        last = (errors.strip().splitlines() or ["the backend gave no reason"])[-1]
        known = self.process.returncode in {one.value for one in contract.ExitCode}
        if known and last.startswith("Error: ") and code is None:
            raise contract.JobError(last.removeprefix("Error: "), "", self.process.returncode)
        own = self.process.returncode if known else contract.ExitCode.INTERNAL
        raise contract.JobError(failed.format(last.removeprefix("Error: ")), hint, own if code is None else code)


def ask(python: str, package_root: Path, *words: str) -> Question:
    """Asks the backend something, without waiting: `torch_backend WORDS`. JobError if it cannot be started."""
    piped: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    piped |= {"encoding": "utf-8", "errors": "replace"}  # what a library prints may be of another encoding
    try:
        child = start(contract.python_child(python, "torch_backend", *words), package_root, **piped)
    except OSError as error:
        raise contract.JobError(
            f"The backend did not answer: {error}.", "Set it up again.", contract.ExitCode.ENVIRONMENT
        ) from error
    return Question(child)


def import_beside(name: str) -> None:
    """Imports a module that the main thread will need, so that it does not wait for the disk then."""
    threading.Thread(target=importlib.import_module, args=(name,), daemon=True).start()


def backend_environ(package_root: Path) -> dict[str, str]:
    """Environment variables of a backend process: this package importable, nothing of Blender's Python."""
    environ = {k: v for k, v in os.environ.items() if k not in _SCRUBBED}
    environ.update(
        PYTHONPATH=str(package_root),
        PYTHONUTF8="1",
        PYTHONUNBUFFERED="1",
        PYTHONNOUSERSITE="1",
        PYTHONSAFEPATH="1",  # what a child starts in turn takes no module from where it stands either
        PYTHONDONTWRITEBYTECODE="1",  # the extension's folder may be read-only, and is not ours to fill
    )
    return environ
