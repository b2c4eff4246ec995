"""Where the backend is: the Python that runs it, and the folder that holds `torch_backend`."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import bpy

from ...torch_backend import contract
from . import environment, jobs

PACKAGE: str = __name__.partition(".splannequin_addon.")[0]
"""Name of the extension package, such as bl_ext.user_default.splannequin."""
PYTHON_VARIABLE = "SPLANNEQUIN_BACKEND_PYTHON"


def package_root() -> Path:
    """Folder of the extension: it holds `torch_backend`."""
    return Path(__file__).resolve().parents[2]


def venv_python(folder: Path) -> Path:
    """Interpreter of a virtual environment."""
    return folder / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")


def candidates() -> list[tuple[str, Path]]:
    """Where the backend's Python may be, in order: (what it is called, path)."""
    found: list[tuple[str, Path]] = []
    addon = bpy.context.preferences.addons.get(PACKAGE)
    chosen = getattr(addon.preferences, "backend_python", "") if addon and addon.preferences else ""
    if chosen:
        found.append(("the add-on's preferences", Path(bpy.path.abspath(chosen))))
    if os.environ.get(PYTHON_VARIABLE):
        found.append((PYTHON_VARIABLE, Path(os.environ[PYTHON_VARIABLE])))
    home = os.environ.get("SPLANNEQUIN_HOME")
    if home:
        found.append(("SPLANNEQUIN_HOME", venv_python(Path(home) / ".venv")))
    found.append(("the checkout", venv_python(package_root() / ".venv")))
    found.append(("the set-up", venv_python(folder() / ".venv")))
    return found


def folder() -> Path:
    """Folder of the backend's environment that is set up from the preferences."""
    addon = bpy.context.preferences.addons.get(PACKAGE)
    chosen = getattr(addon.preferences, "backend_folder", "") if addon and addon.preferences else ""
    return Path(bpy.path.abspath(chosen)) if chosen else environment.default_folder()


def device() -> str:
    """Where jobs run, as the preferences say: auto, cpu or cuda."""
    addon = bpy.context.preferences.addons.get(PACKAGE)
    return str(getattr(addon.preferences, "device", "auto")) if addon and addon.preferences else "auto"


def python() -> str:
    """The backend's interpreter. JobError if there is none, or if the chosen one is missing."""
    for where, path in candidates():
        if path.is_file():
            return str(path)
        if where in ("the add-on's preferences", PYTHON_VARIABLE):
            raise contract.JobError(
                f"The backend's Python named in {where} does not exist: {path}.",
                "Correct the path, or clear it to have the backend found by itself.",
                contract.ExitCode.ENVIRONMENT,
            )
    raise contract.JobError(
        "Splannequin's backend is not set up: no Python environment for it was found.",
        "Press Set Up Backend in the add-on's preferences, or choose the Python of one that is there "
        f"(or name it in {PYTHON_VARIABLE}).",
        contract.ExitCode.ENVIRONMENT,
    )


def trouble() -> contract.JobError | None:
    """Why there is no Python for the backend; None if there is."""
    try:
        python()
    except contract.JobError as error:
        return error
    return None


def available() -> bool:
    """True if a Python for the backend was found."""
    return trouble() is None


@dataclass
class Doctor:
    """A backend that is asked what it can do, beside Blender."""

    process: subprocess.Popen[str]

    @property
    def ended(self) -> bool:
        """True once it has answered, or failed to."""
        return self.process.poll() is not None

    def wait(self, seconds: float = 120.0) -> None:
        """Waits for the answer; after `seconds` it is no longer waited for."""
        try:
            self._told = self.process.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self._told = self.process.communicate()

    def answer(self) -> str:
        """The JSON that `torch_backend doctor` prints. JobError if it failed."""
        out, errors = getattr(self, "_told", None) or self.process.communicate()
        if self.process.returncode:
            last = (errors.strip().splitlines() or ["no reason given"])[-1]
            raise contract.JobError(
                f"The backend's environment is incomplete: {last}.",
                "Press Repair in the add-on's preferences, or run `python3 splannequin.py setup` again.",
                contract.ExitCode.ENVIRONMENT,
            )
        return out


def begin_doctor() -> Doctor:
    """Asks the backend what it can do, without waiting. JobError if there is none, or it cannot be started."""
    root = package_root()
    command = contract.python_child(python(), "torch_backend", "doctor")
    try:
        child = subprocess.Popen(
            **command, env=jobs.backend_environ(root), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
    except OSError as error:
        raise contract.JobError(
            f"The backend did not answer: {error}.", "Set it up again.", contract.ExitCode.ENVIRONMENT
        ) from error
    return Doctor(child)


def doctor() -> str:
    """What the backend's environment can do, as the JSON that `torch_backend doctor` prints. JobError if it fails."""
    asked = begin_doctor()
    asked.wait()
    return asked.answer()


def start(job: jobs.Job) -> None:
    """Starts the backend on a job made by `jobs.new_job`. JobError if there is no backend."""
    jobs.start(job, python(), package_root())
