"""Estimates the guessed fraction of a camera's images before the freeze: a live session draws small support images.

A pixel is a guess if no splat covers it, or if no frame near t* saw the splats that it shows.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np

from ...torch_backend import contract
from ..access import Outcome, scene_in, settings_of
from ..process import backend, job_timer
from ..scene import session
from ..shot import selection
from ..translations import tr
from ..ui import step_operator
from . import live, own_camera, takes, viewport

WIDTH = 160
"""Width of the small images in pixels."""
MOST_FRAMES = 24
"""Maximum number of frames drawn per camera, evenly spaced."""
# Support from which a pixel does not count as a guess: half of its content was seen near t*.
_SUPPORTED = 0.5
# Interval between checks of the session when Blender runs without a window.
_PAUSE_SECONDS = 0.005
# View number in the live session. Windows use numbers from 0.
_VIEW = -1


@dataclass(frozen=True)
class Guesses:
    """Fraction of guessed pixels in a camera's images."""

    camera: str
    """Name of the camera."""
    shares: dict[int, float]
    """Frame number -> fraction of its pixels, 0..1."""

    def sentence(self) -> str:
        """Sentence about the mean and the worst frame."""
        mean = sum(self.shares.values()) / len(self.shares)
        worst = max(self.shares, key=lambda frame: self.shares[frame])
        sentences = [
            f"Seen from {self.camera}, about {_percent(mean)} % of the image is guessed.",
            f"Most of it in frame {worst}: {_percent(self.shares[worst])} %.",
        ]
        return " ".join(sentences)


def checking(scene: bpy.types.Scene, shot: Path, name: str) -> Generator[job_timer.Progress, None, Guesses]:
    """Draws the support along a camera, at most one frame per timer step. Keeps no bpy data between steps.

    Args:
        scene: the scene with the freeze's range and settings.
        shot: its shot folder.
        name: `name_full` of the camera object.

    Raises:
        contract.JobError: the camera cannot be read, the run or backend is missing, or the session ended.
    """
    props = settings_of(scene)
    run, params = props.run_name, takes.params_of(scene)
    total = len(range(scene.frame_start, scene.frame_end + 1, scene.frame_step))
    every = max(1, math.ceil(total / MOST_FRAMES))
    turns = own_camera.sample_path(scene, name, shot, WIDTH, every)
    del scene, props
    shown = viewport.session()
    shared = shown is not None and (shown.shot, shown.run) == (shot, run)
    drawn = (
        shown
        if shown is not None and shared
        else live.open_session(shot, run, backend.python(), backend.package_root())
    )
    try:
        path, done = None, 0
        with contextlib.closing(turns):
            while path is None:
                try:
                    done = next(turns)
                    yield job_timer.Progress("Reading the camera", done, total)
                except StopIteration as end:
                    path = end.value
        while not drawn.facts:
            _still_open(drawn)
            yield job_timer.Progress("The backend is loading the run", 0, len(path.frames))
        t_star = float(drawn.facts["suggestions"][0]["frame"] if params.t_star is None else params.t_star)
        shares: dict[int, float] = {}
        for frame in path.frames:
            at, develop = params.t_star_per_frame.get(str(frame.frame), t_star), params.develop == "on"
            view = contract.LiveView(
                _VIEW, 0, frame.viewmat, frame.K, path.width, path.height, at, show="support", develop=develop
            )
            drawn.ask(view)
            while drawn.busy(_VIEW):
                _still_open(drawn)
                yield job_timer.Progress("Checking the camera's images", len(shares), len(path.frames))
            shares[frame.frame] = share_of(drawn.frames.get(_VIEW), view)
        return Guesses(name, shares)
    finally:
        drawn.frames.pop(_VIEW, None)
        if not shared:
            drawn.close()


def share_of(frame: live.Frame | None, request: contract.LiveView) -> float:
    """Fraction of a drawn view's pixels that are guesses, 0..1. Raises JobError if the frame answers another
    request."""
    if frame is None or frame.request.seq != request.seq:
        raise contract.JobError("The backend could not render the camera's view.", "Try again.")
    return float(np.count_nonzero(frame.rgba[..., 0] < _SUPPORTED) / max(1, frame.rgba[..., 0].size))


def _still_open(drawn: live.Session) -> None:
    """Raises JobError if a session has ended."""
    if not drawn.open:
        raise contract.JobError(*(drawn.failure or ("Scrubbing was stopped.", "Check the move again.")))


def _percent(share: float) -> int:
    """Fraction as whole percent, at least 1 if it is not 0."""
    return max(round(100.0 * share), 1 if share > 0.0 else 0)


def _in_turns(scene_uid: int, shot: Path, name: str) -> Generator[job_timer.Progress, None, None]:
    """`checking` for a window: shows the result on the panel."""
    scene = session.scene_of(scene_uid)
    if scene is None:
        return
    turns = checking(scene, shot, name)
    del scene
    found = yield from turns
    job_timer.watch_of(shot).notes["freeze"] = [found.sentence()]


class SPLANNEQUIN_OT_check_move(step_operator.StepOperator, bpy.types.Operator):
    """Render small images along the chosen camera and show how much of them will be guessed, before you freeze"""

    bl_idname = "splannequin.check_move"
    bl_label = "Check Move"
    bl_options = {"REGISTER"}
    step = "freeze"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Disabled without an artist's camera, or without a trained run."""
        scene = scene_in(context)
        folder = selection.shot_folder(scene)
        state = job_timer.watch_of(folder).state if folder else None
        if not own_camera.name_of(scene):
            cls.poll_message_set(tr("Choose a camera or create a move first"))
            return False
        if state is None or settings_of(scene).run_name not in state.runs:
            cls.poll_message_set(tr("Train first"))
            return False
        return super().poll(context)

    def perform(self, context: bpy.types.Context) -> Outcome:
        """Starts the check by the timer. Without a window, waits for the result."""
        scene, name = scene_in(context), own_camera.name_of(scene_in(context))
        folder = selection.shot_folder(scene)
        assert folder is not None  # `poll` has checked it
        if not bpy.app.background:
            job_timer.work(folder, self.step, _in_turns(scene.session_uid, folder, name))
            return {"FINISHED"}
        found = waited(checking(scene, folder, name))
        job_timer.watch_of(folder).notes[self.step] = [found.sentence()]
        self.report({"INFO"}, tr(found.sentence()))
        return {"FINISHED"}


def waited(turns: Generator[job_timer.Progress, None, Guesses]) -> Guesses:
    """The result of `checking`, computed without interruption."""
    while True:
        try:
            next(turns)
        except StopIteration as end:
            return end.value
        time.sleep(_PAUSE_SECONDS)


CLASSES = (SPLANNEQUIN_OT_check_move,)
