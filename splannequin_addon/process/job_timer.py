"""Follows running jobs from one persistent timer, within a time budget per tick, and keeps what the panel shows.

Jobs outlive undo, file load and Blender itself: nothing of bpy is kept here, only shot folders and job folders, and
the jobs of a shot that is opened are found again in its folder.
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
from . import backend, children, jobs, steps

TICK_SECONDS = 0.25
BUDGET_SECONDS = 0.01
WORKING_SECONDS = 0.04
"""Between two turns of work that Blender does itself."""
_LOOK_SECONDS = 1.0
"""How often the shot folder is examined for changes."""


@dataclass(frozen=True)
class Progress:
    """How far work is that Blender does itself."""

    text: str
    """What is done, a few words with the figures."""
    done: int
    """Of `total`."""
    total: int
    hint: str = ""
    """How it is stopped, a sentence."""


@dataclass
class Work:
    """Work that Blender itself does for a step, in slices of the timer."""

    step: str
    """Name of the step."""
    turns: Iterator[Progress | None] | None = None
    """It is done a turn of the timer at a time, by asking for the next; None if Blender goes on by itself."""
    progress: Progress | None = None
    """How far it is, once it tells."""


@dataclass
class Watch:
    """What is known of one shot folder."""

    shot: Path
    """Shot folder."""
    jobs: dict[str, jobs.Job] = field(default_factory=dict[str, jobs.Job])
    """Newest job of each step, by the step's name."""
    state: ShotState | None = None
    """What the folder holds."""
    stamp: tuple[float, ...] = ()
    """Of the folder when `state` was read."""
    looked: float = 0.0
    """When the folder was last looked at, monotonic seconds."""
    notes: dict[str, list[str]] = field(default_factory=dict[str, list[str]])
    """Step's name -> what the finished step changed in the scene, or why it could not."""
    failures: dict[str, tuple[str, str]] = field(default_factory=dict[str, tuple[str, str]])
    """(sentence, hint) of what failed on Blender's side, by the step's name."""
    work: Work | None = None
    """What Blender itself is doing for it."""
    pending: dict[str, jobs.Job] = field(default_factory=dict[str, Any])  # `jobs` is a field here
    """Jobs that ended well while another shot of the scene was chosen, by the step's name: they wait for this one."""
    unread: tuple[str, str] | None = None
    """(sentence, hint) of why the folder could not be read, which is tried again."""
    just_ended: str = ""
    """The step that ended last in this session, until another begins."""
    redraw: bool = False
    """Something changed outside the timer: draw at its next turn."""

    def running(self) -> str | None:
        """Name of the step at work, if any."""
        if self.work is not None:
            return self.work.step
        return next((step for step, job in self.jobs.items() if not job.ended), None)

    def failed(self) -> str | None:
        """Name of the step that was begun last, if it failed."""
        last = self.just_ended or max(self.jobs, key=lambda step: self.jobs[step].folder.name, default="")
        job = self.jobs.get(last)
        return last if last in self.failures or (job is not None and job.state == "failed") else None

    def fail(self, step: str, error: BaseException) -> None:
        """Notes why a step failed."""
        self.just_ended = step
        self.failures[step] = (getattr(error, "message", str(error)), getattr(error, "hint", ""))


_watches: dict[Path, Watch] = {}
_meanwhile: list[Callable[[], bool]] = []
"""Callbacks besides those of shots, called until they return that they are done."""
_pulses: list[Callable[[], float | None]] = []
"""What is called more often than jobs are examined."""
_jobs_next = 0.0
"""When jobs are examined again while something pulses, monotonic seconds."""
_backend: tuple[contract.JobError | None, float] = (None, 0.0)
"""Why there is no backend, and when that was looked up, monotonic seconds."""


def watch_of(shot: Path) -> Watch:
    """What is known of a shot; its jobs are found again the first time it is requested."""
    watch = _watches.get(shot)
    if watch is None:
        watch = _watches[shot] = Watch(shot)
        with contextlib.suppress(OSError):  # a path that can be none: `refresh` says so
            # A step that starts jobs of several kinds shows the newest of them.
            found = sorted(jobs.latest(shot).values(), key=lambda job: job.folder.name)
            watch.jobs = {steps.step_of(job): job for job in found}
        for job in watch.jobs.values():
            job.blend = steps.blend_of(job)
    if watch.state is None:
        refresh(watch)
    return watch


def watches() -> list[Watch]:
    """All shots that are watched."""
    return list(_watches.values())


def backend_trouble() -> contract.JobError | None:
    """Why there is no Python for the backend, None if there is; looked up every few seconds, as drawing asks all the
    time."""
    global _backend
    if not _backend[1] or time.monotonic() - _backend[1] > 5 * _LOOK_SECONDS:
        _backend = (backend.trouble(), time.monotonic())
    return _backend[0]


def follow(step: str, job: jobs.Job) -> None:
    """Watches a job that was just started."""
    watch = watch_of(job.shot)
    watch.jobs[step] = job
    watch.just_ended = ""
    watch.notes.clear()  # what earlier steps said has been read
    watch.failures.pop(step, None)
    steps.STEPS[step].began(job)


def work(shot: Path, step: str, turns: Iterator[Progress | None]) -> None:
    """Has the timer do work for a step, a turn at a time; what it raises is the step's failure.

    Nothing of bpy may be kept between two turns.
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
    sequences.forget_ahead()  # pictures read ahead for it may have changed when they are needed
    return True


def _work_on(watch: Watch, doing: Work) -> None:
    """One more turn of what Blender itself does."""
    try:
        doing.progress = next(doing.turns or iter(()))
        return
    except StopIteration:
        pass
    except (contract.JobError, OSError, ValueError, KeyError, RuntimeError) as error:
        watch.fail(doing.step, error)
    if watch.work is doing:  # its last turn may have begun something else
        watch.work = None
        watch.just_ended = doing.step


def meanwhile(turn: Callable[[], bool]) -> None:
    """Has the timer call `turn` at each of its turns, until it returns False."""
    _meanwhile.append(turn)


def when_answered(question: children.Question, then: Callable[[], None]) -> None:
    """Calls `then` from the timer once a backend that was asked something has ended."""

    def look() -> bool:
        if question.ended:
            then()
            redraw()
            return False
        return True

    meanwhile(look)


def refresh(watch: Watch) -> bool:
    """Reads the shot folder again if something in it changed. True if it did."""
    watch.looked, first = time.monotonic(), next(iter(steps.STEPS))
    try:
        stamp = inventory.stamp(watch.shot)
        if stamp == watch.stamp and watch.state is not None:
            return False
        watch.stamp = stamp
        watch.state = inventory.read(watch.shot)
        selection.look_again()
    except (OSError, ValueError, KeyError) as error:
        # Not for good: a network disk that was away for a moment, or a file that was being replaced on Windows, comes
        # back as it was.
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
    """Calls `turn` from the timer, as soon again as it says (seconds), until it says None or is dropped.

    For what is drawn while it changes; jobs are still looked at as often as without.
    """
    drop(turn)
    _pulses.append(turn)
    if bpy.app.timers.is_registered(tick):  # its next turn may be far for a picture
        bpy.app.timers.unregister(tick)
        bpy.app.timers.register(tick, first_interval=0.0, persistent=True)


def drop(turn: Callable[[], float | None]) -> None:
    """Calls it no longer."""
    if turn in _pulses:
        _pulses.remove(turn)


def tick() -> float:
    """One turn of the timer, that of jobs or of what pulses faster; returns the seconds until the next."""
    global _jobs_next
    soonest = _pulse()
    if soonest is None:
        return _follow_jobs()
    if time.monotonic() >= _jobs_next:
        _jobs_next = time.monotonic() + _follow_jobs()
    return min(soonest, max(0.0, _jobs_next - time.monotonic()))


def _pulse() -> float | None:
    """Calls what pulses; the least seconds that any of it asks for, None if nothing does."""
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
    """Reads what jobs wrote, applies those that ended, redraws what shows them; returns when to do so again."""
    until = time.monotonic() + BUDGET_SECONDS
    changed = False
    for watch in list(_watches.values()):
        try:
            changed |= _turn(watch, until)
        except Exception as error:  # whatever it is: an exception would end the timer, and with it every shot's panel
            step, message = watch.running() or next(iter(steps.STEPS)), f"{type(error).__name__}: {error}"
            if watch.failures.get(step, ("",))[0] != message:  # once, not at every turn
                traceback.print_exc()
            watch.failures[step] = (message, "The console has the details.")
            changed = True
    for turn in list(_meanwhile):
        try:
            goes_on = turn()
        except Exception:  # as above
            traceback.print_exc()
            goes_on = False
        if not goes_on:
            _meanwhile.remove(turn)
    if changed:
        redraw()
    works = any(w.work is not None and w.work.turns is not None for w in _watches.values())
    return WORKING_SECONDS if works else TICK_SECONDS


def _turn(watch: Watch, until: float) -> bool:
    """One shot's part of a tick, `until` a time of `time.monotonic`; True if its panel should be drawn again."""
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
            before = _told(job)
            jobs.poll(job, max(until - time.monotonic(), 0.001))
            changed |= before != _told(job)
        except (OSError, ValueError, KeyError) as error:
            watch.failures[step] = (f"The job in {job.folder} cannot be read: {error}", "")
            del watch.jobs[step]
            continue
        if job.ended and not job.over:
            _ended(watch, step, job)
        elif not job.applied and steps.STEPS[step].is_usable(job) and selection.scenes_of(watch.shot):
            refresh(watch)
            _apply(watch, step, job)
            job.applied = step not in watch.failures  # else it is tried once more at the end
            changed = True
    if watch.pending and selection.scenes_of(watch.shot):
        for step, job in watch.pending.items():
            _apply_late(watch, step, job)
        watch.pending.clear()
        changed = True
    if time.monotonic() - watch.looked > _LOOK_SECONDS and time.monotonic() < until:
        if watch.running() is None and not selection.scenes_with(watch.shot):
            del _watches[watch.shot]  # a path that was typed and left again
            return changed
        changed |= refresh(watch)
    return changed


def _ended(watch: Watch, step: str, job: jobs.Job) -> None:
    """A job has ended just now: its scenes are changed, at once, in turns, or when its shot is chosen."""
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


def _told(job: jobs.Job) -> tuple[Any, ...]:
    """What the panel shows of a job."""
    status = job.status
    shown = (status.state, status.stage, round(status.fraction, 2), status.message) if status is not None else ()
    return (shown, len(job.warnings), len(job.history), *job.images.values())


def redraw() -> None:
    """Draws the sidebar of every 3D view again; the view itself, which may be a heavy scene, is left alone."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            for region in area.regions if area.type == "VIEW_3D" else ():
                if region.type == "UI":
                    region.tag_redraw()


def look_through_camera(window: bpy.types.Window, camera: bpy.types.Object | None = None) -> None:
    """Turns the window's first 3D view to the scene's camera, where the plate is; or to another one, which the view
    alone takes, until it is turned again."""
    for area in window.screen.areas:
        if area.type == "VIEW_3D":
            space: Any = area.spaces.active
            if camera is not None:
                space.use_local_camera, space.camera = True, camera
            elif space.use_local_camera and (
                space.camera is None or scene_objects.is_plate(space.camera)
            ):  # or it is gone
                space.use_local_camera = False
            space.region_3d.view_perspective = "CAMERA"
            return


def undo_step(step: str) -> None:
    """Ends an undo step, named after a step of ours, for a change of the scene that no operator's own undo covers."""
    if not bpy.app.background:
        bpy.ops.ed.undo_push(message=tr(f"Splannequin {steps.STEPS[step].label}"))


def _apply(watch: Watch, step: str, job: jobs.Job) -> None:
    """Lets a job that ended well change the scenes that work on its shot."""
    change(watch, step, lambda scene: steps.STEPS[step].finish(scene, job))


def window_of(scene: bpy.types.Scene) -> bpy.types.Window | None:
    """The window that shows a scene, if one does."""
    return next((w for w in bpy.context.window_manager.windows if w.scene == scene), None)


def change(watch: Watch, step: str, how: Callable[[bpy.types.Scene], list[str]], only: int = 0) -> None:
    """Changes the scenes that work on a shot, or the one of them whose `session_uid` is `only`: as one undo step each
    in a window. Notes what was changed or why not."""
    for scene in [s for s in selection.scenes_of(watch.shot) if only in (0, s.session_uid)]:
        window = window_of(scene)
        try:
            if window is None:
                watch.notes[step] = how(scene)
                continue
            with bpy.context.temp_override(window=window, scene=scene):  # pyright: ignore[reportUnknownMemberType]
                before = settings_of(scene).t_star
                watch.notes[step] = how(scene)
                steps.STEPS[step].look(window, scene, watch.shot)
                if watch.notes[step] or before != settings_of(scene).t_star:
                    undo_step(step)
        except (contract.JobError, OSError, ValueError, KeyError, RuntimeError) as error:
            watch.fail(step, error)


def _apply_late(watch: Watch, step: str, job: jobs.Job) -> None:
    """`_apply` for a job that had ended before its shot was chosen."""
    sentence = steps.STEPS[step].late(job)
    if sentence:
        watch.notes[step] = [sentence]
    else:
        _apply(watch, step, job)


@persistent
def _on_load(*_: object) -> None:
    """Another file: its shots are examined afresh; running jobs go on and are found again."""
    markers.forget()
    sequences.forget_ahead()
    for shot in [s for s, w in _watches.items() if w.running() is None]:
        del _watches[shot]
    redraw()
    for watch in _watches.values():
        watch.work = None
        watch.pending.clear()


def forget() -> None:
    """Drops all that is known; the shots' folders tell it again when asked."""
    _watches.clear()
    _meanwhile.clear()
    _pulses.clear()


@persistent
def _on_undo(*_: object) -> None:
    """What steps said that they changed in the scene may not be so any more."""
    for watch in _watches.values():
        watch.notes.clear()


def register() -> None:
    """Starts the timer (in a window: headless Blender has none) and listens to file loads and undo."""
    bpy.app.handlers.load_post.append(_on_load)
    for handlers in (bpy.app.handlers.undo_post, bpy.app.handlers.redo_post):
        handlers.append(_on_undo)
    if not bpy.app.background:
        bpy.app.timers.register(tick, first_interval=TICK_SECONDS, persistent=True)


def unregister() -> None:
    """Undoes `register`. Running jobs go on."""
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)
    bpy.app.handlers.load_post.remove(_on_load)
    for handlers in (bpy.app.handlers.undo_post, bpy.app.handlers.redo_post):
        handlers.remove(_on_undo)
    forget()
