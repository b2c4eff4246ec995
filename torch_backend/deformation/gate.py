"""The gate: which Gaussians move at all.

All start closed, and the first part of the run is static. Then those that lie in what the motion mattes call moving are
opened on trial, or every one that is painted where a shot has no mattes, under a price on motion
(`supervision.stillness`); those that did not use it are closed for good, their mean change kept. Closed Gaussians never
touch the field: no cost, no drift, nothing to anchor.

The error of the static model was tried as the judge, and is a poor one: where a surface is hard to fit it is as large
as where something moves (figures in docs/architecture.md), while motion that is worth its price to several frames in a
row is rarely anything else.
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
    """When the gate opens, and what keeps it open."""

    WIDTH: ClassVar[int] = 320
    """Width of the pictures that `pixels` counts in, whatever is trained on: a motion is as large as it looks."""
    STRAY: ClassVar[tuple[float, int]] = 0.25, 2
    """Share of a Gaussian's contribution that must fall on movers, and in how many frames, for it to stay open in a
    long run. Opening requires more, because mattes miss much of an arm."""
    LONG: ClassVar[int] = 3000
    """Runs of at most this many steps do not close strays. Strays are few then (6 and 25 % of the open Gaussians on two
    clips, 60 % after 9000 steps), and developing treats closed Gaussians as still, which costs arms of which mattes
    find a third."""

    start: float = 1.0 / 3.0
    """Share of the run that stays static (the paper's 10,000 of 30,000 iterations)."""
    harden: float = 0.45
    """Share of the run at which what did not move is closed for good."""
    give_up: float = 0.75
    """Share of the run until which that is put off while nothing moves yet: some fields take their time."""
    pixels: float = 0.2
    """A Gaussian stays open if it moves by so many pixels of pictures `WIDTH` wide, seen from the nearest camera..."""
    color: float = 0.02
    """...or changes its colour by this (display-referred, 0 to 1)..."""
    opacity: float = 0.05
    """...or its opacity by this."""
    noise: float = 4.0
    """Nor does it stay open with less than this many times the change of the quarter that changes least: where cameras
    are solved, everything seems to move a little, and what holds still tells how much. Without motion mattes only."""
    max_share: float = 0.5
    """Most Gaussians that stay open; what moves most goes first."""
    neighbours: int = 8
    """The median over this many nearest open ones stands for a Gaussian: things move in pieces, noise does not."""
    moving_share: float = 0.5
    """With motion mattes, a Gaussian is put on trial if this share of what it paints of a frame falls on movers..."""
    moving_frames: int = 3
    """...in at least this many frames,"""
    moving_often: float = 0.1
    """and in this share of the time bins in which it was seen: a wall that a hand passes is a wall."""


@torch.no_grad()
def painted(model: Gaussians) -> Tensor:
    """bool [N]: Gaussians that have contributed to any training frame."""
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
    """How much Gaussians change over time, in units of what keeps them open; and their mean deltas.

    Args:
        rows: [M] who.
        moments: their deltas [M] at times spread over the clip.
        pixels: [M] pixels per scene unit where each is seen from nearest.
        seen: bool [T, M], moments at which a frame shows each Gaussian: elsewhere the field is arbitrary. A Gaussian
            that no moment shows is evaluated at all of them. None: all are shown.

    Returns:
        (change [M], mean deltas [M]): the largest departure from the mean over the moments at which each was seen.
    """
    moments = list(moments)
    counts = torch.ones(len(moments), len(rows), device=rows.device) if seen is None else seen.float()
    counts = torch.where(counts.sum(0) > 0, counts, 1.0)
    shares = counts / counts.sum(0)
    mean = Deltas(*(None if parts[0] is None else _weighted(shares, parts) for parts in zip(*moments, strict=True)))  # type: ignore[arg-type]
    opacity = model.params["opacity_logits"][rows]
    change = torch.zeros(len(rows), device=rows.device)
    for at, counted in zip(moments, counts, strict=True):
        departure = norm(at.means - mean.means, 1) * pixels / config.pixels
        if at.sh0 is not None and mean.sh0 is not None:
            departure = torch.maximum(departure, SH_C0 * (at.sh0 - mean.sh0).abs().amax((1, 2)) / config.color)
        if at.opacity_logits is not None and mean.opacity_logits is not None:
            now, usual = torch.sigmoid(opacity + at.opacity_logits), torch.sigmoid(opacity + mean.opacity_logits)
            departure = torch.maximum(departure, (now - usual).abs() / config.opacity)
        change = torch.maximum(change, torch.where(counted > 0, departure, 0.0))
    return change, mean


def _weighted(shares: Tensor, parts: tuple[Tensor, ...]) -> Tensor:
    """Sum of parts [T] of [M, ...] by shares [T, M]."""
    return torch.einsum("tm,tm...->m...", shares, torch.stack(parts))


@torch.no_grad()
def stays_open(
    model: Gaussians, rows: Tensor, change: Tensor, config: GateConfig, noise: float | None = None
) -> Tensor:
    """bool [M]: which of the open `rows` stay so, by their `change` [M] and that of their neighbours.

    `noise` stands for the configuration's.
    """
    noise = config.noise if noise is None else noise
    if len(rows) <= config.neighbours:
        return change > 1.0
    means = model.params["means"].detach()[rows].cpu().numpy()
    index = nearest_points(means, means, config.neighbours + 1)[1]
    nearest = from_numpy(np.ascontiguousarray(index)).to(rows.device)
    smooth = change[nearest].median(1).values
    stays = smooth > max(1.0, noise * float(change.quantile(0.25)))
    room = int(config.max_share * len(model))
    if int(stays.sum()) > room:
        kept = torch.where(stays, smooth, -torch.inf).topk(room).indices
        stays = torch.zeros_like(stays)
        stays[kept] = True
    return stays
