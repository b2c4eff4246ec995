"""The gate: selects the Gaussians that move.

All Gaussians start closed, and the first part of the run is static. Then Gaussians on moving pixels of the motion
mattes are opened on trial; without mattes, all Gaussians that contribute. During the trial, motion has a price
(`supervision.stillness`). Gaussians that did not move are closed for the rest of the run and keep their mean change.
Closed Gaussians do not use the field, so they cost nothing, do not drift and need no anchors.

The error of the static model is not a good criterion: it is as large on surfaces that are hard to fit as on moving
objects (docs/decisions.md, "Gate and field"). Motion that is worth its price in several frames is rarely false.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from ..gaussians import Gaussians
from ..gaussians.model import SH_C0
from ..gaussians.neighbours import nearest as nearest_points
from ..torch_types import from_numpy, norm
from .protocol import Deltas


@dataclass
class GateConfig:
    """Schedule and thresholds of the gate."""

    WIDTH: ClassVar[int] = 320
    """Image width to which `pixels` refers, independent of the training resolution."""
    STAY_OPEN: ClassVar[tuple[float, int]] = 0.25, 2
    """(share, frames): in a long run, a Gaussian stays open if at least `share` of its contribution falls on moving
    pixels in at least `frames` frames. Opening requires more, but mattes miss much of an arm."""
    LONG: ClassVar[int] = 3000
    """Number of steps up to which strays are not closed. Short runs have few (6 and 25 % of the open Gaussians on two
    clips, 60 % after 9000 steps). Developing treats closed Gaussians as still, which would damage arms of which mattes
    find only a third."""

    start: float = 1.0 / 3.0
    """Share of the run that stays static (the paper's 10,000 of 30,000 iterations)."""
    harden: float = 0.45
    """Share of the run at which Gaussians that did not move are closed for the rest of the run."""
    give_up: float = 0.75
    """Share of the run until which closing is postponed if nothing has moved yet, since some fields learn slowly."""
    pixels: float = 0.2
    """Motion in pixels of an image `WIDTH` wide, in the nearest camera, above which a Gaussian stays open."""
    color: float = 0.02
    """Change of colour (display-referred, 0 to 1) above which a Gaussian stays open."""
    opacity: float = 0.05
    """Change of opacity above which a Gaussian stays open."""
    noise: float = 4.0
    """Least change of a Gaussian that stays open, as a multiple of the 25 % quantile of all changes. Errors of solved
    cameras move everything a little; still Gaussians measure how much. Only used without motion mattes."""
    max_share: float = 0.5
    """Maximum share of Gaussians that stay open, those with the largest changes."""
    neighbours: int = 8
    """Number of nearest open Gaussians over which the median change is taken, because noise is not shared by them."""
    moving_share: float = 0.5
    """With motion mattes: a frame counts if more than this share of a Gaussian's contribution is on moving pixels."""
    moving_frames: int = 3
    """With motion mattes: least number of frames that count for a Gaussian to be opened on trial."""
    moving_often: float = 0.1
    """With motion mattes: least number of frames that count, as a share of the time bins in which the Gaussian was
    seen. It excludes a wall that a hand passes."""


@torch.no_grad()
def painted(model: Gaussians) -> Tensor:
    """bool [N] Gaussians that have contributed to any training frame."""
    return model.support.any(1)


@torch.no_grad()
def change_of(
    model: Gaussians,
    rows: Tensor,
    moments: Iterable[Deltas],
    pixels: Tensor,
    config: GateConfig,
    seen: Tensor | None = None,
) -> tuple[Tensor, Deltas]:
    """Change of Gaussians over time, in units of the thresholds that keep them open, and their mean deltas.

    Args:
        rows: [M] Gaussians.
        moments: T deltas of `rows`, at times spread over the clip.
        pixels: [M] pixels per scene unit in the nearest camera that sees the Gaussian.
        seen: bool [T, M] True at times when a frame shows the Gaussian; the field is arbitrary at other times. For
            Gaussians that are never shown, all times are used. None: all are always shown.

    Returns:
        (change [M], mean deltas [M]): largest deviation from the mean, and the mean, over the times with `seen`.
    """
    moments = list(moments)
    counts = torch.ones(len(moments), len(rows), device=rows.device) if seen is None else seen.float()
    # Gaussians that no frame shows: all times count.
    counts = torch.where(counts.sum(0) > 0, counts, 1.0)
    shares = counts / counts.sum(0)
    mean = Deltas(*(None if parts[0] is None else _weighted(shares, parts) for parts in zip(*moments, strict=True)))  # type: ignore[arg-type]
    opacity = model.params["opacity_logits"][rows]
    change = torch.zeros(len(rows), device=rows.device)
    for at, counted in zip(moments, counts, strict=True):
        departure = norm(at.means - mean.means, dim=1) * pixels / config.pixels
        if at.sh0 is not None and mean.sh0 is not None:
            departure = torch.maximum(departure, SH_C0 * (at.sh0 - mean.sh0).abs().amax((1, 2)) / config.color)
        if at.opacity_logits is not None and mean.opacity_logits is not None:
            now, usual = torch.sigmoid(opacity + at.opacity_logits), torch.sigmoid(opacity + mean.opacity_logits)
            departure = torch.maximum(departure, (now - usual).abs() / config.opacity)
        # At times without a frame the field is arbitrary, so its change there is no evidence.
        change = torch.maximum(change, torch.where(counted > 0, departure, 0.0))
    return change, mean


def _weighted(shares: Tensor, parts: tuple[Tensor, ...]) -> Tensor:
    """[M, ...] sum of T parts [M, ...], weighted by shares [T, M]."""
    return torch.einsum("tm,tm...->m...", shares, torch.stack(parts))


@torch.no_grad()
def stays_open(
    model: Gaussians, rows: Tensor, change: Tensor, config: GateConfig, noise: float | None = None
) -> Tensor:
    """bool [M] True for open `rows` that stay open, by the median `change` [M] of their neighbours.

    noise: replaces that of `config`; None: as in `config`.
    """
    noise = config.noise if noise is None else noise
    if len(rows) <= config.neighbours:
        return change > 1.0
    means = model.params["means"].detach()[rows].cpu().numpy()
    index = nearest_points(means, means, config.neighbours + 1)[1]
    nearest = from_numpy(np.ascontiguousarray(index)).to(rows.device)
    # Neighbours do not share their noise, so a median over them keeps motion and removes noise.
    smooth = change[nearest].median(1).values
    # Errors of solved cameras move everything a little. Still Gaussians, the lowest quarter, measure how much.
    stays = smooth > max(1.0, noise * float(change.quantile(0.25)))
    room = int(config.max_share * len(model))
    if int(stays.sum()) > room:
        kept = torch.where(stays, smooth, -torch.inf).topk(room).indices
        stays = torch.zeros_like(stays)
        stays[kept] = True
    return stays
