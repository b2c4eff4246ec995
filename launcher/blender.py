"""Finds a Blender for the add-on: a bpy wheel that fits a Python of this machine, or a Blender on the PATH."""

from __future__ import annotations

import os
import platform
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from torch_backend.contract import ExitCode, program, site_packages

from .children import say
from .environments import bpy_environment, set_up
from .errors import LauncherError
from .interpreters import dotted, find_python

BPY_WHEELS = {"5.0": (3, 11), "5.2": (3, 13), "4.5": (3, 11), "4.2": (3, 11)}
"""Blender series with a pinned wheel in requirements/, and the Python that each needs, in order of preference."""
DEMO_WHEELS = ("5.0", "5.2", "4.5")
OLDEST_BLENDER = (4, 2)


@dataclass(frozen=True)
class Blender:
    """A program that runs the add-on's Python files: the interpreter of a bpy wheel, or a Blender on the PATH."""

    label: str
    """Name in messages."""
    command: tuple[str, ...]
    """Command line before the script's path."""

    @property
    def is_wheel(self) -> bool:
        """True for a Python that can import bpy."""
        return len(self.command) == 1

    def running(self, script: Path, *arguments: str) -> list[str]:
        """The command line that runs `script` with `arguments`."""
        safe, separator = (("-P",), ()) if self.is_wheel else ((), ("--",))
        return [*self.command, *safe, str(script), *separator, *arguments]

    def extension_tool(self, *arguments: str) -> list[str]:
        """The command line that runs Blender's tool for extensions (`build`, `validate`, `server-generate`).

        Raises LauncherError if a bpy wheel has no such tool.
        """
        if not self.is_wheel:
            return [self.command[0], "--background", "--factory-startup", "--command", "extension", *arguments]
        python = self.command[0]
        packages = site_packages(Path(python).parent.parent)
        tools = sorted(packages.glob("bpy/*/scripts/addons_core/bl_pkg/cli/blender_ext.py")) if packages else []
        if not tools:
            raise LauncherError(
                f"{self.label} of {python} has no command for extensions: choose a Blender with --blender."
            )
        return [python, "-P", str(tools[0]), *arguments]


def find_blender() -> tuple[str, str] | None:
    """(path, version) of a `blender` on the PATH that is new enough."""
    path = program("blender")
    version = blender_version(path) if path else None
    if path is None or version is None or version[0] < OLDEST_BLENDER:
        return None
    return path, version[1]


def blender_version(path: str) -> tuple[tuple[int, int], str] | None:
    """((major, minor), full version) of the Blender at `path`; None if it does not run or is another program."""
    try:
        done = subprocess.run([path, "--version"], capture_output=True, text=True, errors="replace", timeout=60)
    except (OSError, subprocess.TimeoutExpired):
        return None
    found = re.search(r"^Blender (\d+)\.(\d+)(\S*)", done.stdout, re.M)
    if not found:
        return None
    return (int(found.group(1)), int(found.group(2))), f"{found.group(1)}.{found.group(2)}{found.group(3)}"


def named_blender(path: str) -> Blender:
    """The Blender at a user's path. Raises LauncherError if it is another program, or too old for the add-on."""
    place = os.path.abspath(path)
    if not os.path.isfile(place):
        raise LauncherError(f"There is no Blender at {place}: pass the path of the Blender program.", ExitCode.USAGE)
    version = blender_version(place)
    if version is None:
        raise LauncherError(f"{place} does not run as Blender: pass the path of the Blender program.", ExitCode.USAGE)
    if version[0] < OLDEST_BLENDER:
        oldest = dotted(OLDEST_BLENDER)
        raise LauncherError(f"{place} is Blender {version[1]}: version {oldest} or newer is needed.", ExitCode.USAGE)
    return program_at(place, version[1])


def program_at(path: str, version: str) -> Blender:
    """The Blender whose program is at `path`."""
    options = ("--background", "--factory-startup", "--python-exit-code", str(int(ExitCode.BAKE)), "--python")
    return Blender(f"Blender {version}", (path, *options))


def choose_wheels() -> list[tuple[str, str]]:
    """(series, python) of the bpy wheels that this machine can run, in order of preference.

    If wheels fit the running Python, they are the choices, those already set up first. Else the only choice is a wheel
    that is already set up, with python "". Without such a wheel, the choices are all that fit a Python of the machine.
    """
    at_hand = [(s, sys.executable) for s in DEMO_WHEELS if BPY_WHEELS[s] == sys.version_info[:2]]
    if at_hand:
        return sorted(at_hand, key=lambda wheel: not bpy_environment(wheel[0]).ready())
    fitting: list[tuple[str, str]] = []
    for series in DEMO_WHEELS:
        if bpy_environment(series).ready():
            return [(series, "")]
        python = python_for(series)
        if python:
            fitting.append((series, python))
    return fitting


def python_for(series: str) -> str | None:
    """A Python of the machine that fits the bpy wheel of `series`; None if there is none."""
    needed = BPY_WHEELS[series]
    return find_python(lambda version: version == needed, (f"python{dotted(needed)}",))


def get_blender(testing: bool = False, wheels: Path | None = None) -> tuple[Blender, float]:
    """A Blender for the add-on, set up if necessary, and the seconds of the set-up.

    `wheels` is a folder to install from instead of a package index. Raises LauncherError if no Blender is available.
    """
    choices = choose_wheels()
    refused: LauncherError | None = None
    took = 0.0
    for series, python in choices:
        environment = bpy_environment(series, testing)
        try:
            took += set_up(environment, python or environment.python, wheels)
        except LauncherError as error:
            refused = error
            say(f"  note: {error}")
            continue
        return Blender(f"bpy {series}", (environment.python,)), took
    found = find_blender()
    if found:
        return program_at(*found), took
    if refused:
        raise refused
    raise LauncherError(
        f"No Blender was found: no bpy wheel fits Python {platform.python_version()} (they need 3.11 or 3.13), and "
        "there is no `blender` 4.2 or newer on the PATH. Install either and run the same command again."
    )


def set_up_wheel(series: str, testing: bool, wheels: Path | None = None) -> tuple[Blender, float]:
    """The bpy wheel of `series`, set up with a Python that fits it, and the seconds of the set-up."""
    environment = bpy_environment(series, testing)
    python = environment.python if environment.ready() else python_for(series)
    if python is None:
        needed = dotted(BPY_WHEELS[series])
        raise LauncherError(f"The bpy wheel {series} needs Python {needed}, which is not on the PATH: install it.")
    return Blender(f"bpy {series}", (environment.python,)), set_up(environment, python, wheels)
