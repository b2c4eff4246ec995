"""Location of the backend: its Python interpreter, and the folder that contains `torch_backend`."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import bpy

from ...torch_backend import contract
from . import children, environment, jobs

PACKAGE: str = __name__.partition(".splannequin_addon.")[0]
"""Name of the extension package, such as bl_ext.user_default.splannequin."""
PYTHON_VARIABLE = "SPLANNEQUIN_BACKEND_PYTHON"
_STATE_SECONDS = 5.0
# What `state` returns, with the time of that search in monotonic seconds; None before the first search.
_state: tuple[str, contract.JobError | None, float] | None = None


def package_root() -> Path:
    """Folder of the extension, which contains `torch_backend`."""
    return Path(__file__).resolve().parents[2]


def venv_python(folder: Path) -> Path:
    """Interpreter of a virtual environment."""
    return folder / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")


def candidates() -> list[tuple[str, Path]]:
    """Possible locations of the backend's Python in order of priority: (description, path)."""
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
    """Folder of the backend environment that the preferences set up."""
    addon = bpy.context.preferences.addons.get(PACKAGE)
    chosen = getattr(addon.preferences, "backend_folder", "") if addon and addon.preferences else ""
    return Path(bpy.path.abspath(chosen)) if chosen else environment.default_folder()


def device() -> str:
    """Device of jobs from the preferences: auto, cpu or cuda."""
    addon = bpy.context.preferences.addons.get(PACKAGE)
    return str(getattr(addon.preferences, "device", "auto")) if addon and addon.preferences else "auto"


def python() -> str:
    """The backend's interpreter. Raises JobError if the chosen one is missing, or if every environment is missing,
    incomplete or modified."""
    wrong = ""
    for where, path in candidates():
        chosen = where in ("the add-on's preferences", PYTHON_VARIABLE)
        if path.is_file():
            trouble = _environment_problem(path)
            if not trouble:
                return str(path)
            wrong = wrong or trouble
            if chosen:
                break
        elif chosen:
            raise contract.JobError(
                f"The backend's Python set in {where} does not exist: {path}.",
                "Correct the path, or clear it to detect the backend automatically.",
                contract.ExitCode.ENVIRONMENT,
            )
    if wrong:
        raise contract.JobError(
            wrong,
            "Press Repair in the add-on's preferences, or run `python3 splannequin.py setup` again.",
            contract.ExitCode.ENVIRONMENT,
        )
    raise contract.JobError(
        "Splannequin's backend is not set up: no Python environment for it was found.",
        "Press Set Up Backend in the add-on's preferences, or choose the Python of an existing environment "
        f"there (or set it in {PYTHON_VARIABLE}).",
        contract.ExitCode.ENVIRONMENT,
    )


def _environment_problem(python: Path) -> str:
    """Sentence why an interpreter's environment cannot be used; empty if it can."""
    folder = python.parent.parent
    if environment.is_incomplete(python):
        return f"The backend's set-up did not finish. The environment in {folder} is incomplete."
    changed = ", ".join(environment.changed(python))
    return f"The backend in {folder} has changed since it was set up: {changed}." if changed else ""


def state() -> tuple[str, contract.JobError | None]:
    """(the backend's interpreter, None), or ("", the reason why there is none). Cached for a few seconds."""
    global _state  # cached, because panels ask at every redraw and `python` reads the disk
    if _state is None or time.monotonic() - _state[2] > _STATE_SECONDS:
        try:
            _state = (python(), None, time.monotonic())
        except contract.JobError as error:
            _state = ("", error, time.monotonic())
    return _state[:2]


def clear_state() -> None:
    """Makes the next `state` search again."""
    global _state
    _state = None


def trouble() -> contract.JobError | None:
    """The reason why there is no Python for the backend, or None."""
    try:
        python()
    except contract.JobError as error:
        return error
    return None


def available() -> bool:
    """True if a Python for the backend was found."""
    return trouble() is None


def ask(*words: str) -> children.Question:
    """Sends a question to the backend without waiting. Raises JobError without a backend, or if it cannot be
    started."""
    return children.ask(python(), package_root(), *words)


def begin_doctor() -> children.Question:
    """Asks the backend for its capabilities without waiting. Raises JobError as `ask` does."""
    return ask("doctor")


def diagnosis(question: children.Question) -> str:
    """The backend's capabilities: the JSON of `torch_backend doctor`. Raises JobError if the command failed."""
    return question.answer(
        "The backend's environment is incomplete: {}.",
        "Press Repair in the add-on's preferences, or run `python3 splannequin.py setup` again.",
        contract.ExitCode.ENVIRONMENT,
    )


def doctor(gpu: bool = False) -> str:
    """Blocking `diagnosis`. With `gpu`, tests the graphics card again."""
    question = ask("doctor", "--gpu") if gpu else begin_doctor()
    question.wait(120.0)
    return diagnosis(question)


def start(job: jobs.Job) -> None:
    """Starts the backend on a job from `jobs.new_job`. Raises JobError without a backend."""
    jobs.start(job, python(), package_root())
