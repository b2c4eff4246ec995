"""Open steps of the panel: the step to work on, and those that the artist opened.

The properties in this module store nothing: each is computed from the shot whenever the panel is drawn. A step that the
artist opens or closes keeps that state until it equals the computed one.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import bpy

from ..access import scene_holding
from ..process import backend, job_timer, steps
from ..properties import BoolProperty
from ..shot import selection

# (`session_uid` of the scene, shot folder, step) -> open state set by the artist.
_chosen: dict[tuple[int, Path | None, str], bool] = {}


def current_step(scene: bpy.types.Scene) -> str:
    """Name of the step to work on: the running or last failed step, else the first unfinished one."""
    folder = selection.shot_folder(scene)
    watch = job_timer.watch_of(folder) if folder is not None else None
    names = list(steps.STEPS)
    if watch is None or selection.missing(scene, watch.state) or backend.state()[1] is not None:
        return names[0]
    running, failed = watch.running(), watch.failed()
    if running or failed:
        return running or failed or ""
    views = ((name, steps.STEPS[name].view(scene, watch.state)) for name in names)
    return next((name for name, view in views if not view.done or view.is_unfinished), names[-1])


def is_open(scene: bpy.types.Scene, step: str) -> bool:
    """True if the panel shows a step's body: it is the step to work on, has just ended, or the artist opened it."""
    folder = selection.shot_folder(scene)
    watch = job_timer.watch_of(folder) if folder is not None else None
    by_itself = step == current_step(scene) or (watch is not None and watch.just_ended == step)
    key = (scene.session_uid, folder, step)
    if _chosen.get(key) == by_itself:
        del _chosen[key]
    return _chosen.get(key, by_itself)


def _reader(step: str) -> Callable[[bpy.types.bpy_struct], bool]:
    return lambda settings: is_open(scene_holding(settings), step)


def _writer(step: str) -> Callable[[bpy.types.bpy_struct, bool], None]:
    def write(settings: bpy.types.bpy_struct, value: bool) -> None:
        scene = scene_holding(settings)
        _chosen[scene.session_uid, selection.shot_folder(scene), step] = value

    return write


def _property(step: str) -> bool:
    return BoolProperty(
        name="Open", description="The panel shows this step", options={"HIDDEN"}, get=_reader(step), set=_writer(step)
    )


# Blender stores whether a registered panel is open, and no script can change it. A layout panel can instead use a
# property.
class Folds:
    """Open state of each step, as properties `is_STEP_open` of a scene's settings."""

    is_import_open = _property("import")
    is_solve_open = _property("solve")
    is_train_open = _property("train")
    is_freeze_open = _property("freeze")
    is_bake_open = _property("bake")
