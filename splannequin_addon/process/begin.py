"""Starts a step, waits for it, and undoes all steps of a shot. Shared by operators, timer and command line."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from ..scene import scene_setup
from ..shot import inventory, markers, placement, selection
from . import backend, jobs, steps


def begin(scene: bpy.types.Scene, step: str, params: jobs.Params | None = None) -> jobs.Job:
    """Starts the job of a step on the scene's shot as a detached process.

    Raises:
        contract.JobError: no shot is selected, there is no backend, or the shot cannot be written.
    """
    selection.clear_cache()
    params = params or steps.STEPS[step].params(scene)
    folder = needed(scene, step)
    backend.python()  # fails before anything is written
    try:
        jobs.refuse_second_writer(folder)
        if steps.STEPS[step].makes_shot:
            inventory.create(folder)
        placement.write(scene, folder)
        job = jobs.new_job(folder, jobs.kind_of(params), params)
        (job.folder / contract.STEP_FILE).write_text(step, encoding="utf-8")
        (job.folder / contract.SCENE_FILE).write_text(scene.name, encoding="utf-8")
        job.scene_uid, job.blend = scene.session_uid, os.path.basename(bpy.data.filepath)
        if job.blend:
            (job.folder / contract.BLEND_FILE).write_text(job.blend, encoding="utf-8", errors="replace")
    except OSError as error:
        raise inventory.unwritable(folder, error, "Choose another shot folder.") from error
    try:
        backend.start(job)
    except contract.JobError:
        shutil.rmtree(job.folder)  # otherwise it would look like a job about to start
        steps.STEPS[step].ended(job)
        raise
    return job


def needed(scene: bpy.types.Scene, step: str) -> Path:
    """The scene's shot folder. It must exist unless the step creates it. Raises JobError with a hint."""
    folder = selection.shot_folder(scene)
    if folder is None:
        raise contract.JobError("No shot is chosen.", "Import a clip or choose a shot folder.", contract.ExitCode.USAGE)
    if not steps.STEPS[step].makes_shot and not os.path.isfile(contract.ShotFolder(folder).info_path):
        if selection.missing(scene, None):
            message, hint = f"The shot folder {folder} no longer exists.", "Press Locate and choose it."
            raise contract.JobError(message, hint, contract.ExitCode.USAGE)
        raise contract.JobError(f"{folder} is not a shot folder.", steps.STEPS[step].needs, contract.ExitCode.USAGE)
    return folder


def remove_all(scene: bpy.types.Scene, shot: Path) -> list[str]:
    """Removes everything of a shot from the file; its folder on disk stays. Returns the changes as sentences.

    Objects of the scene's other shots stay. While any other shot has some, the scene's settings stay, too.
    """
    remaining = [f for f in selection.folders(scene) if f is not None and f != shot]
    remaining = [f for f in remaining if any(step.is_present(scene, f) for step in steps.STEPS.values())]
    done: list[str] = []
    for step in reversed(steps.STEPS.values()):
        done += step.remove(scene, shot, remaining)
    if remaining:
        return done
    if markers.remove(scene):
        done.append("The marker t* was removed.")
    if scene_setup.restore(scene):
        done.append("The scene's settings were restored.")
    return done


def run(
    scene: bpy.types.Scene,
    step: str,
    params: jobs.Params | None = None,
    on_event: Callable[[contract.Event], None] | None = None,
) -> tuple[Any, list[str]]:
    """Runs a whole step, blocking, for scripts and the command line. Returns (the job's result, sentences about
    changes).

    Raises:
        contract.JobError, contract.Cancelled: the job failed or was cancelled.
    """
    job = begin(scene, step, params)
    return wait(job, on_event), steps.STEPS[step].finish(scene, job)


def wait(job: jobs.Job, on_event: Callable[[contract.Event], None] | None = None) -> Any:
    """Waits as `jobs.wait` does. An import that fails leaves no empty shot."""
    try:
        return jobs.wait(job, on_event)
    except (contract.JobError, contract.Cancelled):
        steps.STEPS[steps.step_of(job)].ended(job)
        raise
