"""The virtual environments: their packages and their set-up."""

from __future__ import annotations

import functools
import hashlib
import os
import platform
import re
import shutil
import subprocess
import sys
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch_backend.cards import nvidia_cards
from torch_backend.contract import (
    CPU_INDEX,
    CUDA_INDEX,
    SETUP_BEGUN,
    SETUP_NOTES,
    SETUP_STAMP,
    ExitCode,
    brings_cuda,
    changed_packages,
    package_name,
    program,
    python_child,
    read_json,
    record_packages,
    torch_index,
)
from torch_backend.shot import is_disk_full, locked, write_json

from .children import child_environ, close_input, lines_of, say, start_child, stop_child, tied_command
from .errors import LauncherError
from .interpreters import NEEDED_PYTHON, python_version
from .pip_output import condense_pip, refuse
from .places import REQUIREMENTS, ROOT, WINDOWS
from .repair import drop_damaged, needs_cuda

BACKEND_DISK_GB = 4.0
"""Free disk in GB for setting up the backend: environment and pip's downloads (Linux, CPU build of torch)."""
CUDA_DISK_GB = 5.0
"""Additional free disk in GB with CUDA, which makes the environment 6 GB large instead of 1.5."""
BPY_DISK_GB = 2.0
TORCH_LOCKS = ("torch", "torch-cpu", "torch-cu130", "cuda")
"""Locks of an environment with torch: PyPI's build, the builds of torch's index, and CUDA libraries of PyPI's build."""
HEARTBEAT_SECONDS = 15.0
"""Longest silence of a set-up in seconds; then it prints that it is still at work."""


@dataclass(frozen=True)
class Environment:
    """A virtual environment and its packages."""

    name: str
    """Name in messages."""
    folder: Path
    """Folder of the environment."""
    requirements: tuple[str, ...]
    """Names of the locks in requirements/ that are installed, such as ("backend", "test")."""
    probe: str
    """Python source that imports the packages that must work."""
    disk_gb: float
    """Free disk in GB for the set-up, without CUDA."""
    torch: bool = False
    """True if it has torch, whose build depends on the machine's card."""

    @property
    def python(self) -> str:
        """Path of the environment's interpreter."""
        return str(self.folder / ("Scripts/python.exe" if WINDOWS else "bin/python"))

    @property
    def state(self) -> Path:
        """Folder of the launcher's notes: the stamp and the log of the last set-up."""
        return self.folder / SETUP_NOTES

    @property
    def log(self) -> Path:
        """File with the whole output of the last set-up."""
        return self.state / "setup.log"

    @property
    def stamp(self) -> Path:
        """JSON file on the last finished set-up: hashes of the locks, and the result of `record_packages`."""
        return self.state / SETUP_STAMP

    @property
    def begun(self) -> Path:
        """Marker file that exists while packages are being written."""
        return self.state / SETUP_BEGUN

    @property
    def locks(self) -> list[str]:
        """Files in requirements/ that determine the packages."""
        return [f"{name}.lock" for name in (*self.requirements, *(TORCH_LOCKS if self.torch else ()))]

    def hashes(self) -> dict[str, str]:
        """SHA-256 of every lock."""
        return {name: hashlib.sha256((REQUIREMENTS / name).read_bytes()).hexdigest() for name in self.locks}

    def finished(self) -> dict[str, Any]:
        """The stamp of the last finished set-up; {} if none finished or the venv was recreated since."""
        try:
            stamp = read_json(self.stamp)
            same = stamp["venv"] == (self.folder / "pyvenv.cfg").read_text(encoding="utf-8")
            is_complete = isinstance(stamp["files"], dict) and isinstance(stamp["packages"], dict)
            return stamp if same and is_complete and not self.begun.exists() else {}
        except (OSError, ValueError, KeyError, TypeError):
            return {}

    def changed(self) -> list[str]:
        """Packages that were removed, replaced or damaged since the last finished set-up."""
        return changed_packages(self.folder, self.finished().get("packages", {}))

    def ready(self) -> bool:
        """True if a set-up of the current locks finished and is unchanged. Starts no process."""
        done = self.hashes().items() <= self.finished().get("files", {}).items()
        return done and os.path.exists(self.python) and not self.changed()


def home() -> Path:
    """The folder that holds the environments."""
    return Path(os.path.realpath(os.path.expanduser(os.environ.get("SPLANNEQUIN_HOME") or ROOT)))


def backend_environment(testing: bool = False) -> Environment:
    """The backend's environment, with the test tools if `testing`."""
    probe = "import torch, warp, pycolmap, OpenImageIO, av, cv2, safetensors, scipy, pxr.Usd"
    names = ("backend", "test") if testing else ("backend",)
    return Environment("the backend", home() / ".venv", names, probe, BACKEND_DISK_GB, torch=True)


def bpy_environment(series: str, testing: bool = False) -> Environment:
    """The environment of the bpy wheel of a Blender series ("5.0"), with pytest if `testing`."""
    names = (f"bpy-{series}", "test-bpy") if testing else (f"bpy-{series}",)
    return Environment(f"Blender {series}", home() / f".venv-bpy-{series}", names, "import bpy, numpy", BPY_DISK_GB)


def bench_environment() -> Environment:
    """The benchmark's packages, installed into the backend's environment, which must be set up first."""
    probe = "import anny, ffmpeg, flip_evaluator, imageio, matplotlib, PIL, tqdm"
    return Environment("the benchmark's packages", home() / ".venv", ("bench",), probe, 1.0)


def set_up(environment: Environment, python: str, wheels: Path | None = None) -> float:
    """Sets up `environment` with `python` unless it is ready; returns the seconds it took.

    It continues an interrupted set-up. Packages that are incomplete or were changed since are installed again. Raises
    LauncherError with the failed step, the log and advice.

    Args:
        environment: the environment to set up.
        python: the interpreter that creates it.
        wheels: a folder of wheels to install from instead of a package index; None: the index.
    """
    started = time.monotonic()
    if environment.ready():
        return 0.0
    try:
        wait = functools.partial(say, "another set-up is running in this folder; waiting for it")
        with locked(environment.folder.parent / ".splannequin-setup.lock", wait):
            if not environment.ready():
                _make(environment, python, wheels)
    except OSError as error:
        where = error.filename2 or error.filename or environment.folder
        advice = "free some disk" if is_disk_full(error) else "make it writable"
        raise LauncherError(
            f"{environment.name[:1].upper()}{environment.name[1:]} cannot be set up in {environment.folder.parent}: "
            f"{where}: {error.strerror or error}; {advice}, or set SPLANNEQUIN_HOME to another folder.",
            ExitCode.DISK if is_disk_full(error) else ExitCode.ENVIRONMENT,
        ) from error
    return time.monotonic() - started


def _make(environment: Environment, python: str, wheels: Path | None) -> None:
    changed = environment.changed()
    if changed:
        say(f"Packages of {environment.name} were changed since they were installed: {', '.join(changed)}")
    say(f"{'Repairing' if changed else 'Setting up'} {environment.name} in {environment.folder} (once)")
    usable = environment.folder.is_dir() and _has_pip(environment)
    index = _reachable_index() if environment.torch and wheels is None else ""
    if not usable:
        _make_room(environment, disk_gb(environment, index))
    environment.state.mkdir(parents=True, exist_ok=True)
    environment.log.write_bytes(b"")
    before = environment.finished()
    if not usable:
        _step(environment, "creating the virtual environment", tied_command(python, "venv", str(environment.folder)))
    elif changed or environment.begun.exists():
        for name in drop_damaged(environment.folder, before.get("packages", {})):
            say(f"  {name} is incomplete: reinstalling it")
    environment.begun.touch()
    options = ["--no-input", "--progress-bar", "off", "--disable-pip-version-check", "--only-binary=:all:"]
    options += ["--no-index", "--find-links", str(wheels)] if wheels is not None else []

    def install(step: str, *arguments: str) -> None:
        command = tied_command(environment.python, "pip", "install", *options, *arguments)
        _step(environment, step, command, condense_pip, wheels)

    exactly = ("--no-deps", "--require-hashes")
    lists = [word for name in environment.requirements for word in ("-r", str(REQUIREMENTS / f"{name}.lock"))]
    install("installing packages", *exactly, *lists)
    if environment.torch:
        lock, index_options = _torch(environment, options, index)
        if lock:
            install("installing PyTorch", *exactly, "-r", str(REQUIREMENTS / lock), *index_options)
            if needs_cuda(environment.folder):
                install("installing PyTorch's CUDA libraries", *exactly, "-r", str(REQUIREMENTS / "cuda.lock"))
        else:
            # Its dependencies are already installed, except libraries of another CUDA, which that index has.
            say(f"  the PyTorch of {index} is not in this version's list of hashes: pip uses the hashes of that index")
            install("installing PyTorch", _torch_pin(), *index_options)
    _step(environment, "importing what was installed", [environment.python, "-P", "-c", environment.probe])
    venv = (environment.folder / "pyvenv.cfg").read_text(encoding="utf-8")
    files = {**before.get("files", {}), **environment.hashes()}
    names = [name for lock in files if (REQUIREMENTS / lock).is_file() for name in locked_packages(lock)]
    packages = record_packages(environment.folder, names)
    write_json(environment.stamp, {"files": files, "packages": packages, "venv": venv})
    environment.begun.unlink()


def locked_packages(lock: str) -> list[str]:
    """Names of the packages in a file of requirements/."""
    lines = (REQUIREMENTS / lock).read_text(encoding="utf-8").splitlines()
    return [package_name(name) for line in lines if (name := line.partition("==")[0]) != line and name[0].isalnum()]


def _torch_pin() -> str:
    """torch's requirement without its hashes: torch==2.13.0."""
    lines = (REQUIREMENTS / "torch.lock").read_text(encoding="utf-8").splitlines()
    return next(line.split()[0] for line in lines if line.startswith("torch=="))


def _torch(environment: Environment, options: list[str], index: str) -> tuple[str, tuple[str, ...]]:
    """The lock for installing torch ("" for none), and pip's options for torch's index.

    Without `index`, because torch's index is unreachable or a folder of wheels is used, pip may still be configured
    for a source of that index's build. That build is then preferred to PyPI's, which brings 4 GB of CUDA.
    """
    if index:
        version = python_version(environment.python) or NEEDED_PYTHON
        return torch_lock(index, version), ("--index-url", index)
    build = this_machines_index().rpartition("/")[2]
    if f"torch-{build}" in TORCH_LOCKS:
        pip_options = ("--dry-run", "--no-deps", "--retries", "1", f"{_torch_pin()}+{build}")
        command = python_child(environment.python, "pip", "install", *options, *pip_options)
        done = subprocess.run(command["args"], cwd=command["cwd"], env=child_environ(), capture_output=True)
        if done.returncode == 0:
            return f"torch-{build}.lock", ()
    return "torch.lock", ()


def torch_lock(
    index: str, python: tuple[int, int], system: str = sys.platform, machine: str = platform.machine()
) -> str:
    """The lock with the hash of the build in torch's `index` for this Python and system; "" if no lock has it."""
    if index not in (CPU_INDEX, CUDA_INDEX):
        return ""  # the user's index, from SPLANNEQUIN_TORCH_INDEX
    lock, of = f"torch-{index.rpartition('/')[2]}.lock", "win_amd64" if system == "win32" else machine
    wheel = rf"-cp{python[0]}{python[1]}-\S+{re.escape(of)}\.whl"
    return lock if re.search(wheel, (REQUIREMENTS / lock).read_text(encoding="utf-8")) else ""


def _has_pip(environment: Environment) -> bool:
    """True if the interpreter of the environment runs, is new enough for its packages, and has pip."""
    version = python_version(environment.python)
    if version is None or version < NEEDED_PYTHON:
        return False
    command = python_child(environment.python, "pip", "--version")
    done = subprocess.run(command["args"], cwd=command["cwd"], env=child_environ(), capture_output=True)
    return done.returncode == 0


def disk_gb(environment: Environment, index: str, system: str = sys.platform) -> float:
    """Free disk in GB for setting up an environment with the build of torch from an index."""
    return environment.disk_gb + (CUDA_DISK_GB if environment.torch and brings_cuda(index, system) else 0.0)


def _make_room(environment: Environment, needed: float) -> None:
    """Removes a broken environment of this launcher. Raises LauncherError for a foreign folder or too little disk."""
    folder = environment.folder
    if folder.is_dir() and any(folder.iterdir()) and not environment.state.is_dir():
        raise LauncherError(
            f"{folder} is not a working environment, and this launcher did not create it: move it, or set "
            "SPLANNEQUIN_HOME to another folder, then start again."
        )
    if folder.is_dir():
        shutil.rmtree(folder)
    free = shutil.disk_usage(folder.parent).free / 1e9
    if free < needed:
        raise LauncherError(
            f"Setting up {environment.name} needs {needed:.0f} GB, but {folder.parent} has {free:.1f} GB free: free "
            "some, or set SPLANNEQUIN_HOME to a folder on another disk.",
            ExitCode.DISK,
        )


def this_machines_index(system: str = sys.platform) -> str:
    """Index from which this machine's torch is installed; empty for pip's default index."""
    return torch_index(system, program("nvidia-smi") is not None, lambda: any(c.fits for c in nvidia_cards()[0]))


def _reachable_index() -> str:
    """`this_machines_index` if it is reachable, else "". pip would retry an unreachable index for minutes."""
    index = this_machines_index()
    if index and not _reachable(index):
        say(f"{index} cannot be reached: torch is installed from the usual index")
        return ""
    return index


def _reachable(index: str) -> bool:
    """True if a package index answers a request for torch within ten seconds; always True for a folder (file:)."""
    try:
        with urllib.request.urlopen(f"{index.rstrip('/')}/torch/", timeout=10.0):  # noqa: S310  (the user's own)
            return True
    except urllib.error.HTTPError:
        return True  # the server answers; pip will report the error
    except (OSError, ValueError):
        return urllib.parse.urlsplit(index).scheme == "file"


def _step(
    environment: Environment,
    step: str,
    command: list[str],
    condense: Callable[[str], str | None] | None = None,
    wheels: Path | None = None,
) -> None:
    """Runs one step of a set-up. Its output goes to the log; `condense` selects and shortens lines for the screen."""
    started = time.monotonic()
    child = start_child(
        command, child_environ(), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    output_lines: list[str] = []
    spoke = started
    try:
        with open(environment.log, "a", encoding="utf-8") as log:
            log.write(f"$ {subprocess.list2cmdline(command)}\n")
            for line in lines_of(child):
                if line is None:
                    if time.monotonic() - spoke > HEARTBEAT_SECONDS:
                        spoke = time.monotonic()
                        say(f"  {spoke - started:5.0f} s  still {step}")
                    continue
                log.write(line)
                output_lines.append(line.strip())
                text = condense(line.strip()) if condense else None
                if text:
                    spoke = time.monotonic()
                    say(f"  {spoke - started:5.0f} s  {text}")
        code = child.wait()
    except KeyboardInterrupt:
        stop_child(child)
        raise
    finally:
        close_input(child)
    if code:
        printed = "\n".join([*output_lines[:5], *output_lines[-40:]])  # pip names its indexes in the first lines
        refuse(environment.name, environment.log, step, printed, wheels)
    if condense is None:
        say(f"  {time.monotonic() - started:5.0f} s  {step}: done")
