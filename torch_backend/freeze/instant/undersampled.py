"""Undersampled Gaussians: plate t* sees them from far away, and other frames show them from nearer."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ...scene import Scene
from ...torch_types import norm
from ...train import LoadedRun

UNDERSAMPLED_RATIO = 2.0
"""Ratio of plate t*'s distance to the nearest frame's distance above which a Gaussian is undersampled."""


@torch.no_grad()
def undersampled(run: LoadedRun, scene: Scene, means: Tensor, t_star: float, times: float) -> Tensor:
    """bool [M]: True for each of the run's first M Gaussians that is undersampled at t*.

    Such a Gaussian is more than `times` as far from t*'s camera as from the nearest trained camera that saw it. One
    that was never seen is not undersampled. `means` [M, 3] are positions at t*, in scene units; `t_star` is a frame
    number.
    """
    model, trained = run.model, [scene.frames.index(frame) for frame in run.train_frames]
    centres = scene.camera_centres()
    gaps = np.abs(scene.times[trained][None] - model.centres.cpu().numpy()[:, None])
    of_bins = centres[[trained[i] for i in gaps.argmin(1)]].to(means.device)
    least = torch.full_like(means[:, 0], torch.inf)
    for of_bin, seen in zip(of_bins, model.gaussians.support[: len(means)].unbind(1), strict=True):
        least = torch.where(seen, torch.minimum(least, norm(means - of_bin, dim=-1)), least)
    at = scene.nearest(t_star)
    return norm(means - centres[at].to(means.device), dim=-1) > times * least
