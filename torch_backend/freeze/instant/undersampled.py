"""Undersampled Gaussians: those that plate t* sees from so far away that nearer frames show them better."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ...scene import Scene
from ...torch_types import norm
from ...train import LoadedRun

AFAR = 2.0
"""Times the distance of another frame from which on a frame sees a thing from afar."""


@torch.no_grad()
def undersampled(run: LoadedRun, scene: Scene, means: Tensor, t_star: float, times: float) -> Tensor:
    """bool [M]: which of the run's first M Gaussians are more than `times` as far from t*'s camera as from the nearest
    one that a trained frame saw them with.

    means [M, 3] is where they are at t*, a frame number; what was never seen is not among them.
    """
    model, trained = run.model, [scene.frames.index(frame) for frame in run.train_frames]
    centres = scene.camera_centres()
    gaps = np.abs(scene.times[trained][None] - model.centres.cpu().numpy()[:, None])
    of_bins = centres[[trained[i] for i in gaps.argmin(1)]].to(means.device)
    least = torch.full_like(means[:, 0], torch.inf)
    for of_bin, seen in zip(of_bins, model.gaussians.support[: len(means)].unbind(1), strict=True):
        least = torch.where(seen, torch.minimum(least, norm(means - of_bin, -1)), least)
    at = scene.nearest(t_star)
    return norm(means - centres[at].to(means.device), -1) > times * least
