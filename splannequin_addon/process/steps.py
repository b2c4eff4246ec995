"""Base class of a step, and the registry of steps. Each step's package provides one object.

This object defines the backend request, the changes to the scene, the panel's content, and the removal of a shot.
Operators, timer, panel and command line use it. A new step is a new package (see CONTRIBUTING.md).
"""

from __future__ import annotations

import stat
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from ...torch_backend import contract
from ..shot.shot_state import ShotState
from . import jobs

if TYPE_CHECKING:
    import bpy


@dataclass
class View:
    """State of a step for the panel."""

    done: bool
    """True if the step has been done."""
    ready: bool
    """True if all requirements of the step are met."""
    state: list[str] = field(default_factory=list[str])
    """Short sentences about the result, most important first. The panel shows two, the others in a sub-panel."""
    advice: str = ""
    """Sentence about the next action; may be empty."""
    brief: str = ""
    """The result in one or two words, for the header of a collapsed step."""
    is_unfinished: bool = False
    """True if the step has been done but the scene lacks its result."""


class Part(Protocol):
    """A module with its own registration in Blender, besides the classes."""

    def register(self) -> None:
        """Called when the add-on is enabled."""

    def unregister(self) -> None:
        """Called when the add-on is disabled."""


class Panel(Protocol):
    """Draws a step in the sidebar tab."""

    def draw(self, context: bpy.types.Context, layout: bpy.types.UILayout, is_current: bool) -> None:
        """Draws the header, and the body if it is open. `is_current` marks the step to work on."""


class Step:
    """One of the five steps, created once by its package."""

    name: ClassVar[str]
    """Identifier of the step."""
    label: ClassVar[str]
    """Name on the panel."""
    kind: ClassVar[str]
    """Kind of the step's job."""
    also: ClassVar[tuple[str, ...]] = ()
    """Other kinds of jobs that the step's panel starts."""
    button: ClassVar[str]
    """Label of the operator's button."""
    again: ClassVar[str]
    """Label of the button once the step is done."""
    needs: ClassVar[str] = ""
    """Sentence about what to do first; may be empty."""
    makes_shot: ClassVar[bool] = False
    """True if the step creates the shot folder."""
    panel: ClassVar[Panel]
    """Draws the step in the sidebar tab."""
    classes: ClassVar[tuple[type, ...]] = ()
    """Operators of the step in order of registration."""
    parts: ClassVar[tuple[Part, ...]] = ()
    """Modules of the step's package with their own `register` and `unregister`."""

    def params(self, scene: bpy.types.Scene) -> jobs.Params:
        """The backend's parameters from the artist's settings. Raises JobError, which names what is missing."""
        raise NotImplementedError

    def view(self, scene: bpy.types.Scene, state: ShotState | None) -> View:
        """Panel state of the step for the shot's current state."""
        raise NotImplementedError

    def in_turns(self, scene: bpy.types.Scene, shot: Path) -> Iterator[Any] | None:
        """Iterator with work that the timer does in steps and that then starts the job; None if the job can start at
        once."""
        return None

    def finish(self, scene: bpy.types.Scene, job: jobs.Job) -> list[str]:
        """Applies a finished job to the scene. Returns the changes as sentences."""
        return []

    def is_usable(self, job: jobs.Job) -> bool:
        """True if a running job has already written everything that `finish` needs. The scene then gets it at once."""
        return False

    def arrive(self, scene: bpy.types.Scene, job: jobs.Job) -> bool:
        """Starts the work of `finish` in steps run by the timer, in a window. False if that is not needed."""
        return False

    def late(self, job: jobs.Job) -> str:
        """Sentence to show, instead of `finish`, for a job that ended before its shot was selected; empty to call
        `finish`."""
        return ""

    def began(self, job: jobs.Job) -> None:
        """Called when the step's job was started."""

    def ended(self, job: jobs.Job) -> None:
        """Called when the step's job has ended, with or without success."""

    def look(self, window: bpy.types.Window, scene: bpy.types.Scene, shot: Path) -> None:
        """Sets up a window's view after a finished job has changed its scene."""

    def log(self, job: jobs.Job) -> Path | None:
        """The first non-empty log of a job, or None."""
        return next((log for log in self.logs(job) if _written(log)), None)

    def logs(self, job: jobs.Job) -> list[Path]:
        """Possible log files of a job, its own first."""
        return [job.folder / contract.LOG_FILE]

    def in_use(self, shot: Path, folder: Path) -> str:
        """The reason why a run or take of a shot cannot be deleted now; empty if it can."""
        return ""

    def is_present(self, scene: bpy.types.Scene, shot: Path) -> bool:
        """True if the scene has objects or settings of a shot."""
        return False

    def remove(self, scene: bpy.types.Scene, shot: Path, remaining: list[Path]) -> list[str]:
        """Removes the step's results for a shot from the scene, except those that the shots `remaining` need. Returns
        the changes."""
        return []

    def scaled(self, scene: bpy.types.Scene, shot: Path) -> list[str]:
        """Updates the scene after a shot was scaled. Returns the changes as sentences."""
        return []


def _written(log: Path) -> bool:
    try:
        return stat.S_ISREG(log.stat().st_mode) and log.stat().st_size > 0
    except OSError:
        return False


STEPS: dict[str, Step] = {}
"""Name -> step, in order. `registration.py` fills it."""


def add(step: Step) -> None:
    """Appends a step to `STEPS`."""
    STEPS[step.name] = step


def step_of(job: jobs.Job) -> str:
    """Name of the step that a job belongs to."""
    noted = _noted(job, contract.STEP_FILE)  # Freeze and Bake start the same kind of job
    names = [s.name for s in STEPS.values() if job.kind in (s.kind, *s.also)]
    return noted if noted in names else names[0]


def scene_of(job: jobs.Job) -> str:
    """Name of the scene from which a job was started; empty if unknown."""
    return _noted(job, contract.SCENE_FILE)


def blend_of(job: jobs.Job) -> str:
    """Name of the .blend from which a job was started; empty if unknown."""
    return contract.printable(_noted(job, contract.BLEND_FILE), 200)


def _noted(job: jobs.Job, name: str) -> str:
    """A note that Blender wrote into a job's folder; empty for a job started by the backend's command line."""
    try:
        with contract.open_regular(job.folder / name) as file:
            return file.read(1024).decode("utf-8", "replace")
    except (OSError, ValueError):
        return ""
