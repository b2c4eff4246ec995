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
from ..bake import insertion, rendering
from ..footage import plate
from ..freeze import live, viewport
from ..scene import sequences
from ..shot import chosen, contents, made, markers
from ..shot.shot_state import ShotState
from ..train import pictures
from ..translations import tr
from . import backend, jobs, steps

TICK_SECONDS = 0.25
BUDGET_SECONDS = 0.01
SAMPLING_SECONDS = 0.02
"""Of a turn, spent on reading a camera; one frame of a heavy scene may take longer."""
_LOOK_SECONDS = 1.0
"""How often the shot folder is looked at for changes."""


@dataclass
class Sampling:
    """A camera being read, a few frames per turn of the timer."""

    scene: str
    """Name of the scene."""
    turns: Generator[int, None, contract.CameraPath]
    """`cameras.sample_path`."""
    total: int
    """Frames in all."""
    step: str
    """Step that asks for the take: freeze or bake."""
    done: int = 0
    """Frames read."""


@dataclass
class Watch:
    """What is known of one shot folder."""

    shot: Path
    """Shot folder."""
    jobs: dict[str, jobs.Job] = field(default_factory=dict)
    """Newest job of each step, by the step's name."""
    state: ShotState | None = None
    """What the folder holds."""
    stamp: tuple[float, ...] = ()
    """Of the folder when `state` was read."""
    looked: float = 0.0
    """When the folder was last looked at, monotonic seconds."""
    notes: dict[str, list[str]] = field(default_factory=dict)
    """What a finished step changed in the scene, or why it could not, by the step's name."""
    failures: dict[str, tuple[str, str]] = field(default_factory=dict)
    """(sentence, hint) of what failed on Blender's side, by the step's name."""
    rendered: tuple[int, int] | None = None
    """(frames done, frames in all) of a render that runs."""
    ahead: tuple[Iterator[None], str, str] | None = None
    """What Blender still has to read, a picture a turn, before a take comes into the compositor; the take's name; the
    only scene's name, or empty for all that work on the shot."""
    to_render: str = ""
    """Name of the scene whose render begins with the next turn."""
    sampling: Sampling | None = None
    """An artist's camera that is being read, before its take is asked for."""
    pending: dict[str, jobs.Job] = field(default_factory=dict)
    """Jobs that ended well while another shot of the scene was chosen, by the step's name: they wait for this one."""
    redraw: bool = False
    """Something changed outside the timer: draw at its next turn."""

    def running(self) -> str | None:
        """Name of the step at work, if any."""
        if self.rendered is not None or self.ahead is not None or self.to_render:
            return "bake"
        if self.sampling is not None:
            return self.sampling.step
        return next((step for step, job in self.jobs.items() if not job.ended), None)


_watches: dict[Path, Watch] = {}
_layout = (False, False)
"""Whether the empty panel of `lay_out` stands, and whether it is to be turned about."""
_backend: tuple[contract.JobError | None, float] = (None, 0.0)
"""Why there is no backend, and when that was looked up, monotonic seconds."""


def watch_of(shot: Path) -> Watch:
    """What is known of a shot; its jobs are found again the first time it is asked for."""
    watch = _watches.get(shot)
    if watch is None:
        watch = _watches[shot] = Watch(shot)
        with contextlib.suppress(OSError):  # a path that can be none: `refresh` says so
            watch.jobs = {steps.step_of(job): job for job in jobs.latest(shot).values()}
    if watch.state is None:
        refresh(watch)
    return watch


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
    watch.notes.clear()  # what earlier steps said has been read
    watch.failures.pop(step, None)
    if step == "train":
        pictures.forget()


def sample(scene: Any, shot: Path, turns: Generator[int, None, contract.CameraPath], step: str = "freeze") -> None:
    """Has a camera read by the timer; then its take is begun, by the step freeze or bake."""
    watch = watch_of(shot)
    watch.notes.clear()
    watch.failures.pop(step, None)
    watch.sampling = Sampling(scene.name, turns, len(rendering.frames_of(scene)), step)


def _read_on(watch: Watch) -> None:
    """Reads a camera on for part of a turn; begins its take when all of it is read."""
    sampling, until = watch.sampling, time.monotonic() + SAMPLING_SECONDS
    if sampling is None:
        return
    try:
        while time.monotonic() < until:
            sampling.done = next(sampling.turns)
        return
    except StopIteration as end:
        scene = bpy.data.scenes.get(sampling.scene)
        try:
            if scene is not None and chosen.shot_folder(scene) != watch.shot:
                watch.failures[sampling.step] = (
                    "Another shot was chosen while the camera was read.",
                    "Choose this one and freeze again.",
                )
            elif scene is not None:
                step = sampling.step
                follow(step, steps.begin(scene, step, steps.freeze_from(scene, end.value, step)))
        except (contract.JobError, OSError) as error:
            watch.failures[sampling.step] = (getattr(error, "message", str(error)), getattr(error, "hint", ""))
    except (contract.JobError, KeyError) as error:
        watch.failures[sampling.step] = (getattr(error, "message", str(error)), getattr(error, "hint", ""))
    watch.sampling = None


def refresh(watch: Watch) -> bool:
    """Reads the shot folder again if something in it changed. True if it did."""
    watch.looked = time.monotonic()
    try:
        stamp = contents.stamp(watch.shot)
        if stamp == watch.stamp and watch.state is not None:
            return False
        watch.stamp = stamp
        watch.state = contents.read(watch.shot)
    except (OSError, ValueError, KeyError) as error:
        watch.state = ShotState(watch.shot)
        why = getattr(error, "strerror", None) or error
        watch.failures["footage"] = (f"The shot folder {watch.shot} cannot be read: {why}", "Choose another one.")
    return True


def tick() -> float:
    """One turn of the timer: reads what jobs wrote, applies those that ended, redraws what shows them."""
    until = time.monotonic() + BUDGET_SECONDS
    changed = False
    for watch in list(_watches.values()):
        try:
            changed |= _turn(watch, until)
        except Exception as error:  # whatever it is: an exception would end the timer, and with it every shot's panel
            step, told = watch.running() or "footage", f"{type(error).__name__}: {error}"
            if watch.failures.get(step, ("",))[0] != told:  # once, not at every turn
                traceback.print_exc()
            watch.failures[step] = (told, "The console has the details.")
            changed = True
    if changed:
        redraw()
    waits = any(w.sampling is not None or w.ahead is not None or w.to_render for w in _watches.values())
    return 2 * SAMPLING_SECONDS if waits else TICK_SECONDS


def _turn(watch: Watch, until: float) -> bool:
    """One shot's part of a tick, `until` a time of `time.monotonic`; True if its panel should be drawn again."""
    changed, watch.redraw = watch.redraw or watch.sampling is not None, False
    for scene in chosen.scenes_of(watch.shot):
        changed |= markers.follow(scene)
        made.tidy(scene)
        chosen.see(scene, watch.state)
    if watch.to_render:
        _render(watch)
        return True
    if watch.ahead is not None:
        _read_ahead(watch, *watch.ahead)
        return True
    _read_on(watch)
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
        if job.ended:
            steps.give_up(job)
            refresh(watch)
            there = chosen.scenes_of(watch.shot)
            if there and step == "bake" and job.state == "done":
                bring_in(there[0], watch.shot, str(job.params["take"]), alone=False)
            elif there or job.state != "done":
                _apply(watch, step, job)
            else:
                watch.pending[step] = job
    if watch.pending and chosen.scenes_of(watch.shot):
        for step, job in watch.pending.items():
            _apply_late(watch, step, job)
        watch.pending.clear()
        changed = True
    if time.monotonic() - watch.looked > _LOOK_SECONDS and time.monotonic() < until:
        if watch.running() is None and not chosen.scenes_with(watch.shot):
            del _watches[watch.shot]  # a path that was typed and left again
            return changed
        changed |= refresh(watch)
    return changed


def _told(job: jobs.Job) -> tuple[Any, ...]:
    """What the panel shows of a job."""
    status = job.status
    shown = (status.state, status.stage, round(status.fraction, 2), status.message) if status is not None else ()
    return (shown, len(job.warnings), len(job.history), *job.images.values())


def lay_out() -> bool:
    """Whether an empty panel stands in the sidebar: turned about once after each `redraw`.

    Blender moves panels that grew to their places step by step, by events that a sidebar gets while the mouse is over
    it: until then they lie on top of each other. When a panel comes or goes it puts all in their places at once.
    """
    global _layout
    stands, stale = _layout
    _layout = (stands != stale, False)
    return _layout[0]


def redraw() -> None:
    """Draws the sidebar of every 3D view again; the view itself, which may be a heavy scene, is left alone."""
    global _layout
    _layout = (_layout[0], True)
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            for region in area.regions if area.type == "VIEW_3D" else ():
                if region.type == "UI":
                    region.tag_redraw()


def look_through_camera(window: Any, camera: Any = None) -> None:
    """Turns the window's first 3D view to the scene's camera, where the plate is; or to another one, which the view
    alone takes, until it is turned again."""
    for area in window.screen.areas:
        if area.type == "VIEW_3D":
            space = area.spaces.active
            if camera is not None:
                space.use_local_camera, space.camera = True, camera
            elif space.use_local_camera and (space.camera is None or plate.is_one(space.camera)):  # or it is gone
                space.use_local_camera = False
            space.region_3d.view_perspective = "CAMERA"
            return


def undo_step(step: str) -> None:
    """Ends an undo step, named after a step of ours, for a change of the scene that no operator's own undo covers."""
    if not bpy.app.background:
        bpy.ops.ed.undo_push(message=tr(f"Splannequin {steps.STEPS[step].label}"))


def _apply(watch: Watch, step: str, job: jobs.Job) -> None:
    """Lets a job that ended well change the scenes that work on its shot."""
    if job.state == "done":
        _change(watch, step, lambda scene: steps.finish(scene, step, job))


def _window_of(scene: Any) -> Any | None:
    return next((w for w in bpy.context.window_manager.windows if w.scene == scene), None)


def _change(watch: Watch, step: str, change: Callable[[Any], list[str]], only: str = "") -> None:
    """Changes the scenes that work on a shot, or the one of them that is named `only`: as one undo step each in a
    window. Notes what was changed or why not."""
    for scene in [s for s in chosen.scenes_of(watch.shot) if only in ("", s.name)]:
        window = _window_of(scene)
        try:
            if window is None:
                watch.notes[step] = change(scene)
                continue
            with bpy.context.temp_override(window=window, scene=scene):
                before = scene.splannequin.t_star
                watch.notes[step] = change(scene)
                camera = plate.find(scene, watch.shot) if step == "footage" else None
                if step == "camera" or camera is not None:
                    look_through_camera(window, camera)
                if watch.notes[step] or before != scene.splannequin.t_star:
                    undo_step(step)
        except (contract.JobError, OSError, ValueError, KeyError, RuntimeError) as error:
            watch.failures[step] = (getattr(error, "message", str(error)), getattr(error, "hint", ""))


def bring_in(scene: Any, shot: Path, take: str, alone: bool = True) -> None:
    """Has a take put into the compositor and rendered by the timer, in turns: Blender stands still in each.

    Args:
        scene: the scene; with `alone` no other one that works on the shot is changed.
        shot: shot folder.
        take: name of a take.
        alone: see `scene`.
    """
    watch, only = watch_of(shot), scene.name if alone else ""
    watch.notes.pop("bake", None)
    watch.failures.pop("bake", None)
    try:
        watch.ahead = insertion.read_ahead(scene, shot, take), take, only
    except (contract.JobError, OSError):
        watch.ahead = iter(()), take, only  # inserting it fails alike, and says so


def _read_ahead(watch: Watch, turns: Iterator[None], take: str, only: str) -> None:
    """Has one more picture read; after the last the take comes into the compositor."""
    try:
        next(turns)
        return
    except (StopIteration, OSError, RuntimeError, ValueError):
        watch.ahead = None
    _change(watch, "bake", lambda scene: _put_in(watch, scene, take), only)


def _put_in(watch: Watch, scene: Any, take: str) -> list[str]:
    """Puts a take into a scene's compositor; the render of a scene that is seen begins with the next turn."""
    changes = steps.insert_freeze(scene, watch.shot, take)
    if _window_of(scene) is not None:
        changes += rendering.choose_output(scene, watch.shot, take)  # here, for it belongs to the same undo step
        watch.to_render = scene.name
    return changes


def _render(watch: Watch) -> None:
    """Starts the render of a bake: a turn after the compositor was changed, since Blender takes its time for both."""
    name, watch.to_render = watch.to_render, ""
    window = _window_of(bpy.data.scenes.get(name))
    if window is None:
        return
    try:
        with bpy.context.temp_override(window=window, scene=window.scene):
            bpy.ops.splannequin.render("INVOKE_DEFAULT")
    except RuntimeError as error:
        watch.failures["bake"] = (str(error).strip(), "")


def _apply_late(watch: Watch, step: str, job: jobs.Job) -> None:
    """`_apply` for a job that had ended before its shot was chosen. Choosing a shot starts no render, and leaves the
    other's take in the compositor."""
    if step == "bake":
        watch.notes[step] = ["Its frames were rendered meanwhile. Bake again to put them into your compositor."]
    else:
        _apply(watch, step, job)


@persistent
def _on_load(*_: Any) -> None:
    """Another file: its shots are looked at afresh; running jobs go on and are found again."""
    viewport.end()
    markers.forget()
    sequences.forget_ahead()
    for scene in bpy.data.scenes:
        folder = chosen.shot_folder(scene)
        if folder is not None:
            made.adopt(scene, folder)
    for shot in [s for s, w in _watches.items() if w.running() is None]:
        del _watches[shot]
    redraw()
    for watch in _watches.values():
        watch.rendered = watch.sampling = watch.ahead = None
        watch.to_render = ""
        watch.pending.clear()


def render_began(shot: Path, frames: int) -> None:
    """A render of a baked shot begins."""
    watch_of(shot).rendered = (0, frames)


@persistent
def _on_frame(*_: Any) -> None:
    for watch in list(_watches.values()):
        if watch.rendered is not None:
            watch.rendered = (watch.rendered[0] + 1, watch.rendered[1])
            watch.redraw = True


@persistent
def _on_render_end(*_: Any) -> None:
    for watch in list(_watches.values()):
        if watch.rendered is not None:
            done, total = watch.rendered
            watch.rendered = None
            watch.redraw = True
            watch.notes.setdefault("bake", []).append(f"{done} of {total} frames rendered.")


def forget() -> None:
    """Drops all that is known; the shots' folders tell it again when asked."""
    _watches.clear()


def register() -> None:
    """Starts the timer (in a window: headless Blender has none) and listens to file loads and renders."""
    bpy.app.handlers.load_post.append(_on_load)
    bpy.app.handlers.render_write.append(_on_frame)
    bpy.app.handlers.render_complete.append(_on_render_end)
    bpy.app.handlers.render_cancel.append(_on_render_end)
    if not bpy.app.background:
        bpy.app.timers.register(tick, first_interval=TICK_SECONDS, persistent=True)
        live.import_beside("zipfile")  # numpy does to open a solve's points: 0.2 s from a cold disk


def unregister() -> None:
    """Undoes `register`. Running jobs go on."""
    viewport.end()
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)
    bpy.app.handlers.render_cancel.remove(_on_render_end)
    bpy.app.handlers.render_complete.remove(_on_render_end)
    bpy.app.handlers.render_write.remove(_on_frame)
    bpy.app.handlers.load_post.remove(_on_load)
    forget()
