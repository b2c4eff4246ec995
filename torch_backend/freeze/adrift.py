"""Pieces of what moves that stand far before what they belong to are put back to it: half a hand, nearer than its arm.

How far away a thing is that moves while the camera does, no frame tells: a hand at rest far too near, and one that
waves at its arm, paint the same pictures, and the price on motion prefers the first. So half of a hand may stand at
two thirds of the distance of the other half, and float beside the arm in every view but that of t*. In the depth of
t*'s view such a piece is an island: all around it is much farther. An arm that reaches for the camera is none, it joins
its shoulder; an apple on a thread is one, but behind it moves nothing of its colour. What does, an island belongs to.
It goes there along the rays of t*'s camera, and grows as it goes: to that camera it looks the same. Where a
layer of plate t* covers it, it is taken out instead: `missing_layer` makes it anew of the plate's pixels, that deep.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..array_types import connected
from ..scene import Scene
from ..train import LoadedRun
from .frozen import FrozenGaussians, FrozenImage, fade
from .instant_bench import InstantBench, InstantConfig, Motion, grown, low_passed
from .instant_depth import weighted_median


@dataclass(frozen=True)
class AdriftConfig:
    """What counts as an island, and what it belongs to. Lengths are in pixels of pictures 320 wide."""

    near: float = 1.25
    """All around an island is at least so many times as far away, and what it belongs to is."""
    steady: float = 0.06
    """Depths of neighbouring pixels that differ by a smaller share are of one piece."""
    least: float = 12.0
    """Square pixels of a piece that is looked at,"""
    most: float = 0.03
    """and the largest share of the picture that one has."""
    rim: float = 1.0
    """Width of the rim in which depths of a piece and of what is behind it mix,"""
    ring: float = 3.0
    """and of the ring about it that is asked with the rim left out."""
    ahead: float = 0.12
    """Share of the ring that may be as near as the piece."""
    reach: float = 8.0
    """What a piece belongs to is seen through it, or at most so far beside it,"""
    alike: float = 0.15
    """in colours no farther from its own than about this (display-referred)."""
    held: float = 0.05
    """As many alike pixels must tell of what it belongs to, as a share of its own; and more by a half than those
    beside it that move as near as itself."""
    front: float = 0.02
    """It is put before that by this share."""
    rounds: int = 12
    """Most pieces that are put back: one may come to light behind another."""


@dataclass
class _Piece:
    """A piece of the picture of t*, at the size of the bench."""

    mask: NDArray[np.bool_]
    """[h, w]"""
    depth: float
    """Median, scene units."""
    rows: Tensor
    """int64 [M] the Gaussians that paint it."""
    belongs: float
    """Depth of what it belongs to, scene units."""


@dataclass
class Adrift:
    """What was adrift in a frozen scene."""

    put_back: FrozenGaussians
    """The scene with it at its place, as blurred as it was."""
    without: FrozenGaussians
    """The scene without it: plate t* has it, and sharper."""
    inverse: NDArray[np.float32]
    """[h, w] its inverse depth at its place, at the size of the bench; 0 elsewhere."""


@torch.no_grad()
def adrift(
    run: LoadedRun,
    scene: Scene,
    frozen: FrozenGaussians,
    t_star: float,
    motion: Motion | None = None,
    config: AdriftConfig | None = None,
) -> Adrift | None:
    """Pieces of a run's scene at t* that stand far before what they belong to; None if there are none.

    Args:
        frozen: the scene at t*, on any device.
        t_star: frame number; between two frames the nearer one's view is looked at.
        motion: motion mattes.
    """
    if not bool((frozen.motion > 0.5).any()):
        return None
    config = config or AdriftConfig()
    index = scene.nearest(t_star)
    bench = InstantBench(run, scene, index, InstantConfig(), motion)
    inverse, now = np.zeros((bench.height, bench.width), np.float32), frozen
    for _ in range(config.rounds):
        piece = _adrift(bench, now, inverse > 0.0, config)
        if piece is None:
            break
        place = piece.belongs / (1.0 + config.front)
        inverse[piece.mask] = 1.0 / place
        now = moved_along(bench, now, piece.rows, torch.full_like(piece.rows, place / piece.depth, dtype=torch.float32))
    if not inverse.any():
        return None
    now = moved_along(bench, now, *bench.veils(now, inverse > 0.0))
    stays = (now.state["means"] == frozen.state["means"]).all(1).float()
    return Adrift(now, fade(frozen, stays), inverse)


def _adrift(
    bench: InstantBench, frozen: FrozenGaussians, done: NDArray[np.bool_], config: AdriftConfig
) -> _Piece | None:
    """The nearest piece that is adrift, nothing of it `done` [h, w]; None if there is none."""
    image = bench.render(frozen)
    depth, motion = image.depth.numpy(), image.motion.numpy()
    labels = connected(np.log(np.maximum(depth, 1e-6)), config.steady)
    sizes = np.bincount(labels.ravel())
    moves = np.bincount(labels.ravel(), weights=motion.ravel())
    known = np.bincount(labels[done], minlength=len(sizes)) > 0
    edge = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    right = (sizes >= config.least * bench.unit**2) & (sizes <= config.most * labels.size) & (moves >= 0.5 * sizes)
    right &= ~known
    right[edge] = False  # what is around it is not known
    pieces = [(float(np.median(depth[labels == label])), labels == label) for label in np.nonzero(right)[0]]
    for near, mask in sorted(pieces, key=lambda piece: piece[0]):
        core, ring = _around(mask, bench.unit, config)
        if not ring.any() or (depth[ring] < config.near * near).mean() > config.ahead:
            continue
        piece = _Piece(mask, near, bench.painters(frozen, core, config.near * near), 0.0)
        piece = _belonging(bench, frozen, image, piece, config)
        if piece is not None:
            return piece
    return None


def _around(mask: NDArray[np.bool_], unit: float, config: AdriftConfig) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """A piece with its rim, and the ring about them, [h, w] each."""
    core = grown(mask, config.rim * unit)
    return core, grown(mask, config.ring * unit) & ~core


def _belonging(
    bench: InstantBench, frozen: FrozenGaussians, image: FrozenImage, piece: _Piece, config: AdriftConfig
) -> _Piece | None:
    """The piece with the depth of what it belongs to: what moves there without it, behind it, in its colours. None if
    too little does."""
    if not len(piece.rows):
        return None
    moves = frozen.motion > 0.5
    rows = piece.rows.to(moves.device)
    others, holds = (mask.index_fill(0, rows, value=False).float() for mask in (moves, ~moves))
    rest, still = bench.render(fade(frozen, others)), bench.render(fade(frozen, holds))
    core, _ = _around(piece.mask, bench.unit, config)
    about = grown(piece.mask, config.reach * bench.unit)
    behind, alpha, least = rest.depth.numpy(), rest.alpha.numpy(), config.near * piece.depth
    smooth = low_passed(bench.view.picture, bench.unit)
    through = rest.color.numpy() / np.maximum(alpha, 0.1)[..., None]
    color, shown = np.median(smooth[piece.mask], axis=0), np.where(core[..., None], through, smooth)
    alike = np.exp(-np.square(np.linalg.norm(shown - color, axis=-1) / config.alike))
    tells = about & (alpha > 0.3) & (behind * 1.02 < still.depth.numpy()) & (behind > least)
    weight = (alike * alpha)[tells]
    beside = about & ~core & (image.depth.numpy() < least) & (image.motion.numpy() > 0.5)
    enough = max(config.held * piece.mask.sum(), 8.0 * bench.unit**2, 1.5 * alike[beside].sum())
    if weight.sum() < enough:
        return None
    return replace(piece, belongs=1.0 / weighted_median(1.0 / behind[tells], weight.astype(np.float64)))


def moved_along(bench: InstantBench, frozen: FrozenGaussians, rows: Tensor, factor: Tensor) -> FrozenGaussians:
    """The scene with Gaussians `rows` int64 [M] `factor` [M] times as far from camera t*, and as large: to that camera
    the same."""
    state = dict(frozen.state)
    means, scales = state["means"].clone(), state["log_scales"].clone()
    rows, factor, view = rows.to(means.device), factor.to(means)[:, None], bench.scene.viewmats[bench.index].to(means)
    centre = -view[:3, :3].mT @ view[:3, 3]
    means[rows] = centre + factor * (means[rows] - centre)
    scales[rows] += factor.log()
    return replace(frozen, state={**state, "means": means, "log_scales": scales})
