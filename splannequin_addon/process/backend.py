"""Where the backend is: the Python that runs it, and the folder that holds `torch_backend`."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import bpy

from ...torch_backend import contract
from . import children, environment, jobs

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
    """The backend's interpreter. JobError if there is none, or only one that is half-made or was changed, or the chosen
    one is missing."""
    wrong = ""
    for where, path in candidates():
        chosen = where in ("the add-on's preferences", PYTHON_VARIABLE)
        if path.is_file():
            trouble = _wrong_with(path)
            if not trouble:
                return str(path)
            wrong = wrong or trouble
            if chosen:
                break
        elif chosen:
            raise contract.JobError(
                f"The backend's Python named in {where} does not exist: {path}.",
                "Correct the path, or clear it to have the backend found by itself.",
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
        "Press Set Up Backend in the add-on's preferences, or choose the Python of one that is there "
        f"(or name it in {PYTHON_VARIABLE}).",
        contract.ExitCode.ENVIRONMENT,
    )


def _wrong_with(python: Path) -> str:
    """Why an interpreter's environment cannot be used, a sentence; "" if it can."""
    folder = python.parent.parent
    if environment.half_made(python):
        return f"The backend's set-up has not finished: the environment in {folder} is half-made."
    changed = ", ".join(environment.changed(python))
    return f"The backend in {folder} was changed since it was set up: {changed}." if changed else ""


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


def ask(*words: str) -> children.Question:
    """Asks the backend something, without waiting. JobError if there is none, or it cannot be started."""
    return children.ask(python(), package_root(), *words)


def begin_doctor() -> children.Question:
    """Asks the backend what it can do, without waiting. JobError as `ask`."""
    return ask("doctor")


def diagnosis(question: children.Question) -> str:
    """What it can do, as the JSON that `torch_backend doctor` prints. JobError if it failed."""
    return question.answer(
        "The backend's environment is incomplete: {}.",
        "Press Repair in the add-on's preferences, or run `python3 splannequin.py setup` again.",
        contract.ExitCode.ENVIRONMENT,
    )


def doctor(gpu: bool = False) -> str:
    """`diagnosis`, waited for; of a graphics card that is tested anew if `gpu`."""
    question = ask("doctor", "--gpu") if gpu else begin_doctor()
    question.wait(120.0)
    return diagnosis(question)


def start(job: jobs.Job) -> None:
    """Starts the backend on a job made by `jobs.new_job`. JobError if there is no backend."""
    jobs.start(job, python(), package_root())
