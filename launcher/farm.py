"""Commands on a render farm's host: `farm-host` enters a job's environment, `farm-task` runs a task."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence

from torch_backend.contract import ExitCode

from .blender import get_blender, program_at
from .children import child_environ, run_child, tied_command
from .environments import backend_environment, set_up
from .errors import LauncherError
from .places import WINDOWS

PYTHON_VARIABLE = "SPLANNEQUIN_BACKEND_PYTHON"
BLENDER_VARIABLE = "SPLANNEQUIN_BLENDER_COMMAND"
"""JSON list: the command that runs a script of the add-on, without the script."""


def host(words: Sequence[str]) -> int:
    """`farm-host`: sets up this host if necessary, and prints the variables of its tasks (`openjd_env`)."""
    parser = argparse.ArgumentParser(prog="splannequin.py farm-host", allow_abbrev=False)
    parser.add_argument(
        "--python", default="", help="Python with the backend's packages (default: set up automatically)"
    )
    parser.add_argument("--home", default="", help="folder of the environments (default: this one)")
    parser.add_argument("--blender", default="", help="Blender's program (default: a bpy wheel, or on the PATH)")
    parser.add_argument("--bake", action="store_true", help="tasks need a Blender")
    args = parser.parse_args(words)
    if args.home:
        os.environ["SPLANNEQUIN_HOME"] = args.home
    try:
        python = args.python
        if not python:
            environment = backend_environment()
            set_up(environment, sys.executable)
            python = environment.python
        for what, path in (("BackendPython", python), ("Blender", args.blender)):
            if path and not os.path.isfile(path):
                raise LauncherError(f"There is no {path} on this host: correct the job's parameter {what}.")
        command: list[str] = []
        if args.blender:
            command = [*program_at(args.blender, "").command]
        elif args.bake:
            blender, _ = get_blender()
            command = [*blender.command, *(["-P"] if blender.is_wheel else [])]
    except LauncherError as error:
        print(f"openjd_fail: {error}", flush=True)
        return error.exit_code
    if args.home:
        print(f"openjd_env: SPLANNEQUIN_HOME={args.home}", flush=True)
    print(f"openjd_env: {PYTHON_VARIABLE}={python}", flush=True)
    if command:
        print(f"openjd_env: {BLENDER_VARIABLE}={json.dumps(command)}", flush=True)
    return ExitCode.OK


def task(verb: str, words: Sequence[str]) -> int:
    """Runs a verb of the backend in the Python from `host`. Except on Windows it replaces this process."""
    python = os.environ.get(PYTHON_VARIABLE) or backend_environment().python
    if not os.path.isfile(python):
        print(f"openjd_fail: There is no backend at {python}: run `setup`, or enter the job's environment.", flush=True)
        return ExitCode.ENVIRONMENT
    if WINDOWS:
        return run_child(tied_command(python, "torch_backend", verb, *words), tied=True)
    # A process between the farm's engine and the task would have to forward every signal, and cannot forward SIGKILL.
    os.execve(python, [python, "-P", "-m", "torch_backend", verb, *words], child_environ())  # noqa: S606
