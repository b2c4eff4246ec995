"""The five steps as plain functions: what a button asks of the backend, and what its answer changes in the scene.

The same functions serve the buttons, the timer and the command line.
"""

from __future__ import annotations

import dataclasses
import errno
import os
import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...torch_backend import contract
from .. import compat
from ..bake import compositor, freeze_group, insertion
from ..footage import plate
from ..scene import intact, paths, scene_setup
from ..shot import chosen, contents, made, markers
from ..shot.shot_state import ShotState
from ..solve import cameras, exchange
from ..train import training
from . import backend, jobs


@dataclass(frozen=True)
class Step:
    """One of the five."""

    name: str
    """Identifier: footage, camera, train, freeze or bake."""
    label: str
    """Name on the panel."""
    kind: str
    """Kind of the job behind it."""
    button: str
    """What the button says."""
    again: str
    """What the button says once the step is done."""
    needs: str
    """What to do before, in a sentence; empty if nothing."""


STEPS = {
    s.name: s
    for s in (
        Step("footage", "Footage", "import", "Import Clip", "Import Again", ""),
        Step("camera", "Camera", "solve", "Solve Camera", "Solve Again", "Import the clip first."),
        Step("train", "Train", "train", "Train", "Train On", "Solve the camera first."),
        Step("freeze", "Freeze", "freeze", "Freeze", "Freeze Again", "Train first."),
        Step("bake", "Bake", "freeze", "Bake and Render", "Bake Again", "Freeze first."),
    )
}
"""The steps in order."""


def params_of(scene: Any, step: str) -> Any:
    """The backend's parameters for a step, from what the artist set. JobError names what is missing."""
    props = scene.splannequin
    if step == "footage":
        if not props.clip:
            raise contract.JobError("No clip is chosen.", "Choose a video or image sequence.", contract.ExitCode.USAGE)
        span = (props.first, props.last) if props.use_range else (None, None)
        return contract.ImportParams(paths.absolute(props.clip), *span, step=props.solve_step, fps=props.fps)
    if step == "camera":
        return exchange.params(scene, chosen.shot_folder(scene))
    if step == "train":
        folder = chosen.shot_folder(scene)
        state = contents.read(folder) if folder is not None else None
        return training.params(state, props.run_name, props.preset, props.extend_steps, backend.device())
    t_star = props.t_star if props.choose_t_star else None
    params = contract.FreezeParams(
        run=props.run_name,
        take=props.take_name,
        t_star=t_star,
        t_star_per_frame=keyed_instants(scene),
        width=props.freeze_width,
        overscan=-1.0 if props.overscan == "LENS" else 0.0,
        detail="on" if props.detail else "off",
        develop="on" if props.develop else "off",
        only_missing=True,
        device=backend.device(),
    )
    folder = chosen.shot_folder(scene)
    if step == "bake" and folder is not None:
        asked = take_params(folder, props.take_name, t_star)
        if asked is not None and props.choose_t_star:
            asked.t_star_per_frame = params.t_star_per_frame
        params = asked or params
        params.device = backend.device()
        params.first, params.last, params.step = scene.frame_start, scene.frame_end, scene.frame_step
    return params


def keyed_instants(scene: Any) -> dict[str, float]:
    """Frame -> t* of a keyed t*, for every frame of the clip and of the scene's range; empty if it is not keyed."""
    curve = next((c for c in compat.fcurves(scene) if c.data_path == "splannequin.t_star"), None)
    if curve is None or not scene.splannequin.choose_t_star:
        return {}
    folder = chosen.shot_folder(scene)
    first, last = contents.read(folder).frame_range if folder else (scene.frame_start, scene.frame_end)
    low, high = min(first, scene.frame_start), max(last, scene.frame_end)
    return {str(n): min(max(float(curve.evaluate(n)), first), last) for n in range(low, high + 1)}


def own_camera(scene: Any) -> str:
    """Name of the artist's camera to freeze from; empty for the clip's own move."""
    camera, folder = scene.splannequin.path_camera, chosen.shot_folder(scene)
    if camera is None or folder is None or camera == cameras.find(scene, folder, "CAMERA"):
        return ""
    return str(camera.name)


def follows_camera(scene: Any) -> bool:
    """True if a bake has to look at the artist's camera again: the take was seen from one, and one is chosen."""
    folder = chosen.shot_folder(scene)
    if folder is None or not own_camera(scene):
        return False
    return bool(contents.read(folder).takes.get(scene.splannequin.take_name, {}).get("camera_path"))


def freeze_from(scene: Any, path: contract.CameraPath, step: str = "freeze") -> contract.FreezeParams:
    """Parameters of a take from a camera path, which is written into the shot. OSError if it cannot be.

    A bake is about a part of the take: where the camera was not looked at now, it stays as it was.
    """
    folder = _needed(scene, step)
    file = contract.ShotFolder(folder).camera_path(scene.splannequin.take_name)
    if step == "bake" and file.is_file():
        path = _with_rest(path, contract.CameraPath.load(file))
    jobs.write_json(file, path.to_json())
    params = params_of(scene, step)
    params.camera_path, params.width = str(file), path.width
    return params


def _with_rest(path: contract.CameraPath, old: contract.CameraPath) -> contract.CameraPath:
    """A camera path, and of an older one of the same size the frames that it lacks."""
    if (path.width, path.height) != (old.width, old.height):
        return path
    frames = {f.frame: f for f in [*old.frames, *path.frames]}
    return dataclasses.replace(path, frames=[frames[n] for n in sorted(frames)])


def take_params(shot: Path, take: str, t_star: int | None = None) -> contract.FreezeParams | None:
    """What a take was asked for with, from its take.json, to render what it lacks; None if it was never finished."""
    facts = contents.read(shot).takes.get(take)
    if facts is None:
        return None
    return contract.FreezeParams(
        run=facts["run"],
        take=take,
        t_star=facts["t_star_frame"] if t_star is None else t_star,
        t_star_per_frame=facts.get("t_star_per_frame", {}),
        first=facts.get("first"),
        last=facts.get("last"),
        camera_path=_path_of(shot, facts),
        query=facts["query"],
        width=facts["width"],
        overscan=facts.get("overscan", 0.0),
        only_missing=True,
        grain=bool(facts.get("grain")),
        detail="on" if facts.get("detail") else "off",
        develop="on" if facts.get("developed") is not None else "off",
    )


def complete(shot: Path, take: str, frames: Iterable[int] | None = None) -> bool:
    """True if every frame of a finished take is on disk: it can be baked without a backend.

    Args:
        shot: the shot folder.
        take: name of the take.
        frames: only these are asked for, as far as the clip or the take's camera has them; None: all between the
            take's first and last.
    """
    facts = contents.read(shot).takes.get(take)
    if facts is None:
        return False
    if frames is None:
        wanted: Iterable[int] = range(facts["first"], facts["last"] + 1)
    else:
        can = _possible(shot, facts)
        wanted = [n for n in frames if n in can]
    return not insertion.missing_frames(shot, take, wanted)


def may_be_stale(shot: Path, take: str) -> bool:
    """True if a take's run was trained on after the take was frozen: the backend can tell which frames that changed."""
    facts = contents.read(shot).takes.get(take, {})
    there = contract.ShotFolder(shot)
    trained = contract.RunFolder(there.runs / str(facts.get("run", ""))).checkpoint
    told = contract.TakeFolder(there.takes / take).facts
    return trained.is_file() and told.is_file() and trained.stat().st_mtime > told.stat().st_mtime


def _path_of(shot: Path, facts: dict[str, Any]) -> str:
    """File of the camera path that a take was seen from: as it was named, or in the shot, if that was moved since."""
    named = str(facts.get("camera_path", ""))
    moved = contract.ShotFolder(shot).camera_path(str(facts.get("take", "")))
    return str(moved) if named and not Path(named).is_file() and moved.is_file() else named


def _possible(shot: Path, facts: dict[str, Any]) -> set[int]:
    """Frames that a take can have: those of its camera's path, or the clip's."""
    path = _path_of(shot, facts)
    if path and Path(path).is_file():
        return {f.frame for f in contract.CameraPath.load(path).frames}
    first, last = (facts["first"], facts["last"]) if path else contents.read(shot).frame_range
    return set(range(first, last + 1))


def begin(scene: Any, step: str, params: Any = None) -> jobs.Job:
    """Starts the job behind a step on the scene's shot, detached.

    Raises:
        contract.JobError: nothing to work on, no backend, or the shot cannot be written.
    """
    params = params or params_of(scene, step)
    folder = _needed(scene, step)
    backend.python()  # before anything is written: without a backend there is nothing to start
    try:
        jobs.refuse_second_writer(folder)
        if step == "footage":
            contents.create(folder)
        job = jobs.new_job(folder, STEPS[step].kind, params)
        (job.folder / contract.STEP_FILE).write_text(step, encoding="utf-8")
    except OSError as error:
        raise unwritable(folder, error, "Choose another shot folder.") from error
    try:
        backend.start(job)
    except contract.JobError:
        shutil.rmtree(job.folder)  # else it would pass for one that is about to start
        give_up(job)
        raise
    return job


def _needed(scene: Any, step: str) -> Path:
    """The scene's shot folder, which a step needs to be there unless it makes it. JobError says what to do."""
    folder = chosen.shot_folder(scene)
    if folder is None:
        raise contract.JobError("No shot is chosen.", "Import a clip or choose a shot folder.", contract.ExitCode.USAGE)
    if step != "footage" and not os.path.isfile(contract.ShotFolder(folder).info_path):
        if chosen.missing(scene, None):
            message, hint = f"The shot folder {folder} is not there any more.", "Press Locate and choose it."
            raise contract.JobError(message, hint, contract.ExitCode.USAGE)
        raise contract.JobError(f"{folder} is no shot folder.", STEPS[step].needs, contract.ExitCode.USAGE)
    return folder


def unwritable(folder: Path, error: OSError, hint: str) -> contract.JobError:
    """What is said of a folder that cannot be written, with the exit code that the backend's command line gives it."""
    code = contract.ExitCode.DISK if error.errno in (errno.ENOSPC, errno.EDQUOT) else contract.ExitCode.USAGE
    return contract.JobError(f"Cannot write to {folder}: {error.strerror or error}.", hint, code)


def give_up(job: jobs.Job) -> None:
    """After an import that did not end well: the shot that it was to begin is not left behind empty."""
    if job.kind == "import" and job.state != "done":
        contract.discard_unborn(job.shot)


def step_of(job: jobs.Job) -> str:
    """Name of the step that a job found in a shot folder belongs to: Freeze and Bake ask for the same kind."""
    try:
        with contract.open_regular(job.folder / contract.STEP_FILE) as file:
            told = file.read(100).decode("utf-8", "replace")
    except (OSError, ValueError):
        told = ""  # started from the backend's command line
    names = [s.name for s in STEPS.values() if s.kind == job.kind]
    return told if told in names else names[0]


def finish(scene: Any, step: str, job: jobs.Job) -> list[str]:
    """What a finished job changes in the scene; returns it in words."""
    shot = job.shot
    if step == "footage":
        return imported(scene, shot)
    if step == "camera":
        return load_camera(scene, shot)
    if step == "freeze" and not scene.splannequin.choose_t_star:
        scene.splannequin.t_star = int(job.result["t_star_frame"])
    if step == "bake":
        return insert_freeze(scene, shot, job.params["take"])
    return []


def imported(scene: Any, shot: Path) -> list[str]:
    """After the import: the scene takes the clip's size, rate and range if it is new or the artist consents."""
    state = contents.read(shot)
    props = scene.splannequin
    chosen.see(scene, state)
    first, last = state.frame_range
    if not first <= props.t_star <= last:
        props.t_star = (first + last) // 2
    changes, camera = _fit(scene, state), plate.show(scene, shot)
    if camera is not None:
        changes.append(f"{camera.name} shows the clip until the camera is solved.")
    return changes


def load_camera(scene: Any, shot: Path) -> list[str]:
    """Brings the solve into the scene. FileNotFoundError if there is none."""
    state = contents.read(shot)
    chosen.see(scene, state)
    with intact.scene_of(scene):
        camera = cameras.build(scene, shot)
        changes = _fit(scene, state, force_k=True)
    plate.remove(scene, shot)
    return [f"{camera.name} is the scene's camera, with the plate behind it.", *changes]


def insert_freeze(scene: Any, shot: Path, take: str, warp: bool | None = None) -> list[str]:
    """Puts a take into the scene's compositor, or its warp, and keeps the plate's colours if the artist consents."""
    with intact.scene_of(scene):
        changes = scene_setup.keep_plate_colours(scene) if scene.splannequin.keep_colours else []
        return insertion.insert(scene, shot, take, warp) + changes


def combine_cg(scene: Any, shot: Path) -> list[str]:
    """Has the scene's own objects stand among the frozen. JobError if the freeze is not in the compositor."""
    compositor.may_combine_cg(scene)
    with intact.scene_of(scene):
        changes = scene_setup.render_cg(scene)  # first: without the pass the node has no socket for it
        return compositor.combine_cg(scene) + changes


def remove_all(scene: Any, shot: Path) -> list[str]:
    """Takes everything of a shot out of the file; its folder on disk stays. Returns what was done, in words.

    What another shot of the scene needs stays: its own things, and the settings of the scene.
    """
    done = []
    there = freeze_group.shown(scene)
    baked = there[0].parent.parent if there is not None else None
    others = [f for f in chosen.folders(scene) if f is not None and f != shot]
    others = [f for f in others if f == baked or made.of(scene, f) is not None]
    if baked not in others and insertion.remove(scene):
        done.append("The freeze left the compositor.")
    plate.remove(scene, shot)
    if cameras.remove(scene, shot):
        done.append("Camera and points were removed.")
    if others:
        return done
    if markers.remove(scene):
        done.append("The marker t* was removed.")
    if scene_setup.restore(scene):
        done.append("The scene's settings are as they were.")
    return done


def run(
    scene: Any, step: str, params: Any = None, on_event: Callable[[contract.Event], None] | None = None
) -> tuple[Any, list[str]]:
    """A whole step, blocking: for scripts and the command line. Returns the job's result and what changed, in words.

    Raises:
        contract.JobError, contract.Cancelled: as the job ended.
    """
    job = begin(scene, step, params)
    return wait(job, on_event), finish(scene, step, job)


def wait(job: jobs.Job, on_event: Callable[[contract.Event], None] | None = None) -> Any:
    """`jobs.wait`; an import that does not end well leaves no empty shot."""
    try:
        return jobs.wait(job, on_event)
    except (contract.JobError, contract.Cancelled):
        give_up(job)
        raise


def _fit(scene: Any, state: ShotState, force_k: bool = False) -> list[str]:
    props = scene.splannequin
    if not (props.set_up_scene or scene_setup.untouched(scene) or scene_setup.fitted(scene)):
        return ["Your scene's size and range were left alone (Fit Scene to Clip is off)."]
    size, k = state.size, None
    if force_k:
        path = contract.CameraPath.load(contract.ShotFolder(state.folder).cameras)
        size = (path.width, path.height)
        k = (path.frames[0].K[0], path.frames[0].K[1], path.frames[0].K[2], path.frames[0].K[3])
    fps = float(state.info.get("fps", 0.0))
    return scene_setup.fit_clip(scene, size, fps, state.frame_range, k, props.set_up_scene)
