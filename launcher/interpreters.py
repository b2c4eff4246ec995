"""Finds Pythons on this machine. Runs under Python 3.8, so that an old Python can report which version is needed."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Callable, Sequence  # noqa: UP035  (runs under 3.8)

from .places import ROOT, WINDOWS

NEEDED_PYTHON = (3, 11)


def python_version(executable: str) -> tuple[int, int] | None:
    """(major, minor) of the Python at `executable`; None if it does not run, such as a pyenv shim without a version."""
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
    """The first Python whose version is accepted: the running one, then `names` on the PATH, from pyenv and from py."""
    if accept(sys.version_info[:2]):
        return sys.executable
    candidates: list[str] = []
    for name in names:
        for folder in os.get_exec_path():
            found = shutil.which(name, path=folder)
            if found and os.path.isabs(found):  # skips the working folder, which Windows searches first
                candidates.append(found)
        number = name.replace("python", "")
        if number:
            pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
            candidates += [str(p) for p in sorted(pyenv.glob(f"{number}.*/bin/{name}"), reverse=True)]
            launcher = shutil.which("py") if WINDOWS else None
            if launcher and os.path.isabs(launcher):
                command = [launcher, f"-{number}", "-I", "-c", "import sys; print(sys.executable)"]
                located = subprocess.run(command, capture_output=True, text=True)
                if located.returncode == 0:
                    candidates.append(located.stdout.strip())
    for candidate in dict.fromkeys(candidates):
        version = python_version(candidate)
        if version and accept(version):
            return candidate
    return None


def hand_over_to_newer_python() -> int:
    """Runs the launcher again under a newer Python and returns its exit code; prints an error if there is none."""
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
    command = [newer, str(ROOT / "splannequin.py"), *sys.argv[1:]]
    if WINDOWS:  # execv would start a second process there, and the shell would not wait for it
        return subprocess.call(command)
    os.execv(newer, command)  # noqa: S606  (no shell is wanted)
