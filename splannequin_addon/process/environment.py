"""Sets up the backend from Blender: a detached child runs the launcher and is monitored through its log. No bpy.

The launcher (`splannequin.py setup --backend`) creates the environment and reports which step failed. Started again, it
resumes where it stopped. Like every job, it outlives Blender. This module starts the launcher, reads its output, and
removes the environment.
"""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import subprocess
import sys
import threading
import time
import urllib.parse
import uuid
from dataclasses import dataclass, field
from pathlib import Path

from ...torch_backend import contract
from . import children

SIZE = "about 1.5 GB on disk (6 GB with CUDA)"
LICENCES = "PyTorch (BSD), COLMAP (BSD), OpenImageIO (Apache), PyAV (LGPL), Warp (Apache) and what they need"
_STATE = "setup"
# Interval in seconds between checks of a used environment's packages. They are also checked after a set-up.
_LOOK_SECONDS = 60.0
# Name prefix of a removed environment that is being deleted.
_REMOVED = ".venv-removed-"
_SHOWN = 6


def default_folder() -> Path:
    """Default folder of the environment."""
    # Not a folder of the extension (`extension_path_user`): those belong to one Blender version, and Blender may remove
    # them with the extension. All Blenders of a user share this environment of several gigabytes.
    if sys.platform == "win32":
        # Short, because packages nest deep and Windows limits paths to 260 characters.
        return Path(os.environ.get("LOCALAPPDATA") or Path.home()) / "Splannequin"
    return Path.home() / ".splannequin"


def sources(system: str = sys.platform) -> str:
    """Hosts of the packages. Assumes that a graphics card is suitable."""
    # Only the launcher checks the card, because the check would block Blender.
    index = contract.torch_index(system, nvidia_card(), lambda: True)
    return f"pypi.org, {urllib.parse.urlsplit(index).hostname or index}" if index else "pypi.org"


def nvidia_card() -> bool:
    """True if this machine has an NVIDIA driver."""
    return contract.program("nvidia-smi") is not None


@dataclass
class SetUp:
    """A running or finished set-up."""

    folder: Path
    """Folder that contains the environment."""
    process: subprocess.Popen[bytes] | None = None
    output: list[str] = field(default_factory=list[str])
    """Last lines of its output."""
    failure: str = ""
    """Why the set-up failed; empty if it did not."""
    running: bool = True
    """True until the set-up has ended."""

    @property
    def log(self) -> Path:
        """File with the whole output of the launcher."""
        return self.folder / _STATE / "said.txt"

    @property
    def summary(self) -> Path:
        """File in which the launcher records how the set-up ended."""
        return self.folder / _STATE / "summary.json"


def start(folder: Path, python: str, package_root: Path, wheels: Path | None = None) -> SetUp:
    """Starts a set-up in `folder`, or resumes an interrupted one.

    Args:
        folder: folder for the environment.
        python: Python interpreter that creates the environment; Blender's interpreter is suitable.
        package_root: folder that contains `splannequin.py`.
        wheels: folder of wheels to install from instead of the internet.

    Raises:
        contract.JobError: the folder cannot be written, or Python cannot be started.
    """
    setup = SetUp(folder)
    environ = {"SPLANNEQUIN_HOME": str(folder.absolute())}
    python = os.path.abspath(python)
    launcher = str(package_root / "splannequin.py")
    command = [python, "-P", launcher, "setup", "--backend", "--output", str(setup.log.parent.absolute())]
    command += ["--wheels", str(wheels.absolute())] if wheels is not None else []
    try:
        setup.log.parent.mkdir(parents=True, exist_ok=True)
        with open(setup.log, "wb") as log:
            placed = {"args": command, "cwd": os.path.dirname(python)}  # see contract.python_child
            setup.process = children.start(placed, package_root, environ=environ, stdout=log, stderr=subprocess.STDOUT)
    except OSError as error:
        raise contract.JobError(
            f"The backend cannot be set up in {folder}: {error.strerror or error}.",
            "Choose another folder in the add-on's preferences.",
            contract.ExitCode.ENVIRONMENT,
        ) from error
    return setup


def poll(setup: SetUp) -> bool:
    """Reads new output of a set-up. True if something changed."""
    before = (list(setup.output), setup.running)
    try:
        with open(setup.log, "rb") as log:
            log.seek(0, os.SEEK_END)
            log.seek(max(0, log.tell() - 4096))
            lines = log.read().decode("utf-8", "replace").splitlines()
    except OSError:
        lines = []
    setup.output = [line.strip() for line in lines if line.strip()][-_SHOWN:]
    code = setup.process.poll() if setup.process is not None else 0
    if code is not None:
        setup.running = False
        setup.failure = "" if code == 0 else _why(setup, code)
    return before != (setup.output, setup.running)


def wait(setup: SetUp) -> None:
    """Blocks until a set-up has ended. Ctrl-C cancels it."""
    try:
        while poll(setup) or setup.running:
            time.sleep(0.2)  # a wait without timeout cannot be interrupted on Windows
    finally:
        cancel(setup)


def _why(setup: SetUp, code: int) -> str:
    try:
        error = str(contract.read_json(setup.summary).get("error", ""))
    except (OSError, ValueError):
        error = ""
    return error or f"The set-up failed with exit code {code}: {' '.join(setup.output[-1:])}"


def cancel(setup: SetUp) -> None:
    """Terminates a set-up. It resumes when it is started again."""
    if setup.process is not None and setup.process.poll() is None:
        setup.process.terminate()


def is_incomplete(python: Path) -> bool:
    """True if the launcher has started but not finished an interpreter's environment. An environment without the
    launcher's notes counts as finished.

    SETUP_BEGUN exists while packages are written, SETUP_STAMP once everything is complete.
    """
    state = python.parent.parent / contract.SETUP_NOTES
    return state.is_dir() and ((state / contract.SETUP_BEGUN).exists() or not (state / contract.SETUP_STAMP).is_file())


# Environment -> (time of its last check, modification time of its stamp then, changed packages).
_seen: dict[Path, tuple[float, int, list[str]]] = {}


def changed(python: Path) -> list[str]:
    """Packages of an interpreter's environment that were removed, replaced or damaged since the launcher's set-up."""
    folder = python.parent.parent
    try:
        stamp = os.stat(folder / contract.SETUP_NOTES / contract.SETUP_STAMP).st_mtime_ns
    except OSError:
        return []  # not created by the launcher
    when, before, names = _seen.get(folder, (-math.inf, 0, []))
    if before != stamp or time.monotonic() - when > _LOOK_SECONDS:
        names = contract.changed_since_set_up(folder)
        _seen[folder] = (time.monotonic(), stamp, names)
    return names


class AtWork(Exception):
    """Raised if a process runs in an environment that should be removed."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        super().__init__(f"process {pid} runs in it")


def remove(folder: Path, wait: bool = False) -> bool:
    """Removes the environment in `folder`. True if there was one.

    The environment is renamed at once. A background thread deletes its files, unless `wait` is set.
    Raises ValueError if Splannequin did not create the environment, and AtWork if any detectable process runs in it.
    """
    environment = folder / ".venv"
    if not environment.is_dir():
        return False
    if not (environment / contract.SETUP_NOTES).is_dir():
        raise ValueError(f"{environment} was not created by Splannequin")
    _require_unused(environment)
    # Rename first, so that no partly deleted folder counts as an environment after an interruption.
    renamed = folder / f"{_REMOVED}{uuid.uuid4().hex[:8]}"
    os.replace(environment, renamed)
    try:
        _require_unused(environment)  # a process that started after the check uses the old path
    except AtWork:
        os.replace(renamed, environment)
        raise
    shutil.rmtree(folder / _STATE, ignore_errors=True)
    if wait:
        _empty(folder)
    else:
        threading.Thread(target=_empty, args=(folder,), name="removed backend", daemon=True).start()
    return True


def _require_unused(environment: Path) -> None:
    for pid in contract.run_from(environment):
        raise AtWork(pid)


def _empty(folder: Path) -> None:
    """Deletes removed environments, including those left by a Blender that was closed during a removal."""
    for gone in folder.glob(f"{_REMOVED}*"):
        shutil.rmtree(gone, ignore_errors=True)


def findings(facts: str) -> list[str]:
    """The backend's doctor report (JSON) as sentences for an artist."""
    record = json.loads(facts)
    lines = [f"Python {record['python']}, torch {record['packages'].get('torch')}."]
    if record.get("trains_on") == "cuda":
        lines.append(f"Trains on {record.get('cuda_device')}.")
    else:
        lines.append(f"Trains on the processor, {record.get('cores')} cores.")
        refusal = re.sub(r"\s+", " ", str(record.get("cuda_refusal") or ""))
        if nvidia_card() and refusal:
            lines.append(f"The NVIDIA card is not used: {refusal}")
    return lines
