"""Monitors running jobs from one persistent timer, and stores what the panel shows.

A budget limits how long a tick reads events. A slice of work, a callback or a change of the scene limits itself.
Jobs outlive undo, file load and Blender itself. This module therefore keeps no bpy data, only shot folders and job
folders. The jobs of an opened shot are found in its folder.
"""

from __future__ import annotations

import contextlib
import time
import traceback
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import bpy
from bpy.app.handlers import persistent

from ...torch_backend import contract
from ..access import settings_of
from ..scene import sequences
from ..shot import inventory, markers, scene_objects, selection
from ..shot.shot_state import ShotState
from ..translations import tr
from . import children, jobs, steps

TICK_SECONDS = 0.25
BUDGET_SECONDS = 0.01  # for reading events: a timer callback blocks Blender's window
WORKING_SECONDS = 0.04
"""Interval in seconds between slices of work done in Blender."""
# Interval in seconds between checks of the shot folder for changes.
_LOOK_SECONDS = 1.0


@dataclass(frozen=True)
class Progress:
    """Progress of work done in Blender."""

    text: str
    """Short description of the work, with numbers."""
    done: int
    """Units done, out of `total`."""
    total: int
    hint: str = ""
    """Sentence that explains how to stop the work; may be empty."""


@dataclass
class Work:
    """Work done in Blender for a step, in slices run by the timer."""

    step: str
    """Name of the step."""
    turns: Iterator[Progress | None] | None = None
    """Iterator that does one slice of the work per item; None if Blender continues on its own."""
    progress: Progress | None = None
    """Latest progress, or None before the first report."""


@dataclass
class Watch:
    """Known state of one shot folder."""

    shot: Path
    """Shot folder."""
    jobs: dict[str, jobs.Job] = field(default_factory=dict[str, jobs.Job])
    """Name of a step -> its newest job."""
    state: ShotState | None = None
    """Content of the folder."""
    stamp: tuple[float, ...] = ()
    """Stamp of the folder when `state` was read."""
    looked: float = 0.0
    """Time of the last check of the folder, monotonic seconds."""
    notes: dict[str, list[str]] = field(default_factory=dict[str, list[str]])
    """Name of a step -> sentences about its changes to the scene, or why there are none."""
    failures: dict[str, tuple[str, str]] = field(default_factory=dict[str, tuple[str, str]])
    """Name of a step -> (sentence, hint) about its failure on Blender's side."""
    work: Work | None = None
    """Work that Blender is doing for the shot."""
    pending: dict[str, jobs.Job] = field(default_factory=dict[str, Any])  # `jobs` is the field here, not the module
    """Name of a step -> job that succeeded while no scene had this shot selected. It is applied once the shot is
    selected."""
    unread: tuple[str, str] | None = None
    """(sentence, hint) about a failure to read the folder, which is tried again; otherwise None."""
    just_ended: str = ""
    """Name of the step that ended last in this session, until another step begins."""
    redraw: bool = False
    """True if something changed outside the timer, so that its next tick must redraw."""

    def running(self) -> str | None:
        """Name of the running step, or None."""
        if self.work is not None:
            return self.work.step
        return next((step for step, job in self.jobs.items() if not job.ended), None)

    def failed(self) -> str | None:
        """Name of the step that started last, if it failed."""
        last = self.just_ended or max(self.jobs, key=lambda step: self.jobs[step].folder.name, default="")
        job = self.jobs.get(last)
        return last if last in self.failures or (job is not None and job.state == "failed") else None

    def fail(self, step: str, error: BaseException) -> None:
        """Stores the reason why a step failed."""
        self.just_ended = step
        self.failures[step] = (getattr(error, "message", str(error)), getattr(error, "hint", ""))


_watches: dict[Path, Watch] = {}
# Callbacks that the timer calls each time it examines jobs, until they return False.
_callbacks: list[Callable[[], bool]] = []
# Callbacks that are called more often than jobs are examined.
_pulses: list[Callable[[], float | None]] = []
# Time of the next check of jobs while there are pulses, monotonic seconds.
_jobs_next = 0.0


def watch_of(shot: Path) -> Watch:
    """The state of a shot. The first call finds the shot's existing jobs."""
    watch = _watches.get(shot)
    if watch is None:
        watch = _watches[shot] = Watch(shot)
        with contextlib.suppress(OSError):  # an invalid path, which `refresh` reports
            # A step with several kinds of jobs shows the newest one.
            found = sorted(jobs.latest(shot).values(), key=lambda job: job.folder.name)
            watch.jobs = {steps.step_of(job): job for job in found}
        for job in watch.jobs.values():
            job.blend = steps.blend_of(job)
    if watch.state is None:
        refresh(watch)
    return watch


def watches() -> list[Watch]:
    """States of all known shots."""
    return list(_watches.values())


def follow(step: str, job: jobs.Job) -> None:
    """Starts to watch a new job."""
    watch = watch_of(job.shot)
    watch.jobs[step] = job
    watch.just_ended = ""
    watch.notes.clear()  # the artist has read the notes of earlier steps
    watch.failures.pop(step, None)
    steps.STEPS[step].began(job)


def work(shot: Path, step: str, turns: Iterator[Progress | None]) -> None:
    """Makes the timer do work for a step, one slice per tick. An exception from the work is the step's failure.

    The work must keep no bpy data between slices.
    """
    watch = watch_of(shot)
    watch.just_ended = ""
    watch.notes.pop(step, None)
    watch.failures.pop(step, None)
    watch.work = Work(step, turns)


def stop_work(watch: Watch) -> bool:
    """Stops a shot's task that the timer runs in slices; the task undoes its changes. False if there is none."""
    turns = watch.work.turns if watch.work is not None else None
    if turns is None:
        return False
    watch.work = None
    if isinstance(turns, Generator):
        turns.close()
    sequences.clear_prefetched()  # images loaded ahead may be outdated when they are needed
    return True


def _work_on(watch: Watch, doing: Work) -> None:
    """Does one slice of Blender's work for a step."""
    try:
        doing.progress = next(doing.turns or iter(()))
        return
    except StopIteration:
        pass
    except (contract.JobError, OSError, ValueError, KeyError, RuntimeError) as error:
        watch.fail(doing.step, error)
    if watch.work is doing:  # the last slice may have started other work
        watch.work = None
        watch.just_ended = doing.step


def call_until_false(turn: Callable[[], bool]) -> None:
    """Makes the timer call `turn` at each check of jobs until it returns False."""
    _callbacks.append(turn)


def when_answered(question: children.Question, then: Callable[[], None]) -> None:
    """Calls `then` from the timer once a backend question has ended."""

    def look() -> bool:
        if question.ended:
            then()
            redraw()
            return False
        return True

    call_until_false(look)


def refresh(watch: Watch) -> bool:
    """Reads the shot folder again if it changed. True if the panel must be redrawn."""
    watch.looked, first = time.monotonic(), next(iter(steps.STEPS))
    try:
        stamp = inventory.stamp(watch.shot)
        if stamp == watch.stamp and watch.state is not None:
            return False
        watch.stamp = stamp
        watch.state = inventory.read(watch.shot)
        selection.clear_cache()
    except (OSError, ValueError, KeyError) as error:
        # Try again later: a network disk may return, or a file was being replaced on Windows.
        watch.state, watch.stamp = ShotState(watch.shot), ()
        why = getattr(error, "strerror", None) or error
        known = watch.unread
        watch.unread = f"The shot folder {watch.shot} cannot be read: {why}", "Choose another one."
        watch.failures[first] = watch.unread
        return watch.unread != known
    if watch.unread is not None and watch.failures.get(first) == watch.unread:
        del watch.failures[first]
    watch.unread = None
    return True


def pulse(turn: Callable[[], float | None]) -> None:
    """Calls `turn` from the timer after the delay in seconds that it returns, until it returns None or is dropped.

    For anything drawn while it changes. Jobs are still examined every 0.25 s.
    """
    drop(turn)
    _pulses.append(turn)
    # The next tick may be too late for an image. Inside `tick`, Blender drops the running timer when it returns.
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)
        bpy.app.timers.register(tick, first_interval=0.0, persistent=True)


def drop(turn: Callable[[], float | None]) -> None:
    """Stops calling `turn`."""
    if turn in _pulses:
        _pulses.remove(turn)


def tick() -> float:
    """Timer callback: runs pulses and, if due, the check of jobs. Returns the seconds until the next tick."""
    global _jobs_next
    soonest = _pulse()
    if soonest is None:
        return _follow_jobs()
    if time.monotonic() >= _jobs_next:
        _jobs_next = time.monotonic() + _follow_jobs()
    return min(soonest, max(0.0, _jobs_next - time.monotonic()))


def _pulse() -> float | None:
    """Calls all pulses. Returns their smallest delay in seconds, or None without pulses."""
    delays: list[float] = []
    for turn in list(_pulses):
        try:
            seconds = turn()
        except Exception:  # as in `_follow_jobs`
            traceback.print_exc()
            seconds = None
        if seconds is None:
            drop(turn)
        else:
            delays.append(seconds)
    return min(delays, default=None)


def _follow_jobs() -> float:
    """Reads the output of jobs, applies finished jobs and redraws panels. Returns the seconds until the next check."""
    until = time.monotonic() + BUDGET_SECONDS
    changed = False
    for watch in list(_watches.values()):
        try:
            changed |= _turn(watch, until)
        except Exception as error:  # an exception would end the timer, and so the updates of every panel
            step, message = watch.running() or next(iter(steps.STEPS)), f"{type(error).__name__}: {error}"
            if watch.failures.get(step, ("",))[0] != message:  # print it once, not at every tick
                traceback.print_exc()
            watch.failures[step] = (message, "See the console for details.")
            changed = True
    if _watches:  # the next check begins with another shot, because one job may use up the whole budget
        shot = next(iter(_watches))
        _watches[shot] = _watches.pop(shot)
    for turn in list(_callbacks):
        try:
            goes_on = turn()
        except Exception:  # as above
            traceback.print_exc()
            goes_on = False
        if not goes_on:
            _callbacks.remove(turn)
    if changed:
        redraw()
    works = any(w.work is not None and w.work.turns is not None for w in _watches.values())
    return WORKING_SECONDS if works else TICK_SECONDS


def _turn(watch: Watch, until: float) -> bool:
    """One shot's part of a check, until the `time.monotonic` value `until`. True if its panel must be redrawn."""
    changed, watch.redraw = watch.redraw, False
    for scene in selection.scenes_of(watch.shot):
        changed |= markers.follow(scene)
        scene_objects.tidy(scene)
        selection.see(scene, watch.state)
    if watch.work is not None and watch.work.turns is not None:
        _work_on(watch, watch.work)
        return True
    for step, job in list(watch.jobs.items()):
        if job.ended or time.monotonic() > until:
            continue
        try:
            before = _shown_state(job)
            jobs.poll(job, max(until - time.monotonic(), 0.001))
            changed |= before != _shown_state(job)
        except (OSError, ValueError, KeyError) as error:
            watch.failures[step] = (f"The job in {job.folder} cannot be read: {error}", "")
            del watch.jobs[step]
            continue
        if job.ended and not job.over:
            _ended(watch, step, job)
        elif not job.applied and steps.STEPS[step].is_usable(job) and selection.scenes_of(watch.shot):
            refresh(watch)
            _apply(watch, step, job)
            job.applied = step not in watch.failures  # otherwise it is tried again when the job ends
            changed = True
    if watch.pending and selection.scenes_of(watch.shot):
        for step, job in watch.pending.items():
            _apply_late(watch, step, job)
        watch.pending.clear()
        changed = True
    if time.monotonic() - watch.looked > _LOOK_SECONDS and time.monotonic() < until:
        if watch.running() is None and not selection.scenes_with(watch.shot):
            del _watches[watch.shot]  # a path that was typed and then changed
            return changed
        changed |= refresh(watch)
    return changed


def _ended(watch: Watch, step: str, job: jobs.Job) -> None:
    """Applies a job that just ended: at once, in steps, or when its shot is selected."""
    steps.STEPS[step].ended(job)
    watch.just_ended = step
    refresh(watch)
    scenes = selection.scenes_of(watch.shot)
    if job.state != "done" or job.applied:
        return
    if not scenes:
        watch.pending[step] = job
    elif not steps.STEPS[step].arrive(scenes[0], job):
        _apply(watch, step, job)


def _shown_state(job: jobs.Job) -> tuple[Any, ...]:
    """The state of a job that the panel shows."""
    status = job.status
    shown = (status.state, status.stage, round(status.fraction, 2), status.message) if status is not None else ()
    return (shown, len(job.warnings), len(job.history), *job.images.values())


def redraw(regions: tuple[str, ...] = ("UI",), editor: str = "VIEW_3D") -> None:
    """Redraws these regions of every editor of a type. By default the sidebars, as a view may show a heavy scene."""
    manager: Any = bpy.context.window_manager  # None while Blender quits
    for window in manager.windows if manager else ():
        for area in window.screen.areas:
            for region in area.regions if area.type == editor else ():
                if region.type in regions:
                    region.tag_redraw()


def look_through_camera(window: bpy.types.Window, camera: bpy.types.Object | None = None) -> None:
    """Shows the scene's camera, with the plate, in the window's first 3D view.

    Another `camera` is set as the view's local camera. It stays until the next call without one.
    """
    for area in window.screen.areas:
        if area.type == "VIEW_3D":
            space: Any = area.spaces.active
            if camera is not None:
                space.use_local_camera, space.camera = True, camera
            # The local camera is None if the artist has deleted it.
            elif space.use_local_camera and (space.camera is None or scene_objects.is_plate(space.camera)):
                space.use_local_camera = False
            space.region_3d.view_perspective = "CAMERA"
            return


def undo_step(step: str, wait: bool = True) -> None:
    """Adds an undo step named after a step, for a change of the scene that no operator's undo covers.

    With `wait`, it is added once no modal operator runs; otherwise at once.
    """
    message = tr(f"Splannequin {steps.STEPS[step].label}")

    def push() -> bool:
        # The timer also runs during a transform or a paint stroke, whose unfinished state the step would store.
        if wait and any(window.modal_operators for window in bpy.context.window_manager.windows):
            return True
        # In Edit and Sculpt Mode, undo takes back the change and keeps the mode (Blender 4.2 and 5.2).
        bpy.ops.ed.undo_push(message=message)
        return False

    if not bpy.app.background and push():
        call_until_false(push)


def _apply(watch: Watch, step: str, job: jobs.Job) -> None:
    """Applies a successful job to the scenes that use its shot."""
    change(watch, step, lambda scene: steps.STEPS[step].finish(scene, job))


def window_of(scene: bpy.types.Scene) -> bpy.types.Window | None:
    """The window that shows a scene, or None."""
    return next((w for w in bpy.context.window_manager.windows if w.scene == scene), None)


def change(watch: Watch, step: str, how: Callable[[bpy.types.Scene], list[str]], only: int = 0) -> None:
    """Changes all scenes that use a shot, or only the one with the `session_uid` `only`.

    Each change in a window is one undo step. Stores sentences about the changes, or the error.
    """
    for scene in [s for s in selection.scenes_of(watch.shot) if only in (0, s.session_uid)]:
        window = window_of(scene)
        try:
            if window is None:
                watch.notes[step] = how(scene)
                continue
            # In a timer, Blender's context has no window.
            with bpy.context.temp_override(window=window, scene=scene):  # pyright: ignore[reportUnknownMemberType]
                before = settings_of(scene).t_star
                watch.notes[step] = how(scene)
                steps.STEPS[step].look(window, scene, watch.shot)
                if watch.notes[step] or before != settings_of(scene).t_star:
                    undo_step(step)
        except (contract.JobError, OSError, ValueError, KeyError, RuntimeError) as error:
            watch.fail(step, error)


def _apply_late(watch: Watch, step: str, job: jobs.Job) -> None:
    """`_apply` for a job that ended before its shot was selected."""
    sentence = steps.STEPS[step].late(job)
    if sentence:
        watch.notes[step] = [sentence]
    else:
        _apply(watch, step, job)


@persistent
def _on_load(*_: object) -> None:
    """Handler: another file was loaded. Its shots are examined again; running jobs continue and are found again."""
    markers.forget()
    sequences.clear_prefetched()
    for shot in [s for s, w in _watches.items() if w.running() is None]:
        del _watches[shot]
    for watch in _watches.values():
        stop_work(watch)
        watch.work = None  # also work that Blender continued on its own
        watch.pending.clear()
    redraw()


def forget() -> None:
    """Clears all stored state. It is read again from the shots' folders when needed."""
    _watches.clear()
    _callbacks.clear()
    _pulses.clear()


@persistent
def _on_undo(*_: object) -> None:
    """Handler: clears the notes about scene changes, which undo may have reverted."""
    for watch in _watches.values():
        watch.notes.clear()


def register() -> None:
    """Starts the timer, except in background mode, and registers the handlers for load and undo."""
    bpy.app.handlers.load_post.append(_on_load)
    for handlers in (bpy.app.handlers.undo_post, bpy.app.handlers.redo_post):
        handlers.append(_on_undo)
    if not bpy.app.background:
        # Without `persistent`, Blender drops the timer when another file is loaded.
        bpy.app.timers.register(tick, first_interval=TICK_SECONDS, persistent=True)


def unregister() -> None:
    """Undoes `register`. Running jobs continue."""
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)
    bpy.app.handlers.load_post.remove(_on_load)
    for handlers in (bpy.app.handlers.undo_post, bpy.app.handlers.redo_post):
        handlers.remove(_on_undo)
    forget()
