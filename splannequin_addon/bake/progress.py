"""Progress and end of the render of a baked shot. Blender renders independently and calls handlers for each frame."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy.app.handlers import persistent

from ...torch_backend import contract
from ..process import job_timer
from ..process.job_timer import Progress, Work
from ..scene import session
from . import render_settings, rendering

# Number of timer turns without a render job after which a render counts as over, even without an end handler. The first
# turn may come before the render job starts.
_IDLE_TURNS = 2
# Shot -> its running render.
_runs: dict[Path, rendering.Run] = {}
# Shot -> whether its render was cancelled, set by the handlers at the end of a render. The timer restores the scene,
# because handlers of a window's render run in a separate thread.
_ended: dict[Path, bool] = {}


def began(shot: Path, run: rendering.Run) -> None:
    """Starts to track the render of a baked shot. The scene must already be set up."""
    _runs[shot] = run
    _ended.pop(shot, None)
    watch = job_timer.watch_of(shot)
    work = watch.work = Work("bake", None, _progress(run))
    idle = 0

    def tell(*_: int) -> None:
        # Runs in the render thread: it must not set `watch.work`, which Cancel may clear at the same time.
        work.progress = _progress(run)
        watch.redraw = True

    run.on_frame = tell

    def look() -> bool:
        nonlocal idle
        if _runs.get(shot) is not run:
            return False
        if bpy.app.is_job_running("RENDER"):
            idle = 0
            return True
        idle += 1
        # Cancel clears `watch.work`. A movie file that cannot be opened ends a render without a handler call.
        if shot not in _ended and job_timer.watch_of(shot).work is not None and idle < _IDLE_TURNS:
            return True
        finish(shot)
        return False

    job_timer.call_until_false(look)


def finish(shot: Path) -> None:
    """Restores the scene after a render and shows the result on the panel."""
    run = _runs.pop(shot, None)
    if run is None:
        return
    watch = job_timer.watch_of(shot)
    is_cancelled = _ended.pop(shot, False) or watch.work is None
    watch.work = None
    watch.redraw = True
    try:
        run.finish(session.scene_of(run.scene_uid), is_cancelled)
    except contract.JobError as error:
        watch.fail("bake", error)
    except (OSError, RuntimeError, ValueError) as error:
        watch.failures["bake"] = f"The render of this shot failed: {error}", "Bake again."
    notes = [f"{len(run.done)} of {len(run.wanted)} frames rendered.", *run.notes]
    watch.notes.setdefault("bake", []).extend(note for note in notes if note not in watch.notes.get("bake", []))


def _progress(run: rendering.Run) -> Progress:
    done, total = len(run.done), len(run.wanted)
    return Progress(f"Rendering, frame {done} of {total}", done, total, "Press Esc in the render window to stop.")


@persistent
def _on_complete(scene: bpy.types.Scene, *_: object) -> None:
    _end(scene, False)


@persistent
def _on_cancel(scene: bpy.types.Scene, *_: object) -> None:
    _end(scene, True)


def _end(scene: bpy.types.Scene, is_cancelled: bool) -> None:
    for shot, run in list(_runs.items()):
        if run.is_of(scene):
            _ended[shot] = is_cancelled


@persistent
def _on_load(*_: object) -> None:
    """Handler: another file was loaded, so renders of the previous file are over."""
    for shot, run in list(_runs.items()):
        if session.scene_of(run.scene_uid) is None:
            _ended[shot] = True
            finish(shot)


_HANDLERS = (
    ("render_complete", _on_complete), ("render_cancel", _on_cancel),
    ("load_post", _on_load), ("save_post", render_settings.on_saved), ("save_post_fail", render_settings.on_saved),
)  # fmt: skip


def register() -> None:
    """Registers the handlers for renders, loading and saving."""
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).append(handler)


def unregister() -> None:
    """Undoes `register`."""
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).remove(handler)
