"""What a static model of a clip shows: the clip learnt in a few hundred steps as a world in which nothing moves.

What a frame shows and a static model does not is moving or hard to learn: `motion/misfit.py` tells them apart by other
frames.
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
"""Of training, but at most `PER_FRAME[1]` for each frame: a model that looks longer at few frames learns the movers of
each of them as well, near its camera. Of many frames each is examined `PER_FRAME[0]` times."""
PER_FRAME = 2, 8
GAUSSIANS = 20_000
"""At most: coarse, and soon learnt."""
FRAMES = 600
"""Frames that are learnt from, at most, evenly over the clip: more are as their neighbours are."""


def static_views(shot: Shot, report: Reporter) -> StaticViews:
    """Learns a solved shot as a static world, on the processor; nothing is written.

    Returns what it shows at any delivered frame, [h, w, 3] uint8 of a preview's size, with that frame's exposure.
    JobError if the shot cannot be learnt, Cancelled.
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
    def shown(frame: int) -> NDArray[np.uint8]:
        return (trainer.render_frame(index[frame]).clamp(0.0, 1.0) * 255.0).round().byte().numpy()

    return shown


def steps_for(frames: int) -> int:
    """Steps in which a static model of so many frames is trained."""
    least, most = (each * frames for each in PER_FRAME)
    return min(max(STEPS, least), most)


class _Heard(Reporter):
    """Hands on how far a training is, and that it is to stop; its figures and advice are of no run."""

    def __init__(self, report: Reporter) -> None:
        self._report = report

    def progress(self, stage: str, done: float, total: float, message: str = "") -> None:
        """As a stage of the solve."""
        self._report.progress(STAGE, done, total, message)

    def check_cancelled(self) -> None:
        """As the one that is told."""
        self._report.check_cancelled()
