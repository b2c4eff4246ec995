"""The gate: which Gaussians move at all. It starts closed; the static residual opens it.

A static model that fits a still world leaves the same small error in every frame; where something moved it cannot.
So each Gaussian is given the error of the pixels it paints, frame by frame, and opens where that error is large for
the clip. Closed Gaussians never touch the field: no cost, no drift, nothing to anchor (docs/architecture.md).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from ..gaussians import Gaussians


@dataclass
class GateConfig:
    """When and how far the gate opens."""

    start: float = 1.0 / 3.0
    """Share of the run that stays static (the paper's 10,000 of 30,000 iterations)."""
    rounds: tuple[float, ...] = (1.0 / 3.0, 0.45, 0.55, 0.65)
    """Shares of the run at which residuals are gathered again and more Gaussians may open."""
    threshold: float = 3.0
    """A Gaussian opens if its residual exceeds the median by this many robust standard deviations."""
    floor: float = 0.03
    """Residuals below this (display-referred, 0 to 1) never open: where nothing moves, the spread means nothing."""
    max_share: float = 0.3
    """Most Gaussians that may be open; the largest residuals go first."""
    neighbours: int = 8
    """The median over this many nearest ones stands for a Gaussian: things move in pieces, noise does not."""


def residual_per_gaussian(
    frames: Iterable[int], render: Callable[[int], tuple[Tensor, Callable[[Tensor], Tensor], Tensor]], count: int
) -> tuple[Tensor, Tensor]:
    """Error of the pixels that each Gaussian paints, over frames.

    Args:
        frames: training frames to look at.
        render: frame -> (error [H, W], pull, weight [N]): `pull` maps a per-pixel value to its sum over the pixels of
            each Gaussian weighted by alpha * T [N]; `weight` is that sum for 1.
        count: N.

    Returns:
        (residual [N], weight [N]): the worst-third mean over frames of the weighted mean error, and total weight.
    """
    errors, weights = [], []
    for frame in frames:
        error, pull, weight = render(frame)
        errors.append(pull(error) / weight.clamp_min(1e-6))
        weights.append(weight)
    if not errors:
        return torch.zeros(count, device="cpu"), torch.zeros(count, device="cpu")
    error, weight = torch.stack(errors), torch.stack(weights)
    # A hand is elsewhere in a few frames only: the mean over all would drown it, the maximum would listen to noise.
    seen = weight > 0.5
    ranked = torch.where(seen, error, -1.0).sort(dim=0, descending=True).values
    take = (seen.sum(0) / 3.0).ceil().long().clamp_min(1)
    mask = torch.arange(len(ranked), device=take.device)[:, None] < take[None, :]
    residual = (ranked.clamp_min(0.0) * mask).sum(0) / take
    return residual, weight.sum(0)


@torch.no_grad()
def open_gate(model: Gaussians, residual: Tensor, weight: Tensor, config: GateConfig) -> int:
    """Opens closed Gaussians by residual [N]; returns how many. `weight` [N]: Gaussians that painted nothing stay."""
    painted = weight > 1.0
    if int(painted.sum()) <= config.neighbours:
        return 0
    rows = torch.nonzero(painted).flatten()
    means = model.params["means"].detach()[rows].cpu().numpy()
    nearest = KDTree(means).query(means, k=config.neighbours + 1)[1].reshape(len(rows), -1)
    nearest = torch.from_numpy(np.ascontiguousarray(nearest)).to(rows.device)
    smooth = residual[rows][nearest].median(1).values
    median = smooth.median()
    spread = 1.4826 * (smooth - median).abs().median()
    wanted = torch.zeros_like(model.open)
    wanted[rows] = smooth > torch.clamp_min(median + config.threshold * spread, config.floor)
    room = int(config.max_share * len(model)) - int(model.open.sum())
    candidates = wanted & ~model.open
    if int(candidates.sum()) > room:
        score = smooth.new_full((len(model),), -torch.inf)
        score[rows] = smooth
        score[~candidates] = -torch.inf
        candidates = torch.zeros_like(candidates)
        if room > 0:
            candidates[score.topk(room).indices] = True
    model.open |= candidates
    return int(candidates.sum())
