"""What a step is, and which there are: each room of a step hands in one object, and nothing else asks for its name.

Buttons, timer, panel and command line ask the object: what the backend is asked for, what its answer changes in the
scene, what the panel says, what is removed with a shot. Whoever adds a step adds a room (see CONTRIBUTING.md).
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
    """What a step shows of itself."""

    done: bool
    """It has been done."""
    ready: bool
    """What it needs is there."""
    state: list[str] = field(default_factory=list[str])
    """What there is, in short lines, the most important first: the panel shows two, and the others in a fold."""
    advice: str = ""
    """One sentence: what comes next."""
    brief: str = ""
    """The result in one or two words, for the header of a step that is folded."""
    is_unfinished: bool = False
    """It has been done, but the scene lacks its result."""


class Part(Protocol):
    """A module that Blender has to be told of beside the classes."""

    def register(self) -> None:
        """When the add-on is switched on."""

    def unregister(self) -> None:
        """When it is switched off."""


class Panel(Protocol):
    """What draws a step in the tab."""

    def draw(self, context: bpy.types.Context, layout: bpy.types.UILayout, is_at_hand: bool) -> None:
        """Its header, and its body while it is open; `is_at_hand` if it is the step to work on."""


class Step:
    """One of the five; made once by its room."""

    name: ClassVar[str]
    """Identifier."""
    label: ClassVar[str]
    """Name on the panel."""
    kind: ClassVar[str]
    """Kind of the job behind it."""
    also: ClassVar[tuple[str, ...]] = ()
    """Other kinds of jobs that its panel starts."""
    button: ClassVar[str]
    """What the button says."""
    again: ClassVar[str]
    """What the button says once the step is done."""
    needs: ClassVar[str] = ""
    """What to do before, in a sentence; empty if nothing."""
    makes_shot: ClassVar[bool] = False
    """It begins with a shot folder that is not there yet."""
    panel: ClassVar[Panel]
    """Draws it in the tab."""
    classes: ClassVar[tuple[type, ...]] = ()
    """Its operators, in the order in which they are registered."""
    parts: ClassVar[tuple[Part, ...]] = ()
    """Modules of its room with a `register` and an `unregister` of their own."""

    def params(self, scene: bpy.types.Scene) -> jobs.Params:
        """The backend's parameters, from what the artist set. JobError names what is missing."""
        raise NotImplementedError

    def view(self, scene: bpy.types.Scene, state: ShotState | None) -> View:
        """What the panel shows of it, as the shot stands."""
        raise NotImplementedError

    def in_turns(self, scene: bpy.types.Scene, shot: Path) -> Iterator[Any] | None:
        """What the timer does in turns before it begins the job itself; None if the job can begin at once."""
        return None

    def finish(self, scene: bpy.types.Scene, job: jobs.Job) -> list[str]:
        """What a finished job changes in the scene; returns it in words."""
        return []

    def is_usable(self, job: jobs.Job) -> bool:
        """True if a job that still runs has left all that `finish` needs: the scene gets it at once."""
        return False

    def arrive(self, scene: bpy.types.Scene, job: jobs.Job) -> bool:
        """Has the timer do the work of `finish` in turns, in a window. False if that is not needed."""
        return False

    def late(self, job: jobs.Job) -> str:
        """Sentence, instead of `finish`, about a job that ended before its shot was chosen; empty: it is finished."""
        return ""

    def began(self, job: jobs.Job) -> None:
        """Its job was started."""

    def ended(self, job: jobs.Job) -> None:
        """Its job has ended, well or not."""

    def look(self, window: bpy.types.Window, scene: bpy.types.Scene, shot: Path) -> None:
        """What a window shows once a finished job has changed its scene."""

    def log(self, job: jobs.Job) -> Path | None:
        """The log of a job that has something in it, None without."""
        return next((log for log in self.logs(job) if _written(log)), None)

    def logs(self, job: jobs.Job) -> list[Path]:
        """Where a job's words may stand, its own first."""
        return [job.folder / contract.LOG_FILE]

    def in_use(self, shot: Path, folder: Path) -> str:
        """Why a run or take of a shot cannot be removed now, in words; empty if it can."""
        return ""

    def stands(self, scene: bpy.types.Scene, shot: Path) -> bool:
        """True if something of a shot is in the scene."""
        return False

    def remove(self, scene: bpy.types.Scene, shot: Path, others: list[Path]) -> list[str]:
        """Takes what it made for a shot out of the scene, but what `others`, shots too, need; says what was done."""
        return []

    def scaled(self, scene: bpy.types.Scene, shot: Path) -> list[str]:
        """Follows a shot that was scaled in the scene; returns what was changed, in words."""
        return []


def _written(log: Path) -> bool:
    try:
        return stat.S_ISREG(log.stat().st_mode) and log.stat().st_size > 0
    except OSError:
        return False


STEPS: dict[str, Step] = {}
"""The steps in order, by name. `registration.py` fills it."""


def add(step: Step) -> None:
    """Makes a step known, after those that are."""
    STEPS[step.name] = step


def step_of(job: jobs.Job) -> str:
    """Name of the step that a job found in a shot folder belongs to: Freeze and Bake ask for the same kind."""
    noted = _noted(job, contract.STEP_FILE)
    names = [s.name for s in STEPS.values() if job.kind in (s.kind, *s.also)]
    return noted if noted in names else names[0]


def scene_of(job: jobs.Job) -> str:
    """Name of the scene from which a job was started; empty if unknown."""
    return _noted(job, contract.SCENE_FILE)


def blend_of(job: jobs.Job) -> str:
    """Name of the .blend from which a job was started; empty if unknown."""
    return contract.printable(_noted(job, contract.BLEND_FILE), 200)


def _noted(job: jobs.Job, name: str) -> str:
    """What Blender wrote into a job's folder; empty of a job that was started from the backend's command line."""
    try:
        with contract.open_regular(job.folder / name) as file:
            return file.read(1024).decode("utf-8", "replace")
    except (OSError, ValueError):
        return ""
