"""Takes of a shot: their parameters, their complete and missing frames, and the camera readings for them."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import time
from collections.abc import Generator, Iterable, Iterator
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from .. import compat_animation
from ..access import OperatorBase, scene_in, settings_of
from ..process import backend, begin, job_timer, steps
from ..scene import session
from ..shot import inventory, seen_camera, selection
from ..translations import tr
from . import own_camera

READING_SECONDS = 0.02
"""Time per timer step for reading a camera. One frame of a heavy scene may take longer."""


def has_chosen(context: bpy.types.Context) -> bool:
    """True if the shot has the selected take."""
    scene = scene_in(context)
    folder = selection.shot_folder(scene)
    state = job_timer.watch_of(folder).state if folder else None
    return state is not None and settings_of(scene).take_name in state.takes


class NeedsTake(OperatorBase):
    """Mixin for operators on the selected take. It must precede their other bases."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Disabled without a take, and if another base disables the operator."""
        if not has_chosen(context):
            cls.poll_message_set(tr("Freeze first"))
            return False
        inherited = getattr(super(), "poll", None)
        return inherited is None or bool(inherited(context))


def params_of(scene: bpy.types.Scene) -> contract.FreezeParams:
    """Freeze parameters from the scene's settings."""
    props = settings_of(scene)
    return contract.FreezeParams(
        run=props.run_name,
        take=props.take_name,
        t_star=props.t_star if props.choose_t_star else None,
        t_star_per_frame=keyed_instants(scene),
        width=props.freeze_width,
        overscan={"OFF": 0.0, "LENS": -1.0, "PERCENT": props.overscan_percent}[props.overscan],
        detail="on" if props.detail else "off",
        develop="on" if props.develop else "off",
        passes=props.passes,
        deep=props.deep,
        shutter=own_camera.shutter_of(scene),
        only_missing=True,
        device=backend.device(),
    )


def keyed_instants(scene: bpy.types.Scene) -> dict[str, float]:
    """Frame -> t* if t* has keyframes, for every frame of the clip and of the scene's range; otherwise empty."""
    curves = (c for c in compat_animation.fcurves(scene) if c.data_path == "splannequin.t_star" and not c.mute)
    curve = next(curves, None)
    if curve is None or not settings_of(scene).choose_t_star:
        return {}
    folder = selection.shot_folder(scene)
    first, last = inventory.read(folder).frame_range if folder else (scene.frame_start, scene.frame_end)
    low, high = min(first, scene.frame_start), max(last, scene.frame_end)
    return {str(n): min(max(float(curve.evaluate(n)), first), last) for n in range(low, high + 1)}


def freeze_from(scene: bpy.types.Scene, path: contract.CameraPath, step: str = "freeze") -> contract.FreezeParams:
    """Freeze parameters for a camera path, which is written into the shot. Raises OSError if it cannot be written.

    A bake reads only part of the path. Its other frames keep their earlier poses.
    """
    folder = begin.needed(scene, step)
    shot = contract.ShotFolder(folder)
    file = shot.camera_path(settings_of(scene).take_name)
    shot.own(file.parent)
    if step == "bake" and file.is_file():
        path = _with_rest(path, contract.CameraPath.load(file))
    contract.write_json(file, path.to_json(), parents=False)
    params = _step_params(scene, step)
    params.camera_path, params.width = str(file), path.width
    return params


def _step_params(scene: bpy.types.Scene, step: str) -> contract.FreezeParams:
    """The parameters of the Freeze or Bake step from the scene's settings."""
    params = steps.STEPS[step].params(scene)
    assert isinstance(params, contract.FreezeParams)
    return params


def _with_rest(path: contract.CameraPath, old: contract.CameraPath) -> contract.CameraPath:
    """A camera path, completed with the missing frames from an older one of the same size."""
    if (path.width, path.height) != (old.width, old.height):
        return path
    frames = {f.frame: f for f in [*old.frames, *path.frames]}
    return dataclasses.replace(path, frames=[frames[n] for n in sorted(frames)])


def take_params(shot: Path, take: str, t_star: int | None = None) -> contract.FreezeParams | None:
    """Parameters that render a take's missing frames, from its take.json; None if the take was never finished."""
    facts = inventory.read(shot).takes.get(take)
    if facts is None:
        return None
    return contract.FreezeParams(
        run=facts["run"],
        take=take,
        t_star=facts["t_star_frame"] if t_star is None else t_star,
        t_star_per_frame=facts.get("t_star_per_frame", {}),
        first=facts.get("first"),
        last=facts.get("last"),
        camera_path=seen_camera.path_of(shot, facts),
        query=facts["query"],
        width=facts["width"],
        overscan=facts.get("overscan", 0.0),
        only_missing=True,
        grain=bool(facts.get("grain")),
        detail="on" if facts.get("detail") else "off",
        develop="on" if facts.get("developed") is not None else "off",
        passes=bool(facts.get("passes")),
        deep=bool(facts.get("deep")),
        shutter=float(facts.get("shutter", 0.0)),
    )


def outdated(scene: bpy.types.Scene, take: dict[str, Any]) -> str:
    """How a take differs from the result of a freeze now, in one sentence; empty if it does not.

    Args:
        scene: the scene whose settings are compared.
        take: an entry of `ShotState.takes`.
    """
    params, camera = params_of(scene), own_camera.name_of(scene)
    if take["run"] != params.run:
        return f"The take was frozen from the run {take['run']}, but {params.run} is chosen now."
    if bool(take["camera_path"]) != bool(camera):
        return "The take was frozen from a different camera than the one chosen now."
    ramp = {int(n): float(at) for n, at in take["t_star_per_frame"].items()}
    wanted = {int(n): at for n, at in params.t_star_per_frame.items()}
    if bool(ramp) != bool(wanted) or any(abs(ramp[n] - wanted[n]) > 1e-4 for n in ramp.keys() & wanted.keys()):
        return (
            "The take's t* keyframes differ from the current ones."
            if wanted
            else "The take was frozen with t* keyframes, but t* has none now."
        )
    if not wanted and params.t_star not in (None, take["t_star_frame"], take["t_star_asked"]):
        return f"The take's t* is frame {take['t_star_frame']}, but frame {params.t_star} is chosen now."
    if abs(take["overscan"] - params.overscan) > 1e-6:
        return "The take's overscan differs from the current setting."
    if abs(take["shutter"] - params.shutter) > 1e-3:
        return "The take's motion blur differs from the current setting."
    missing = 0 if camera else take["frames_in_all"] - take["frame_count"]
    return f"{missing} of the take's {take['frames_in_all']} frames are not rendered yet." if missing > 0 else ""


def complete(shot: Path, take: str, frames: Iterable[int] | None = None) -> bool:
    """True if every frame of a finished take is on disk, so that a bake needs no backend.

    Args:
        shot: the shot folder.
        take: name of the take.
        frames: frames to check; those outside the clip or the take's camera path are ignored. None: all from the take's
            first to its last.
    """
    facts = inventory.read(shot).takes.get(take)
    if facts is None:
        return False
    if frames is None:
        wanted: Iterable[int] = range(facts["first"], facts["last"] + 1)
    else:
        can = _possible(shot, facts)
        wanted = [n for n in frames if n in can]
    return not inventory.missing_frames(shot, take, wanted)


def may_be_stale(shot: Path, take: str) -> bool:
    """True if a take's run was trained further after the freeze. The backend can determine which frames changed."""
    facts = inventory.read(shot).takes.get(take, {})
    folder = contract.ShotFolder(shot)
    trained = contract.RunFolder(folder.runs / str(facts.get("run", ""))).checkpoint
    record = contract.TakeFolder(folder.takes / take).facts
    if not trained.is_file() or not record.is_file():
        return False
    try:
        frozen = contract.read_json(record, contract.SHORT_JSON).get("checkpoint")
        if frozen:
            return contract.file_digest(trained) != frozen
    except (OSError, ValueError):
        return True
    return trained.stat().st_mtime > record.stat().st_mtime  # frozen by an earlier version, which recorded no digest


def _possible(shot: Path, facts: dict[str, Any]) -> set[int]:
    """Frames that a take can have: those of its camera path, or of the clip."""
    path = seen_camera.path_of(shot, facts)
    if os.path.isfile(path):
        return {f.frame for f in contract.CameraPath.load(path).frames}
    first, last = (facts["first"], facts["last"]) if path else inventory.read(shot).frame_range
    return set(range(first, last + 1))


def read_camera(scene: bpy.types.Scene, step: str) -> contract.FreezeParams | None:
    """Parameters of a freeze from the artist's camera, which is sampled without interruption; None if none is
    selected."""
    name, folder = own_camera.name_of(scene), selection.shot_folder(scene)
    if not name or folder is None:
        return None
    turns = own_camera.sample_path(scene, name, folder, _step_params(scene, step).width)
    while True:
        try:
            next(turns)
        except StopIteration as end:
            return freeze_from(scene, end.value, step)


def read_in_turns(scene: bpy.types.Scene, shot: Path, step: str) -> None:
    """Reads the artist's camera in steps run by the timer, then starts the Freeze or Bake step."""
    job_timer.watch_of(shot).notes.clear()
    turns = own_camera.sample_path(scene, own_camera.name_of(scene), shot, _step_params(scene, step).width)
    total = len(range(scene.frame_start, scene.frame_end + 1, scene.frame_step))
    job_timer.work(shot, step, reading(scene.session_uid, shot, step, turns, total))


def reading(
    scene_uid: int, shot: Path, step: str, turns: Generator[int, None, contract.CameraPath], total: int
) -> Iterator[job_timer.Progress]:
    """Reads a camera from `turns` (`own_camera.sample_path`) for a fraction of each timer step, then starts the
    take."""
    done, path = 0, None
    with contextlib.closing(turns):  # also if it is cancelled
        while path is None:
            until = time.monotonic() + READING_SECONDS
            try:
                while time.monotonic() < until:
                    done = next(turns)
                yield job_timer.Progress(f"Reading the camera, frame {done} of {total}", done, total)
            except StopIteration as end:
                path = end.value
    found = session.scene_of(scene_uid)
    if found is None:
        return
    if selection.shot_folder(found) != shot:
        raise contract.JobError(
            "Another shot was chosen while the camera was being read.", "Choose this shot and freeze again."
        )
    job_timer.follow(step, begin.begin(found, step, freeze_from(found, path, step)))
