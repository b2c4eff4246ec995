"""How far a render of a baked shot is: Blender renders by itself, and tells handlers of every frame."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy.app.handlers import persistent

from ..process import job_timer
from ..process.job_timer import Progress, Watch, Work
from ..shot import selection

_IDLE_TURNS = 2
"""Turns of the timer without a render job after which a render that told no end is over: one may be before it."""


def began(shot: Path, frames: int) -> None:
    """A render of a baked shot begins."""
    job_timer.watch_of(shot).work = Work("bake", None, _progress(0, frames))
    idle = 0

    def look() -> bool:
        nonlocal idle
        idle = 0 if bpy.app.is_job_running("RENDER") else idle + 1
        return going_on(shot) and (idle < _IDLE_TURNS or not end_untold(shot))

    job_timer.meanwhile(look)


def going_on(shot: Path) -> bool:
    """True while nothing has told the end of a shot's render."""
    work = job_timer.watch_of(shot).work
    return work is not None and work.turns is None


def end_untold(shot: Path) -> bool:
    """Ends a render that is over without a word of its handlers, as Blender leaves it where it cannot begin a movie's
    file. True if there was one."""
    if not going_on(shot):
        return False
    watch = job_timer.watch_of(shot)
    watch.work = None
    places = [scene.render.filepath for scene in selection.scenes_of(shot)]
    watch.failures["bake"] = (
        f"Blender rendered nothing: can {', '.join(places)} be written to?",
        "Choose another output path, or see the console for Blender's own words.",
    )
    watch.redraw = True
    return True


def refused(shot: Path) -> None:
    """It did not begin: nothing else would tell the panel."""
    job_timer.watch_of(shot).work = None


def _progress(done: int, total: int) -> Progress:
    return Progress(f"Rendering, frame {done} of {total}", done, total, "Press Esc in the render window to stop.")


def _renders() -> list[tuple[Watch, Progress]]:
    """Shots that are being rendered, and how far they are."""
    works = [(watch, watch.work) for watch in job_timer.watches()]
    return [(w, k.progress) for w, k in works if k is not None and k.turns is None and k.progress is not None]


@persistent
def _on_frame(*_: object) -> None:
    for watch, now in _renders():
        watch.work = Work("bake", None, _progress(now.done + 1, now.total))
        watch.redraw = True


@persistent
def _on_end(*_: object) -> None:
    for watch, now in _renders():
        watch.work = None
        watch.redraw = True
        watch.notes.setdefault("bake", []).append(f"{now.done} of {now.total} frames rendered.")


def register() -> None:
    """Listens to renders."""
    bpy.app.handlers.render_write.append(_on_frame)
    bpy.app.handlers.render_complete.append(_on_end)
    bpy.app.handlers.render_cancel.append(_on_end)


def unregister() -> None:
    """Undoes `register`."""
    bpy.app.handlers.render_cancel.remove(_on_end)
    bpy.app.handlers.render_complete.remove(_on_end)
    bpy.app.handlers.render_write.remove(_on_frame)
