"""The gate: which Gaussians move at all.

All start closed, and the first part of the run is static. Then every one that is painted is opened on trial, under a
price on motion (`supervision.stillness`), and when the Gaussians have stopped multiplying those that did not use it are
closed for good, their mean change kept. Closed Gaussians never touch the field: no cost, no drift, nothing to anchor.

The error of the static model was tried as the judge, and is a poor one: where a surface is hard to fit it is as large
as where something moves (figures in docs/architecture.md), while motion that is worth its price to several frames in a
row is rarely anything else.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from ..gaussians import Gaussians
from ..gaussians.model import SH_C0
from .protocol import Deltas


@dataclass
class GateConfig:
    """When the gate opens, and what keeps it open."""

    start: float = 1.0 / 3.0
    """Share of the run that stays static (the paper's 10,000 of 30,000 iterations)."""
    harden: float = 0.45
    """Share of the run at which what did not move is closed for good."""
    give_up: float = 0.75
    """Share of the run until which that is put off while nothing moves yet: some fields take their time."""
    pixels: float = 0.2
    """A Gaussian stays open if it moves by this many pixels of the training images, seen from the nearest camera..."""
    color: float = 0.02
    """...or changes its colour by this (display-referred, 0 to 1)..."""
    opacity: float = 0.05
    """...or its opacity by this."""
    noise: float = 4.0
    """Nor does it stay open with less than this many times the change of the quarter that changes least: where cameras
    are solved, everything seems to move a little, and what holds still tells how much."""
    max_share: float = 0.5
    """Most Gaussians that stay open; what moves most goes first."""
    neighbours: int = 8
    """The median over this many nearest open ones stands for a Gaussian: things move in pieces, noise does not."""


@torch.no_grad()
def painted(model: Gaussians) -> Tensor:
    """bool [N]: who has contributed to any training frame."""
    return model.support.any(1)


@torch.no_grad()
def change_of(
    model: Gaussians, rows: Tensor, moments: Iterable[Deltas], pixels: Tensor, config: GateConfig
) -> tuple[Tensor, Deltas]:
    """How much Gaussians change over time, in units of what keeps them open; and their mean deltas.

    Args:
        rows: [M] who.
        moments: their deltas [M] at times spread over the clip.
        pixels: [M] pixels per scene unit where each is seen from nearest.

    Returns:
        (change [M], mean deltas [M]): the largest departure from the mean over the moments.
    """
    moments = list(moments)
    mean = Deltas(*(None if parts[0] is None else torch.stack(parts).mean(0) for parts in zip(*moments, strict=True)))  # type: ignore[arg-type]
    opacity = model.params["opacity_logits"][rows]
    change = torch.zeros(len(rows), device=rows.device)
    for at in moments:
        change = torch.maximum(change, (at.means - mean.means).norm(dim=1) * pixels / config.pixels)
        if at.sh0 is not None and mean.sh0 is not None:
            change = torch.maximum(change, SH_C0 * (at.sh0 - mean.sh0).abs().amax((1, 2)) / config.color)
        if at.opacity_logits is not None and mean.opacity_logits is not None:
            here, usual = torch.sigmoid(opacity + at.opacity_logits), torch.sigmoid(opacity + mean.opacity_logits)
            change = torch.maximum(change, (here - usual).abs() / config.opacity)
    return change, mean


@torch.no_grad()
def stays_open(model: Gaussians, rows: Tensor, change: Tensor, config: GateConfig) -> Tensor:
    """bool [M]: which of the open `rows` stay so, by their `change` [M] and that of their neighbours."""
    if len(rows) <= config.neighbours:
        return change > 1.0
    means = model.params["means"].detach()[rows].cpu().numpy()
    nearest = KDTree(means).query(means, k=config.neighbours + 1)[1].reshape(len(rows), -1)
    nearest = torch.from_numpy(np.ascontiguousarray(nearest)).to(rows.device)
    smooth = change[nearest].median(1).values
    stays = smooth > max(1.0, config.noise * float(change.quantile(0.25)))
    room = int(config.max_share * len(model))
    if int(stays.sum()) > room:
        kept = torch.where(stays, smooth, -torch.inf).topk(room).indices
        stays = torch.zeros_like(stays)
        stays[kept] = True
    return stays
