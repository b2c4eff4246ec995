"""Specks that float before what moves are put back to it.

A hand that waves leaves faint Gaussians on trial where it might be, some of them far before it. To camera t* they are a
light on its knuckles; from elsewhere they are streaks beside a chin. `adrift` looks for pieces that are solid, which
they are not. No solid part of what moves is as near as they are, here or around: they go to the nearest that is, along
the rays of t*'s camera, and grow as they go, so that camera sees the same. Those far before it, and those that would
come near another camera, would be veils there, and are taken out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from ..scene import Scene
from ..train import LoadedRun
from .adrift import moved_along
from .frozen import FrozenGaussians, fade
from .instant_bench import InstantBench, InstantConfig, disc


@dataclass(frozen=True)
class SpecksConfig:
    """What counts as a speck."""

    near: float = 1.1
    """All that is solid around it is at least so many times as far away."""
    veil: float = 1.5
    """Beyond this it is taken out,"""
    beside: float = 0.3
    """and if another camera would see it from a smaller share of its distance from t*'s."""
    small: float = 8.0
    """Largest standard deviation of a speck, in pixels of pictures 320 wide, as t* sees it."""
    around: float = 5.0
    """Pixels of pictures 320 wide that are asked about a speck."""
    solid: float = 0.5
    """Alpha of what moves, drawn alone, from which on it is solid."""


@torch.no_grad()
def without_specks(
    run: LoadedRun, scene: Scene, frozen: FrozenGaussians, t_star: float, config: SpecksConfig | None = None
) -> FrozenGaussians:
    """A run's scene at t* with its specks put back, or taken out.

    Args:
        frozen: the scene at t*, on any device.
        t_star: frame number; between two frames the nearer one's view is looked at.
    """
    import cv2

    config, moves = config or SpecksConfig(), frozen.motion > 0.5
    if not bool(moves.any()):
        return frozen
    index = scene.nearest(t_star)
    bench = InstantBench(run, scene, index, InstantConfig(), None)
    alone = bench.render(fade(frozen, moves.float()))
    nowhere = 1e9
    solid = np.where(alone.alpha.numpy() > config.solid, alone.depth.numpy(), nowhere).astype(np.float32)
    nearest = np.asarray(cv2.erode(solid, disc(config.around * bench.unit), borderValue=nowhere), np.float32)
    known = (nearest < nowhere).astype(np.float32)
    log_depth = np.log(np.maximum(nearest, 1e-6)) * known
    whole, told, log_sum = bench.gathered(frozen, np.ones_like(known), known, log_depth).unbind(1)
    depths = bench.depths(frozen).clamp_min(1e-6)
    factor = (log_sum / told.clamp_min(1e-6)).exp() / depths
    pixels = frozen.state["log_scales"].amax(1).exp().cpu() / depths * bench.Ks[index, 0, 0]
    specks = (whole > 1e-3) & (told > 0.5 * whole) & (factor > config.near) & moves.cpu()
    specks &= pixels < config.small * bench.unit
    rows = torch.nonzero(specks).flatten()
    if not len(rows):
        return frozen
    moved = moved_along(bench, frozen, rows, factor[rows])
    centres = scene.camera_centres()
    close = torch.cdist(moved.state["means"].cpu()[rows], centres).amin(1)
    veils = (factor[rows] > config.veil) | (close < config.beside * (factor * depths)[rows])
    return fade(moved, torch.ones_like(factor).index_fill(0, rows[veils], 0.0))
