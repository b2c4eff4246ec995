#!/usr/bin/env python3
"""Splannequin's launcher: makes the two environments the project needs, then runs it. Standard library only.

    python3 splannequin.py demo                     freeze the bundled clip
    python3 splannequin.py freeze CLIP --t-star 40  freeze your own
    python3 splannequin.py doctor                   what this machine can do
    python3 splannequin.py test                     all tests
    python3 splannequin.py bench --quick            the method against ground truth, with a report
    python3 splannequin.py setup                    make the environments and stop

The backend lives in `.venv`; Blender as a Python module lives in `.venv-bpy-X.Y` (their numpy versions exclude each
other). Both stand beside this file, or in the folder that SPLANNEQUIN_HOME names. Exit codes: docs/troubleshooting.md.

This file parses under Python 3.8, so that an old Python can say which one is needed.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import functools
import hashlib
import json
import os
import platform
import queue
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Callable, Iterator, Sequence  # noqa: UP035  (parses and runs under 3.8)

ROOT = Path(__file__).resolve().parent
REQUIREMENTS = ROOT / "requirements"
DEMO_CLIP = ROOT / "examples" / "sitting.mp4"
NEEDED_PYTHON = (3, 11)
WINDOWS = os.name == "nt"
LINUX = sys.platform.startswith("linux")

BPY_WHEELS = {"5.0": (3, 11), "5.2": (3, 13), "4.5": (3, 11), "4.2": (3, 11)}
"""Blender series with a pinned wheel in requirements/, the Python each one needs, in order of preference."""
DEMO_WHEELS = ("5.0", "5.2", "4.5")
OLDEST_BLENDER = (4, 2)

BACKEND_DISK_GB = 4.0
"""Free disk that setting up the backend may need: the environment and pip's downloads (Linux, CPU build of torch)."""
BPY_DISK_GB = 2.0
HEARTBEAT_SECONDS = 15.0
"""A set-up that has printed nothing for this long says that it is still at work."""

BLENDER_LIBRARIES = {
    "libX11.so.6": "libx11-6",
    "libXrender.so.1": "libxrender1",
    "libXxf86vm.so.1": "libxxf86vm1",
    "libXfixes.so.3": "libxfixes3",
    "libXi.so.6": "libxi6",
    "libxkbcommon.so.0": "libxkbcommon0",
    "libSM.so.6": "libsm6",
    "libICE.so.6": "libice6",
    "libGL.so.1": "libgl1",
}
"""What Blender opens on Linux and a bare server lacks: file, Debian package."""

TORCH_INDEX = "SPLANNEQUIN_TORCH_INDEX"
CUDA_INDEX = "https://download.pytorch.org/whl/cu130"
"""Where torch for NVIDIA cards comes from on Windows, whose PyPI build has no CUDA."""

# ------------------------------------------------------------------------------------------------- interpreters


def python_version(executable: str) -> tuple[int, int] | None:
    """(major, minor) of the Python at `executable`; None if it does not run (a pyenv shim without a version, say)."""
    try:
        found = subprocess.run(
            [executable, "-I", "-c", "import sys; print('%d %d' % sys.version_info[:2])"],
            capture_output=True,
            text=True,
            timeout=30,
        )
        major, minor = found.stdout.split()
    except (OSError, ValueError, subprocess.TimeoutExpired):
        return None
    return int(major), int(minor)


def dotted(version: tuple[int, int]) -> str:
    """(3, 11) as "3.11"."""
    return f"{version[0]}.{version[1]}"


def find_python(accept: Callable[[tuple[int, int]], bool], names: Sequence[str]) -> str | None:
    """The first Python of the machine whose version is accepted: this one, then `names` on the PATH, then pyenv's."""
    if accept(sys.version_info[:2]):
        return sys.executable
    candidates = []
    for name in names:
        for folder in os.get_exec_path():
            found = shutil.which(name, path=folder)
            if found and os.path.isabs(found):  # Windows offers the folder that we stand in first
                candidates.append(found)
        wanted = name.replace("python", "")
        if wanted:
            pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
            candidates += [str(p) for p in sorted(pyenv.glob(f"{wanted}.*/bin/{name}"), reverse=True)]
            launcher = shutil.which("py") if WINDOWS else None
            if launcher and os.path.isabs(launcher):
                command = [launcher, f"-{wanted}", "-I", "-c", "import sys; print(sys.executable)"]
                located = subprocess.run(command, capture_output=True, text=True)
                if located.returncode == 0:
                    candidates.append(located.stdout.strip())
    for candidate in dict.fromkeys(candidates):
        version = python_version(candidate)
        if version and accept(version):
            return candidate
    return None


def hand_over_to_newer_python() -> int:
    """Runs this file again under a Python that is new enough; says in one sentence if there is none."""
    newer = find_python(
        lambda version: version >= NEEDED_PYTHON,
        ("python3.11", "python3.13", "python3.12", "python3.14", "python3", "python"),
    )
    if newer is None:
        print(
            f"Error: Splannequin needs Python {dotted(NEEDED_PYTHON)} or newer and this is "
            f"{platform.python_version()}: install one from python.org (3.11 and 3.13 also fit a bpy wheel) and start "
            "again with it.",
            file=sys.stderr,
        )
        return 9
    command = [newer, str(Path(__file__).resolve()), *sys.argv[1:]]
    if WINDOWS:  # a program that takes another's place there is a second one, which nobody waits for
        return subprocess.call(command)
    os.execv(newer, command)  # noqa: S606  (no shell is wanted)


if __name__ == "__main__" and sys.version_info[:2] < NEEDED_PYTHON:
    sys.exit(hand_over_to_newer_python())

if str(ROOT) not in sys.path:  # -P and PYTHONSAFEPATH leave even a script's own folder out
    sys.path.insert(0, str(ROOT))

from torch_backend.cards import Card, nvidia_cards, why_unfit, why_unused  # noqa: E402  (needs 3.11)
from torch_backend.contract import (  # noqa: E402
    GRACE_SECONDS,
    JOBS_FOLDER,
    SHOT_SUFFIX,
    STATUS_FILE,
    ExitCode,
    program,
    python_child,
    read_json,
)
from torch_backend.shot import is_disk_full, locked, write_json  # noqa: E402


class LauncherError(Exception):
    """A failure of the launcher itself: what is wrong and where, and what to do, in one sentence."""

    def __init__(self, message: str, exit_code: int = ExitCode.ENVIRONMENT) -> None:
        super().__init__(message)
        self.exit_code = int(exit_code)


# ------------------------------------------------------------------------------------------------- environments


@dataclass(frozen=True)
class Environment:
    """A virtual environment and what is installed in it."""

    name: str
    """What messages call it."""
    folder: Path
    """Where it stands."""
    requirements: tuple[str, ...]
    """Requirement files in requirements/, installed together."""
    probe: str
    """Python source that imports what must work."""
    disk_gb: float
    """Free disk that setting it up may need, in GB."""
    complete: bool = False
    """The requirement files name every package that is needed, so nothing else is installed."""

    @property
    def python(self) -> str:
        """Its interpreter."""
        return str(self.folder / ("Scripts/python.exe" if WINDOWS else "bin/python"))

    @property
    def state(self) -> Path:
        """The launcher's notes on it: the stamp, the log of the last set-up."""
        return self.folder / ".splannequin"

    @property
    def log(self) -> Path:
        """pip's whole output of the last set-up."""
        return self.state / "setup.log"

    @property
    def stamp(self) -> Path:
        """What the last finished set-up installed: JSON, hash by requirement file."""
        return self.state / "installed.json"

    @property
    def begun(self) -> Path:
        """A file that stands here while packages are being written."""
        return self.state / "installing"

    def hashes(self) -> dict[str, str]:
        """SHA-256 of every file that decides what is installed."""
        names = (*self.requirements, "constraints.txt")
        return {name: hashlib.sha256((REQUIREMENTS / name).read_bytes()).hexdigest() for name in names}

    def installed(self) -> dict[str, str]:
        """`hashes` as of the last finished set-up, {} if none finished or the venv was made anew since."""
        try:
            stamp = json.loads(self.stamp.read_text(encoding="utf-8"))
            same = stamp["venv"] == (self.folder / "pyvenv.cfg").read_text(encoding="utf-8")
            return dict(stamp["files"]) if same and not self.begun.exists() else {}
        except (OSError, ValueError, KeyError, TypeError):
            return {}

    def ready(self) -> bool:
        """True if a finished set-up of exactly these requirements stands here. Starts no process."""
        return self.hashes().items() <= self.installed().items() and os.path.exists(self.python)


def home() -> Path:
    """The folder that holds the environments."""
    return Path(os.path.realpath(os.path.expanduser(os.environ.get("SPLANNEQUIN_HOME") or ROOT)))


def backend_environment(testing: bool = False) -> Environment:
    """The backend's environment, with the test tools on request."""
    probe = "import torch, warp, pycolmap, OpenImageIO, av, cv2, fileseq, safetensors, scipy"
    files = ("backend.txt", "test.txt") if testing else ("backend.txt",)
    return Environment("the backend", home() / ".venv", files, probe, BACKEND_DISK_GB)


def bpy_environment(series: str, testing: bool = False) -> Environment:
    """The environment of the bpy wheel of a Blender series ("5.0"), with pytest on request."""
    files = (f"bpy-{series}.txt", "test-bpy.txt") if testing else (f"bpy-{series}.txt",)
    return Environment(f"Blender {series}", home() / f".venv-bpy-{series}", files, "import bpy, numpy", BPY_DISK_GB)


def bench_environment() -> Environment:
    """The backend's environment with the benchmark's packages in it; `backend_environment` is to be ready before."""
    probe = "import anny, ffmpeg, flip_evaluator, imageio, matplotlib, PIL, tqdm"
    return Environment("the benchmark's packages", home() / ".venv", ("bench.txt",), probe, 1.0, complete=True)


def child_environ(**extra: str) -> dict[str, str]:
    """Environment variables for a child: this checkout on its path, nothing of another Python or of where it stands."""
    environ = {k: v for k, v in os.environ.items() if k not in ("PYTHONHOME", "PYTHONPATH", "PYTHONSTARTUP")}
    environ.update(PYTHONPATH=str(ROOT), PYTHONSAFEPATH="1", PYTHONNOUSERSITE="1")
    environ.update(PYTHONUTF8="1", PYTHONUNBUFFERED="1", **extra)
    return environ


def set_up(environment: Environment, python: str) -> float:
    """Makes `environment` with `python` unless it is ready; returns the seconds it took.

    Raises LauncherError with the step, the log and what to do. What an interrupted set-up left is used again, packages
    that pip had not finished writing are installed anew.
    """
    started = time.monotonic()
    if environment.ready():
        return 0.0
    try:
        wait = functools.partial(say, "another set-up is at work in this folder; waiting for it")
        with locked(environment.folder.parent / ".splannequin-setup.lock", wait):
            if not environment.ready():
                _make(environment, python)
    except OSError as error:
        where = error.filename2 or error.filename or environment.folder
        advice = "free some disk" if is_disk_full(error) else "make it writable"
        raise LauncherError(
            f"{environment.name[:1].upper()}{environment.name[1:]} cannot be set up in {environment.folder.parent}: "
            f"{where}: {error.strerror or error}; {advice}, or name another folder in SPLANNEQUIN_HOME.",
            ExitCode.DISK if is_disk_full(error) else ExitCode.ENVIRONMENT,
        ) from error
    return time.monotonic() - started


def _make(environment: Environment, python: str) -> None:
    say(f"Setting up {environment.name} in {environment.folder} (once)")
    usable = environment.folder.is_dir() and _has_pip(environment)
    if not usable:
        _make_room(environment)
    environment.state.mkdir(parents=True, exist_ok=True)
    environment.log.write_bytes(b"")
    if not usable:
        _step(environment, "making the virtual environment", tied_command(python, "venv", str(environment.folder)))
    elif environment.begun.exists():
        command = [environment.python, "-P", "-c", DROP_UNFINISHED]
        _step(environment, "checking what an interrupted set-up left", command)
    before = environment.installed()
    environment.begun.touch()
    pip = tied_command(environment.python, "pip", "install", "--no-input", "--progress-bar", "off")
    pip += ["--disable-pip-version-check", "--only-binary=:all:"]
    pip += ["--no-deps"] if environment.complete else []
    index = torch_index() if environment.requirements[0] == "backend.txt" else ""
    if index:
        if _reachable(index):
            pip += ["--extra-index-url", index]
        else:  # pip would ask it in vain for every single package, minutes in all
            say(f"{index} cannot be reached: torch comes from the usual index")
    for name in environment.requirements:
        pip += ["-r", str(REQUIREMENTS / name)]
    _step(environment, "installing packages", pip, condense_pip)
    _step(environment, "importing what was installed", [environment.python, "-P", "-c", environment.probe])
    venv = (environment.folder / "pyvenv.cfg").read_text(encoding="utf-8")
    write_json(environment.stamp, {"files": {**before, **environment.hashes()}, "venv": venv})
    environment.begun.unlink()


def _has_pip(environment: Environment) -> bool:
    """True if the interpreter of the environment runs, is new enough for its packages, and has pip."""
    version = python_version(environment.python)
    if version is None or version < NEEDED_PYTHON:
        return False
    command = python_child(environment.python, "pip", "--version")
    return subprocess.run(**command, env=child_environ(), capture_output=True).returncode == 0


def _make_room(environment: Environment) -> None:
    """Clears away a broken environment of ours. LauncherError if it is not ours, or the disk is too full."""
    folder = environment.folder
    if folder.is_dir() and any(folder.iterdir()) and not environment.state.is_dir():
        raise LauncherError(
            f"{folder} is no environment that works, and not one of this launcher's: "
            "move it away, or name another folder in SPLANNEQUIN_HOME, and start again."
        )
    if folder.is_dir():
        shutil.rmtree(folder)
    free = shutil.disk_usage(folder.parent).free / 1e9
    if free < environment.disk_gb:
        raise LauncherError(
            f"Setting up {environment.name} needs {environment.disk_gb:.0f} GB and {folder.parent} has {free:.1f} GB "
            "free: free some, or name a folder on another disk in SPLANNEQUIN_HOME.",
            ExitCode.DISK,
        )


DROP_UNFINISHED = """
import importlib.metadata, pathlib, shutil
for package in importlib.metadata.distributions():
    folder = pathlib.Path(str(package._path))
    if folder.name.endswith(".dist-info") and not (folder / "RECORD").is_file():
        shutil.rmtree(folder)
"""
"""pip writes a package's RECORD last: without one the package is not all there, and pip must not believe it is."""


def torch_index(windows: bool = WINDOWS) -> str:
    """Package index, beside pip's own, that torch comes from; empty for none.

    What the variable says; without it, on Windows, the one with CUDA where there is a card for it.
    """
    if TORCH_INDEX in os.environ:
        return os.environ[TORCH_INDEX]
    return CUDA_INDEX if windows and any(card.fits for card in nvidia_cards()[0]) else ""


def _reachable(index: str) -> bool:
    """True if a package index answers about torch within ten seconds; a folder (file:) does if it is there."""
    try:
        with urllib.request.urlopen(f"{index.rstrip('/')}/torch/", timeout=10.0):  # noqa: S310  (the user's own)
            return True
    except urllib.error.HTTPError:
        return True  # it answers: pip tells what is wrong
    except (OSError, ValueError):
        return urllib.parse.urlsplit(index).scheme == "file"


def _step(
    environment: Environment, step: str, command: list[str], condense: Callable[[str], str | None] | None = None
) -> None:
    """Runs one step of a set-up, its output to the log and what `condense` makes of each line to the screen."""
    started = time.monotonic()
    lines: queue.Queue[str | None] = queue.Queue()
    child = start_child(
        command, child_environ(), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )

    def read() -> None:
        assert child.stdout is not None  # PIPE, above
        for raw in child.stdout:
            lines.put(raw.decode("utf-8", "replace"))
        lines.put(None)

    threading.Thread(target=read, daemon=True).start()
    said: list[str] = []
    spoke = started
    try:
        with open(environment.log, "a", encoding="utf-8") as log:
            log.write(f"$ {subprocess.list2cmdline(command)}\n")
            while True:
                try:
                    line = lines.get(timeout=0.5)
                except queue.Empty:
                    if time.monotonic() - spoke > HEARTBEAT_SECONDS:
                        spoke = time.monotonic()
                        say(f"  {spoke - started:5.0f} s  still {step}")
                    continue
                if line is None:
                    break
                log.write(line)
                said.append(line.strip())
                text = condense(line.strip()) if condense else None
                if text:
                    spoke = time.monotonic()
                    say(f"  {spoke - started:5.0f} s  {text}")
        code = child.wait()
    except KeyboardInterrupt:
        stop_child(child)
        raise
    finally:
        _close(child)
    if code:
        _refuse(environment, step, "\n".join([*said[:5], *said[-40:]]))  # pip names its indexes first
    if condense is None:
        say(f"  {time.monotonic() - started:5.0f} s  {step}: done")


def condense_pip(line: str) -> str | None:
    """pip's output, one line per package: `torch 2.13.0 (190.2 MB)`. None for what an artist need not read."""
    wheel = re.match(
        r"(?:Downloading|Using cached|Processing) (?:\S*[/\\])?([^\s/\\]+)\.whl(?!\S)(?: (\(\d[^)]*\)))?", line
    )
    if wheel:
        name, version = wheel.group(1).split("-")[:2]
        return f"{name} {version.replace('%2B', '+')} {wheel.group(2) or ''}".rstrip()
    found = re.match(r"Installing collected packages: (.*)", line)
    if found:
        return f"installing {len(found.group(1).split(','))} packages"
    return "installed" if line.startswith("Successfully installed") else None


BROKEN_CONNECTION = re.compile(
    r"connection broken by|ConnectionError|Max retries exceeded|Temporary failure|Name or service|getaddrinfo|"
    r"timed out|Network is unreachable|ProxyError|SSLError|IncompleteRead|RemoteDisconnected"
)
"""What pip says of an index that it cannot ask. What it says last is that no version was found."""


def _refuse(environment: Environment, step: str, output: str) -> None:
    """Raises the sentence for a failed step of a set-up, from what it printed."""
    lines = [line.strip() for line in output.splitlines() if line.strip()] or ["no output"]
    telling = [line for line in lines if re.search(r"error|not found|cannot|No space", line, re.I)]
    last = re.sub(r"^(ERROR: |\w*Error: )", "", (telling or lines)[-1]).rstrip(".")
    code = ExitCode.ENVIRONMENT
    answered = re.search(r"from versions: (?!none)", output)
    if re.search(r"No space left|Errno 28|not enough space", output, re.I):
        code, advice = ExitCode.DISK, "free some disk, or name a folder on another disk in SPLANNEQUIN_HOME"
    elif BROKEN_CONNECTION.search(output) and not answered:
        last, advice = _unreachable(output)
    elif re.search(r"ensurepip|python3-venv", output):
        advice = "install the venv module of this Python (Debian and Ubuntu: apt install python3-venv)"
    elif re.search(r"No matching distribution|from versions:", output):
        advice = "use Python 3.11 or 3.13 on 64-bit Windows, macOS or Linux, or check the package index pip is set to"
    elif re.search(r"lib\S+\.so\S*: cannot open shared object", output):
        advice = "install that library with the system's package manager"
    else:
        advice = "read the log, and start the same command again: it goes on where it stopped"
    raise LauncherError(
        f"Setting up {environment.name} failed at {step} ({last[:200]}): {advice}. Log: {environment.log}", code
    )


def _unreachable(output: str) -> tuple[str, str]:
    """What pip could not reach, and what to do about it, from what it printed."""
    told = re.search(r"host='([^']+)'", output)
    listed = re.search(r"Looking in indexes: (.*)", output)
    urls = [url.strip() for url in listed.group(1).split(",")] if listed else ["https://pypi.org/simple"]
    hosts = [part.hostname for part in map(urllib.parse.urlsplit, urls) if part.scheme != "file" and part.hostname]
    what = told.group(1) if told else " or ".join(dict.fromkeys(hosts)) or "the package index"
    again = "then start the same command again: it goes on where it stopped"
    if re.search(r"ProxyError|Cannot connect to proxy", output):
        return f"the proxy on the way to {what} cannot be used", f"check HTTPS_PROXY and pip.conf, {again}"
    if "SSLError" in output or "certificate" in output:
        advice = "if a proxy signs for it, name its certificate in PIP_CERT"
        return f"the certificate of {what} is not accepted", f"{advice}, {again}"
    advice = "check the network; behind a firewall name a proxy (HTTPS_PROXY) or an index of your own (PIP_INDEX_URL)"
    return f"{what} cannot be reached", f"{advice}, {again}"


# ------------------------------------------------------------------------------------------------------ Blender


@dataclass(frozen=True)
class Blender:
    """Something that runs the add-on's Python files: the interpreter of a bpy wheel, or a Blender on the PATH."""

    label: str
    """What messages call it."""
    command: tuple[str, ...]
    """The command up to the script."""

    @property
    def is_wheel(self) -> bool:
        """True for a Python that can import bpy."""
        return len(self.command) == 1

    def running(self, script: Path, *arguments: str) -> list[str]:
        """The command line that runs `script` with `arguments`."""
        safe, apart = (("-P",), ()) if self.is_wheel else ((), ("--",))
        return [*self.command, *safe, str(script), *apart, *arguments]


def find_blender() -> tuple[str, str] | None:
    """(path, version) of a `blender` on the PATH that is new enough."""
    path = program("blender")
    if path is None:
        return None
    try:
        out = subprocess.run([path, "--version"], capture_output=True, text=True, timeout=60).stdout
    except (OSError, subprocess.TimeoutExpired):
        return None
    found = re.search(r"Blender (\d+)\.(\d+)(\S*)", out)
    if not found or (int(found.group(1)), int(found.group(2))) < OLDEST_BLENDER:
        return None
    return path, f"{found.group(1)}.{found.group(2)}{found.group(3)}"


def choose_wheels() -> list[tuple[str, str]]:
    """(series, python) of the bpy wheels this machine can have: those of the Python at hand first, ready ones first."""
    at_hand = [(s, sys.executable) for s in DEMO_WHEELS if BPY_WHEELS[s] == sys.version_info[:2]]
    if at_hand:
        return sorted(at_hand, key=lambda wheel: not bpy_environment(wheel[0]).ready())
    other = []
    for series in DEMO_WHEELS:
        if bpy_environment(series).ready():
            return [(series, "")]
        python = python_for(series)
        if python:
            other.append((series, python))
    return other


def python_for(series: str) -> str | None:
    """A Python of the machine that the bpy wheel of `series` fits."""
    needed = BPY_WHEELS[series]
    return find_python(lambda version: version == needed, (f"python{dotted(needed)}",))


def get_blender(testing: bool = False) -> tuple[Blender, float]:
    """A Blender for the add-on, set up if need be, and the seconds that took. LauncherError if none can be had."""
    wheels = choose_wheels()
    refused: LauncherError | None = None
    took = 0.0
    for series, python in wheels:
        environment = bpy_environment(series, testing)
        try:
            took += set_up(environment, python or environment.python)
        except LauncherError as error:
            refused = error
            say(f"  note: {error}")
            continue
        return Blender(f"bpy {series}", (environment.python,)), took
    found = find_blender()
    if found:
        options = ("--background", "--factory-startup", "--python-exit-code", str(ExitCode.BAKE), "--python")
        return Blender(f"Blender {found[1]}", (found[0], *options)), took
    if refused:
        raise refused
    raise LauncherError(
        f"No Blender can be had: Python {platform.python_version()} fits no bpy wheel (3.11 and 3.13 do) and there is "
        "no `blender` 4.2 or newer on the PATH; install either and start the same command again."
    )


# ----------------------------------------------------------------------------------------------------- children


def say(text: str) -> None:
    """One line to the artist, at once."""
    print(text, flush=True)


def start_child(command: Sequence[str], environ: dict[str, str], **streams: Any) -> subprocess.Popen[Any]:
    """Starts a child in a process group of its own, so that Ctrl-C reaches it once, from here.

    It stands beside its program, as in `contract.python_child`, unless `cwd` says where.
    """
    streams.setdefault("cwd", os.path.dirname(os.path.abspath(command[0])))
    try:
        if WINDOWS:
            group = getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)
            apart: dict[str, Any] = {"creationflags": group}
        else:
            apart = {"start_new_session": True}
        return subprocess.Popen(command, env=environ, **{"stdin": subprocess.DEVNULL, **apart, **streams})
    except OSError as error:
        raise LauncherError(f"Cannot start {command[0]} ({error}): run `setup` again, or see `doctor`.") from error


def stop_child(child: subprocess.Popen[Any]) -> None:
    """Asks a child to stop as Ctrl-C would; takes it and its children down if it does not, or on a second Ctrl-C."""
    if child.poll() is not None:
        return
    try:
        child.send_signal(getattr(signal, "CTRL_BREAK_EVENT", signal.SIGTERM) if WINDOWS else signal.SIGINT)
        child.wait(GRACE_SECONDS)
    except (KeyboardInterrupt, subprocess.TimeoutExpired):
        if WINDOWS:
            child.kill()
        else:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)
        child.wait()


def tied_command(python: str, module: str, *words: str) -> list[str]:
    """`python -m module words` for a child that ends when we do, however that comes about: its standard input must be a
    pipe (`run_child(tied=True)`), which closes with us."""
    return [python, "-P", "-m", "torch_backend.tied", module, *words]


def _close(child: subprocess.Popen[Any]) -> None:
    """Closes our end of an ended child's standard input."""
    if child.stdin is not None:
        with contextlib.suppress(OSError):
            child.stdin.close()


HERE = Path()
"""Where the user stands, for children that are given paths as they were typed."""


def run_child(command: Sequence[str], cwd: Path | None = None, tied: bool = False, **environ: str) -> int:
    """Runs a child with our output; returns its exit code. On Ctrl-C it is cancelled and KeyboardInterrupt goes on.

    `cwd`: where it stands, if not beside its program.
    `tied`: its standard input stays open as long as this process lives, however that ends; the child watches it.
    """
    streams: dict[str, Any] = {"stdin": subprocess.PIPE} if tied else {}
    if cwd is not None:
        streams["cwd"] = cwd
    child = start_child(command, child_environ(**environ), **streams)
    try:
        while True:
            # A wait without limit cannot be interrupted on Windows.
            with contextlib.suppress(subprocess.TimeoutExpired):
                return _documented(child.wait(0.2))
    except KeyboardInterrupt:
        say("\nCancelling; Ctrl-C again stops at once.")
        stop_child(child)
        raise KeyboardInterrupt("the child has said so") from None
    finally:
        _close(child)


def _documented(code: int) -> int:
    """A child's return code as one of `ExitCode`: of one that a signal ended, CANCELLED or, with a word, INTERNAL."""
    if code in (-signal.SIGINT, -signal.SIGTERM, 0xC000013A):  # the last: Ctrl-C on Windows
        return ExitCode.CANCELLED
    if code >= 0 and not (WINDOWS and code > 255):
        return code
    print(f"Error: a process was ended from outside ({code}), perhaps for want of memory.", file=sys.stderr, flush=True)
    return ExitCode.INTERNAL


BLENDERS_OWN = re.compile(
    r"\d\d:\d\d\.\d+ |Info: |Fra:|Saved: |Blender \d|Read blend: | ?Time: |\s*$|.*RuntimeWarning: |    "
)
"""Lines of Blender's that are no news to an artist; they go to the log."""


def run_blender(command: Sequence[str], log: Path, **environ: str) -> int:
    """`run_child(tied=True)` for Blender: all that it prints goes to `log`, what the add-on says also to the screen."""
    streams = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    child = start_child(command, child_environ(**environ), **streams)
    try:
        with open(log, "w", encoding="utf-8") as stream:
            for raw in child.stdout or ():
                line = raw.decode("utf-8", "replace").rstrip()
                stream.write(line + "\n")
                if line.startswith("Error: "):
                    print(line, file=sys.stderr, flush=True)
                elif not BLENDERS_OWN.match(line):
                    say(line)
        return _documented(child.wait())
    except KeyboardInterrupt:
        say("\nCancelling; Ctrl-C again stops at once.")
        stop_child(child)
        raise KeyboardInterrupt("the child has said so") from None
    finally:
        _close(child)


# ------------------------------------------------------------------------------------------------------ summary


def read_summary(output: Path) -> dict[str, Any]:
    """DIR/summary.json, {} if there is none."""
    try:
        return read_json(output / "summary.json")
    except (OSError, ValueError):
        return {}


def failed_job(output: Path) -> str:
    """The sentence of the newest job of the shots in `output`, if it failed; else nothing."""
    try:
        found = output.glob(f"*{SHOT_SUFFIX}/{JOBS_FOLDER}/*/{STATUS_FILE}")
        statuses = sorted(found, key=lambda path: path.stat().st_mtime)
        status = read_json(statuses[-1]) if statuses else {}
    except (OSError, ValueError):
        return ""
    words = (status.get("message", ""), status.get("hint", ""))
    return " ".join(filter(None, map(str, words))) if status.get("state") == "failed" else ""


# ----------------------------------------------------------------------------------------------------- commands


def freeze(clip: str, output: Path, options: Sequence[str]) -> int:
    """Clip to frozen frames through the compositor: the backend's stations, then the bake in Blender's environment."""
    started = time.monotonic()
    if "://" not in clip and not any(mark in clip for mark in "#%*@") and not os.path.exists(clip):
        raise LauncherError(
            f"There is no clip at {clip}: give the path of a video file or an image sequence.", ExitCode.USAGE
        )
    backend = backend_environment()
    setting_up = set_up(backend, sys.executable)
    blender, took = get_blender()
    setting_up += took

    say(f"Freezing {clip} into {output}")
    command = tied_command(backend.python, "torch_backend", "freeze", clip, "--output", str(output), *options)
    code = run_child(command, cwd=HERE, tied=True)
    if code:
        return code
    summary = read_summary(output)
    if "shot" not in summary or "take" not in summary:
        raise LauncherError(f"The backend left no figures in {output / 'summary.json'}: see the messages above.", 1)
    # The bake rewrites summary.json with what it adds; the wall time and the set-up are ours to add after it.
    say(f"Compositing in {blender.label}")
    baking = time.monotonic()
    take = ["--shot", summary["shot"], "--take", summary["take"], "--output", str(output), "--tied"]
    bake = blender.running(ROOT / "splannequin_addon" / "run_in_bpy.py", "bake", *take)
    code = run_blender(bake, output / "blender.log", SPLANNEQUIN_BACKEND_PYTHON=backend.python)
    if code:
        return code
    summary = read_summary(output)
    stages = summary.setdefault("wall_seconds_by_stage", {})
    stages.update(setup=round(setting_up, 2), bake=round(time.monotonic() - baking, 2))
    summary["wall_seconds"] = round(time.monotonic() - started, 2)
    write_json(output / "summary.json", summary)
    closing_figures(summary, output)
    return 0


def closing_figures(summary: dict[str, Any], output: Path) -> None:
    """The last lines of a freeze: how good, how long, where to look."""
    stages = summary["wall_seconds_by_stage"]
    psnr = summary.get("heldout_psnr_db")
    say(f"Figures:       {output / 'summary.json'}")
    say("Wall seconds:  " + ", ".join(f"{name} {seconds:.0f}" for name, seconds in stages.items()))
    quality = f"Held-out PSNR {psnr:.2f} dB" if psnr is not None else "No held-out frames"
    say(
        f"{quality}; trained {summary.get('train_seconds', 0):.0f} s; {summary.get('registered')} of "
        f"{summary.get('solved_frames', summary.get('frames'))} frames registered; "
        f"{summary['wall_seconds']:.0f} s in all."
    )
    for line in summary.get("verdict", []):
        say(line)


def setup(series: Sequence[str], testing: bool, backend_only: bool, output: Path) -> int:
    """Makes the environments: the backend's, and the named bpy wheels (the one that fits, if none is named)."""
    stages = {"backend": round(set_up(backend_environment(testing), sys.executable), 2)}
    for name in series:
        stages[f"bpy-{name}"] = round(set_up_wheel(name, testing)[1], 2)
    if not series and not backend_only:
        blender, took = get_blender(testing)
        stages[blender.label.replace(" ", "-")] = round(took, 2)
    write_json(output / "summary.json", {"command": "setup", "exit_code": 0, "wall_seconds_by_stage": stages})
    say("Ready: " + ", ".join(stages))
    say(f"Backend Python, for the add-on's preferences: {backend_environment().python}")
    return 0


def set_up_wheel(series: str, testing: bool) -> tuple[Blender, float]:
    """The named bpy wheel, set up with a Python that fits it."""
    environment = bpy_environment(series, testing)
    python = environment.python if environment.ready() else python_for(series)
    if python is None:
        needed = dotted(BPY_WHEELS[series])
        raise LauncherError(f"The bpy wheel {series} needs Python {needed}, which is not on the PATH: install it.")
    return Blender(f"bpy {series}", (environment.python,)), set_up(environment, python)


def run_tests(pytest_args: Sequence[str], series: str | None, output: Path) -> int:
    """ruff, pyright, the backend's tests in .venv, the add-on's in one bpy wheel; closes with `N passed, N failed`."""
    paths = [a for a in pytest_args if not a.startswith("-") and (ROOT / a.split("::")[0]).exists()]
    rest = [a for a in pytest_args if a not in paths]
    if not paths:
        paths = ["tests/addon"] if series else ["tests", "tests/addon"]
    addon_paths = [p for p in paths if Path(p).as_posix().startswith("tests/addon")]
    backend_paths = [p for p in paths if p not in addon_paths]
    backend = backend_environment(testing=True)
    set_up(backend, sys.executable)
    legs: list[Leg] = []
    if not pytest_args and not series:
        legs.append(Leg("ruff", [backend.python, "-P", "-m", "ruff", "check", str(ROOT)]))
        legs.append(Leg("ruff format", [backend.python, "-P", "-m", "ruff", "format", "--check", str(ROOT)]))
        project = ["--project", str(ROOT), "--pythonpath", backend.python]
        legs.append(Leg("pyright", [backend.python, "-P", "-m", "pyright", *project]))
    if backend_paths:
        command = [backend.python, "-P", "-m", "pytest", "--ignore=tests/addon", *backend_paths, *rest]
        legs.append(Leg("backend", command, output / "junit-backend.xml"))
    if addon_paths:
        blender = set_up_wheel(series, True)[0] if series else get_blender(testing=True)[0]
        if not blender.is_wheel:
            raise LauncherError("The add-on's tests need a bpy wheel: start again with Python 3.11 or 3.13.")
        command = [*blender.command, "-P", "-m", "pytest", *addon_paths, *rest]
        legs.append(Leg(f"add-on in {blender.label}", command, output / "junit-addon.xml"))
    output.mkdir(parents=True, exist_ok=True)
    for leg in legs:
        leg.run(backend.python)
    return _close_tests(legs, output)


def bench(arguments: Sequence[str], output: Path) -> int:
    """The benchmark of the method: what it does not know here goes to benchmarks/bench.py."""
    started = time.monotonic()
    backend = backend_environment()
    setting_up = set_up(backend, sys.executable)
    setting_up += set_up(bench_environment(), backend.python)
    renderer: list[str] = []
    if not _own_scenes(arguments):
        blender, took = get_blender()
        if not blender.is_wheel:
            raise LauncherError(
                "The benchmark's scenes are rendered by a bpy wheel, and none fits: start again with Python 3.11 or "
                "3.13, or name scenes of your own by --truth or --shot."
            )
        renderer, setting_up = ["--bpy", blender.command[0]], setting_up + took
    command = [backend.python, "-P", "-m", "benchmarks.bench", "--results", str(output), "--tied", *renderer]
    code = run_child([*command, *arguments], cwd=HERE, tied=True)
    summary: dict[str, Any] = {"command": "bench", "exit_code": code}
    summary.update(wall_seconds=round(time.monotonic() - started, 2), setup_seconds=round(setting_up, 2))
    if code == 0:
        summary["report"] = str(output / "report" / "report.md")
    write_json(output / "summary.json", summary)
    return code


def _own_scenes(arguments: Sequence[str]) -> bool:
    """True if a benchmark's arguments ask for no synthetic scene."""
    named = {word.partition("=")[0] for word in arguments}
    return bool(named & {"--truth", "--shot"}) and not named & {"--size", "--quick", "--limits", "--hard"}


class Leg:
    """One part of the tests: its command, and what became of it."""

    def __init__(self, name: str, command: list[str], report: Path | None = None) -> None:
        self.name = name
        self.command = command if report is None else [*command, f"--junitxml={report}"]
        self.report = report
        self.passed = self.failed = self.skipped = 0
        self.seconds = 0.0

    def run(self, backend_python: str) -> None:
        """Runs it and counts: tests by pytest's report, a checker as one."""
        say(f"\n=== {self.name}")
        if self.report:
            self.report.unlink(missing_ok=True)
        started = time.monotonic()
        code = run_child(self.command, cwd=ROOT, SPLANNEQUIN_BACKEND_PYTHON=backend_python)
        self.seconds = time.monotonic() - started
        if self.report is None:
            self.passed, self.failed = int(code == 0), int(code != 0)
        else:
            self._count(self.report)
            picked = any(word.startswith("-k") for word in self.command)
            if code and not (code == 5 and picked) and not self.failed:  # 5: nothing ran
                self.failed = 1
        say(f"=== {self.name}: {self.passed} passed, {self.failed} failed, {self.seconds:.0f} s")

    def _count(self, report: Path) -> None:
        try:
            suites = ElementTree.parse(report).getroot().iter("testsuite")  # noqa: S314  (pytest's own, just written)
        except (OSError, ElementTree.ParseError):
            self.failed = 1
            return
        for suite in suites:
            bad = int(suite.get("failures", 0)) + int(suite.get("errors", 0))
            skipped = int(suite.get("skipped", 0))
            self.passed += int(suite.get("tests", 0)) - bad - skipped
            self.failed += bad
            self.skipped += skipped


def _close_tests(legs: Sequence[Leg], output: Path) -> int:
    passed, failed = sum(leg.passed for leg in legs), sum(leg.failed for leg in legs)
    code = 1 if failed or not passed else 0
    summary = {
        "command": "test",
        "exit_code": code,
        "passed": passed,
        "failed": failed,
        "skipped": sum(leg.skipped for leg in legs),
        "wall_seconds_by_stage": {leg.name: round(leg.seconds, 2) for leg in legs},
    }
    write_json(output / "summary.json", summary)
    for leg in legs:
        if leg.failed:
            say(f"failed: {leg.name}")
    say(f"{passed} passed, {failed} failed")
    return code


# ------------------------------------------------------------------------------------------------------- doctor


@dataclass(frozen=True)
class Finding:
    """One line of the doctor."""

    what: str
    """What was looked at."""
    state: str
    """ok, note (works without) or missing (does not)."""
    text: str
    """What was found, and what to do about it."""


def doctor(output: Path) -> int:
    """Says what this machine can do and what to do about what is missing; exit code 9 if the demo cannot run."""
    backend = backend_environment()
    facts: dict[str, Any] = backend_facts(backend) if backend.ready() else {}
    findings = [*machine_findings(), *gpu_findings(facts), *backend_findings(backend, facts), *blender_findings()]
    for finding in findings:
        say(f"{finding.state:<8} {finding.what:<16} {finding.text}")
    missing = [f for f in findings if f.state == "missing"]
    code = ExitCode.ENVIRONMENT if missing else 0
    lines = {f.what: {"state": f.state, "text": f.text} for f in findings}
    write_json(output / "summary.json", {"command": "doctor", "exit_code": code, "findings": lines, "backend": facts})
    say(f"{len(missing)} thing(s) missing." if missing else "This machine can run the demo.")
    return code


def machine_findings() -> Iterator[Finding]:
    """Python, system, cores, memory, disk."""
    version = platform.python_version()
    wheels = [s for s in DEMO_WHEELS if BPY_WHEELS[s] == sys.version_info[:2]]
    fits = f"fits bpy {' and '.join(wheels)}" if wheels else "fits no bpy wheel (3.11 and 3.13 do)"
    yield Finding("python", "ok", f"{version} at {sys.executable}; {fits}")
    if sys.maxsize < 2**32:
        yield Finding("64 bit", "missing", "this Python is 32-bit: install a 64-bit one")
    cores = os.cpu_count() or 1
    yield Finding("cores", "ok" if cores > 1 else "note", f"{cores} on {platform.platform(terse=True)}")
    memory = memory_gb()
    if memory is not None:
        enough = memory >= 6
        yield Finding(
            "memory", "ok" if enough else "note", f"{memory:.1f} GB{'' if enough else ': close other programs'}"
        )
    folder = next(p for p in (home(), *home().parents) if os.path.exists(p))
    if not backend_environment().ready() and not (folder.is_dir() and os.access(folder, os.W_OK)):
        yield Finding("home", "missing", f"{folder} cannot be written: name another folder in SPLANNEQUIN_HOME")
    free = shutil.disk_usage(folder).free / 1e9
    need = 1.0 if backend_environment().ready() else BACKEND_DISK_GB + BPY_DISK_GB
    advice = "" if free >= need else f": {need:.0f} GB are needed, free some or set SPLANNEQUIN_HOME to another disk"
    yield Finding("disk", "ok" if free >= need else "missing", f"{free:.0f} GB free in {folder}{advice}")


def memory_gb() -> float | None:
    """Physical memory in GB; None where the system does not say."""
    if WINDOWS:

        class Status(ctypes.Structure):
            _fields_ = [
                ("length", ctypes.c_ulong),
                ("load", ctypes.c_ulong),
                ("total", ctypes.c_ulonglong),
                ("unread", ctypes.c_ulonglong * 6),
            ]

        status = Status(length=ctypes.sizeof(Status))
        windll = getattr(ctypes, "windll")  # noqa: B009  (exists on Windows alone)
        return status.total / 1e9 if windll.kernel32.GlobalMemoryStatusEx(ctypes.byref(status)) else None
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    except (ValueError, OSError):
        return None


def gpu_findings(facts: dict[str, Any]) -> Iterator[Finding]:
    """NVIDIA cards: whether driver and card fit the pinned Warp and torch, and whether the backend uses them."""
    cards, trouble = nvidia_cards()
    if trouble:
        advice = "restart the machine; if it stays, install the driver anew"
        yield Finding("gpu", "note", f"the NVIDIA driver does not answer: {trouble}: {advice}")
    elif not cards:
        yield Finding("gpu", "note", "no NVIDIA card or driver: the CPU is used, nothing is missing")
    yield from map(gpu_finding, cards)
    if any(card.fits for card in cards) and facts.get("trains_on") == "cpu":
        unseen = None if facts.get("torch_device") == "cuda" else why_unused(facts.get("torch_cuda"))
        told = " ".join(unseen) if unseen else facts.get("cuda_refusal") or "CUDA_VISIBLE_DEVICES hides the card"
        yield Finding("torch on gpu", "note", told)


def gpu_finding(card: Card) -> Finding:
    """One card against what Warp and torch need."""
    unfit = why_unfit(card)
    if unfit is not None:
        return Finding("gpu", "note", " ".join(unfit).strip())
    return Finding("gpu", "ok", f"{card.name}, driver {card.driver}, compute capability {card.compute or 'unknown'}")


def backend_facts(backend: Environment) -> dict[str, Any]:
    """What the backend says about its own environment."""
    command = python_child(backend.python, "torch_backend", "doctor")
    ran = subprocess.run(**command, capture_output=True, text=True, env=child_environ())
    try:
        return json.loads(ran.stdout[ran.stdout.index("{") :])
    except ValueError:
        return {"error": (ran.stderr.strip().splitlines() or ["no answer"])[-1]}


def backend_findings(backend: Environment, facts: dict[str, Any]) -> Iterator[Finding]:
    """The backend's environment: made, torch's device, the video encoder."""
    if not facts:
        begun = "not finished" if backend.folder.is_dir() else "not made yet"
        yield Finding("backend", "note", f"{begun}: `python3 splannequin.py setup` makes it in {backend.folder}")
        return
    if "error" in facts:
        yield Finding("backend", "missing", f"{facts['error']}: remove {backend.folder} and run setup again")
        return
    packages = facts["packages"]
    yield Finding("backend", "ok", f"{backend.folder}, Python {facts['python']}, warp {packages['warp-lang']}")
    device = facts.get("cuda_device") or facts["torch_device"]
    yield Finding("torch", "ok", f"{packages['torch']} sees {device}; training uses the {facts['trains_on']}")
    h264 = facts["h264"]
    yield Finding("H.264", "ok" if h264 else "note", "libx264" if h264 else "no encoder in PyAV: reinstall .venv")


def opens(library: str) -> bool:
    """True if the system finds this shared library."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def blender_findings() -> Iterator[Finding]:
    """The bpy wheels that are set up or can be, the libraries they open, and a Blender on the PATH."""
    found = find_blender()
    packages = [package for name, package in BLENDER_LIBRARIES.items() if not opens(name)] if LINUX else []
    if packages:
        advice = f"install them (Debian and Ubuntu: apt install {' '.join(packages)})"
        state = "note" if found else "missing"
        yield Finding("libraries", state, f"a bpy wheel opens libraries that are not here: {advice}")
    ready = [s for s in BPY_WHEELS if bpy_environment(s).ready()]
    if ready:
        yield Finding("bpy", "ok", f"wheel(s) {', '.join(ready)} set up")
    wheels = [] if ready else choose_wheels()
    if wheels:
        yield Finding("bpy", "note", f"not made yet: `python3 splannequin.py setup` installs bpy {wheels[0][0]}")
    if found:
        yield Finding("blender", "ok", f"{found[1]} at {found[0]}")
    elif ready or wheels:
        yield Finding("blender", "note", "none on the PATH; the bpy wheel is used")
    else:
        advice = "install Blender 4.2 or newer and put it on the PATH, or use Python 3.11 or 3.13"
        yield Finding("blender", "missing", f"no bpy wheel fits and no `blender` is on the PATH: {advice}")


# --------------------------------------------------------------------------------------------------------- main


def parser() -> argparse.ArgumentParser:
    """The grammar. What `freeze` and `demo` do not know goes to the backend, what `test` does not, to pytest, what
    `bench` does not, to benchmarks/bench.py."""
    top = argparse.ArgumentParser(
        prog="splannequin.py", description="Freeze time in a handheld clip.", allow_abbrev=False
    )
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    helps = {
        "demo": "freeze the bundled clip",
        "freeze": "freeze your own clip; other options go to the backend (--t-star N, --preset NAME, ...)",
        "test": "run all tests; other arguments go to pytest",
        "bench": "the method against ground truth; other options go to benchmarks/bench.py (--quick, --jobs N, ...)",
        "doctor": "say what this machine can do",
        "setup": "make the environments and stop",
    }
    for name, text in helps.items():
        command = commands.add_parser(name, help=text, description=text, allow_abbrev=False)
        if name == "freeze":
            command.add_argument("clip", metavar="CLIP", help="video file, image sequence or pattern (shot.####.exr)")
        if name in ("test", "setup"):
            command.add_argument("--bpy", choices=sorted(BPY_WHEELS), help="the bpy wheel (default: one that fits)")
        if name == "setup":
            command.add_argument("--tests", action="store_true", help="with what `test` needs")
            command.add_argument("--backend", action="store_true", help="the backend alone (for the add-on)")
        names = ("--output", "--results") if name == "bench" else ("--output",)
        command.add_argument(*names, metavar="DIR", help="folder for summary.json and results (output/...)")
    return top


def _interrupt(number: int, frame: object) -> None:
    raise KeyboardInterrupt


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    module = {"freeze": ["torch_backend", "freeze"], "bench": ["benchmarks.bench"]}.get(words[0] if words else "")
    if module and {"-h", "--help"} & set(words) and backend_environment().ready():
        return run_child([backend_environment().python, "-P", "-m", *module, "--help"], cwd=HERE)
    args, rest = parser().parse_known_args(words)
    if rest and args.command in ("doctor", "setup"):
        parser().error(f"unrecognized arguments: {' '.join(rest)}")
    for name in ("SIGTERM", "SIGHUP", "SIGBREAK"):
        if hasattr(signal, name) and signal.getsignal(getattr(signal, name)) == signal.SIG_DFL:
            signal.signal(getattr(signal, name), _interrupt)
    default = re.sub(r"[^\w.-]+", "_", Path(args.clip).stem) if args.command == "freeze" else args.command
    try:
        output = Path(os.path.abspath(args.output or Path("output") / default))
    except OSError:
        print("Error: The folder that you stand in is gone: change to another and start again.", file=sys.stderr)
        return ExitCode.USAGE
    error = ""
    try:
        output.mkdir(parents=True, exist_ok=True)
        # A summary of an earlier run must not pass for this one's.
        (output / "summary.json").unlink(missing_ok=True)
        tempfile.TemporaryFile(dir=output).close()  # said now, not after minutes of work
        code = dispatch(args, rest, output)
    except LauncherError as refused:
        error, code = str(refused), refused.exit_code
    except KeyboardInterrupt as interrupt:
        error, code = "Cancelled.", ExitCode.CANCELLED
        if not interrupt.args:
            print("Cancelled. Start the same command again to go on.", file=sys.stderr, flush=True)
    except OSError as failed:
        error, code = _unwritable(failed, output)
    if code and not error:
        error = failed_job(output) or f"{args.command} ended with exit code {code}: see what it printed."
    elif error and code != ExitCode.CANCELLED:
        print(f"Error: {error}", file=sys.stderr, flush=True)
    if code:
        with contextlib.suppress(OSError):
            failure = {"command": args.command, "exit_code": code, "error": error}
            write_json(output / "summary.json", {**read_summary(output), **failure})
    return code


def _unwritable(failed: OSError, output: Path) -> tuple[str, int]:
    """(sentence, exit code) of what the system refused, most often to write into the output folder."""
    where = Path(os.fsdecode(failed.filename)) if isinstance(failed.filename, (str, bytes)) else output
    code = ExitCode.DISK if is_disk_full(failed) else ExitCode.USAGE
    if where != output and where not in output.parents and output not in where.parents:
        code = ExitCode.DISK if code == ExitCode.DISK else ExitCode.ENVIRONMENT
        return f"{failed.strerror or failed}: {where}. See `doctor`, then start the same command again.", code
    return f"Cannot write to {output}: {failed.strerror or failed}. Choose another --output folder.", code


def dispatch(args: argparse.Namespace, rest: list[str], output: Path) -> int:
    """Runs the chosen command; returns its exit code."""
    if args.command == "demo":
        return freeze(str(DEMO_CLIP), output, ["--preset", "preview", *rest])
    if args.command == "freeze":
        return freeze(args.clip, output, rest)
    if args.command == "setup":
        return setup([args.bpy] if args.bpy else [], args.tests, args.backend, output)
    if args.command == "bench":
        return bench(rest, output)
    if args.command == "test":
        return run_tests(rest, args.bpy, output)
    return doctor(output)


if __name__ == "__main__":
    sys.exit(main())
