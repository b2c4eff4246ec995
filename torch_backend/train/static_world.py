"""Static baseline: renders of a clip by a static model that is trained for a few hundred steps.

Where a frame differs from the static model, the content either moves or is hard to fit. `motion/misfit.py` uses other
frames to distinguish the two.
"""

from __future__ import annotations

import functools

import numpy as np
import torch
from numpy.typing import NDArray

from ..contract import Reporter, TrainParams
from ..motion.moving import StaticViews
from ..scene import evenly_spaced, load_images, load_scene
from ..sfm.masks import IGNORE, load_mask
from ..shot import Shot
from .config import config_from_params
from .ignored import load_ignored
from .loop import train_to_end
from .pictures import training_size
from .run import warm_up
from .trainer import Trainer

STAGE = "solve: still world"
STEPS = 400
"""Usual number of training steps."""
PER_FRAME = 2, 8
"""Minimum and maximum number of steps per frame. With more steps on few frames, the model would also fit each frame's
moving objects, by Gaussians near that frame's camera."""
GAUSSIANS = 20_000
"""Maximum number of Gaussians: a coarse model that trains quickly."""
FRAMES = 600
"""Maximum number of training frames, evenly spaced over the clip. More would be nearly equal to their neighbours."""


def static_views(shot: Shot, report: Reporter) -> StaticViews:
    """Trains a static model of a solved shot on the CPU. Nothing is written.

    Returns a function that renders a delivered frame as [h, w, 3] uint8 at preview size, with that frame's exposure.
    Raises JobError if the shot cannot be trained, and Cancelled.
    """
    scene = load_scene(shot)
    train = [scene.solved[n] for n in evenly_spaced(len(scene.solved), FRAMES)]
    config = config_from_params(TrainParams(method="static", iterations=steps_for(len(train)), holdout=0, device="cpu"))
    config.densify.budget = GAUSSIANS
    warm_up(config, torch.device("cpu"))
    width, height = training_size(scene, config.width)
    ignored = load_ignored(functools.partial(load_mask, shot, IGNORE), scene, train, width, height)
    heard = _Heard(report)
    trainer = Trainer(scene, load_images(scene, train, width, height), train, config, heard, ignored=ignored)
    train_to_end(trainer, None, lambda _: None)
    index = {frame: n for n, frame in enumerate(scene.frames)}

    @torch.no_grad()
    def rendered(frame: int) -> NDArray[np.uint8]:
        return (trainer.render_frame(index[frame]).clamp(0.0, 1.0) * 255.0).round().byte().numpy()

    return rendered


def steps_for(frames: int) -> int:
    """Number of training steps for a static model of `frames` frames."""
    least, most = (per_frame * frames for per_frame in PER_FRAME)
    return min(max(STEPS, least), most)


class _Heard(Reporter):
    """Forwards progress and cancellation of the training. Its metrics and warnings are dropped."""

    def __init__(self, report: Reporter) -> None:
        self._report = report

    def progress(self, stage: str, done: float, total: float, message: str = "") -> None:
        """Reports the training's progress as a stage of the solve."""
        self._report.progress(STAGE, done, total, message)

    def check_cancelled(self) -> None:
        """Raises Cancelled if the solve was cancelled."""
        self._report.check_cancelled()
