"""What was otherwise until a moment, or since one, though no matte calls it moving: a head that turned while the camera
swept past.

The run takes it for still, and has a mixture of both at any time. A frame's own plate would stay, and so time would not
stand still. But of the plates that see such a place all until one moment show one thing, and all from then on another.
What merely looks otherwise from elsewhere, a sheen or an edge at a wrong depth, changes by and by.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from ..scene import Scene, evenly_spaced
from ..torch_types import from_numpy
from ..train import LoadedRun
from .contradicted import ContradictedConfig, difference_at
from .frozen import ALWAYS, FrozenGaussians, Turned
from .instant_bench import InstantBench, InstantConfig, Motion, large, low_passed
from .reproject import inside, project


@dataclass(frozen=True)
class TurnedConfig:
    """When a place was otherwise. Lengths are in pixels of pictures 320 wide, differences display-referred."""

    width: int = 320
    """Plates are compared at this width, at most."""
    frames: int = 48
    """Solved frames that are asked, at most, evenly over the clip,"""
    sees: float = 0.05
    """if they see more than this share of plate t*."""
    same: float = 0.06
    """Up to this difference from plate t* a plate shows the same,"""
    other: float = 0.12
    """and from this on something else."""
    share: float = 0.9
    """Of the plates that see a place on either side of the moment so many at least say so:"""
    spell: int = 8
    """of so many that were asked, on the far side: later it may have been otherwise again;"""
    least: tuple[int, int] = (2, 4)
    """and so many at least see it: on this side, plate t* among them, and on the far side."""
    gap: int = 2
    """The last that shows the same and the first that shows something else are so far apart at most, of those asked."""
    scale: float = 2.0
    """Times as far or as near as from t*'s camera a plate may see a place: a fold of a shirt is none from afar."""
    area: float = 50.0
    """Square pixels; smaller places are left alone."""
    seen: ContradictedConfig = field(default_factory=ContradictedConfig)
    """How plates are compared."""


@torch.no_grad()
def turned(
    run: LoadedRun,
    scene: Scene,
    frozen: FrozenGaussians,
    t_star: int,
    motion: Motion,
    config: TurnedConfig | None = None,
    check: Callable[[], None] | None = None,
) -> Turned | None:
    """What of a scene frozen at frame `t_star` was otherwise before or after; None if nothing, or without mattes.

    Args:
        motion: as in `InstantBench`.
        check: called between plates; raises to cancel.
    """
    config = config or TurnedConfig()
    index = scene.frames.index(t_star)
    bench = InstantBench(run, scene, index, InstantConfig(), motion, min(scene.width, config.width))
    moves = bench.matte()
    if moves is None:
        return None
    image, grid = bench.render(frozen), bench.view.grid()
    depth = image.depth.numpy().astype(np.float64)
    places = from_numpy(bench.view.unproject(grid[..., 0], grid[..., 1], depth)).float()
    own = low_passed(bench.view.picture, config.seen.blur * bench.unit)
    asked = sorted({scene.solved[n] for n in evenly_spaced(len(scene.solved), config.frames)} | {index})
    off = np.full((len(asked), *depth.shape), np.nan, np.float32)
    moving = (moves > 0.5) | (image.motion.numpy() > 0.5)
    if bench.ignored is not None:
        moving |= bench.ignored
    for n, i in enumerate(asked):
        if check is not None:
            check()
        if i == index:
            off[n] = 0.0
            continue
        pixels, away = project(places, scene.viewmats[i], bench.Ks[i])
        times = away.numpy() / depth
        known = (times < config.scale) & (times * config.scale > 1.0)
        known &= inside(pixels, bench.width, bench.height).numpy() > 0.0
        found = bench.frame(i) if known.mean() > config.sees else None
        if found is not None:
            off[n], moves_there = difference_at(bench, *found, places, own, config.seen)
            off[n][~known] = np.nan
            moving |= moves_there
    at = asked.index(index)
    frames = np.array([scene.frames[i] for i in asked], np.int32)
    first, before = _switch(off[at::-1], frames[at::-1], config)
    last, after = _switch(off[at:], frames[at:], config)
    before, after = (_solid(found & ~moving, bench.unit, config) for found in (before, after))
    if not (before.any() or after.any()):
        return None
    return Turned(from_numpy(np.where(before, first, 0)), from_numpy(np.where(after, last, ALWAYS)))


def _switch(
    off: NDArray[np.float32], frames: NDArray[np.int32], config: TurnedConfig
) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """([h, w] the last frame that shows the same, [h, w] where one is the last), going from t* in one direction.

    `off` [F, h, w] from plate t*, NaN where a plate does not see a place; `frames` [F] their numbers; t* first.
    """
    seen = np.isfinite(off)
    filled = np.nan_to_num(off)
    of = seen, seen & (filled < config.same), seen & (filled > config.other)
    known, same, other = (each.cumsum(0, dtype=np.int16) for each in of)
    index, never = np.arange(len(off), dtype=np.int16)[:, None, None], np.int16(2 * len(off))
    following = np.minimum.accumulate(np.where(seen, index, never)[::-1], axis=0)[::-1]
    following = np.concatenate([following[1:], np.full_like(following[:1], never)])
    end = np.minimum(following + config.spell - 1, len(off) - 1)
    beyond, others = (np.take_along_axis(each, end, axis=0) - each for each in (known, other))
    sure = np.minimum(same / np.maximum(known, 1), others / np.maximum(beyond, 1))
    sure[~seen | (known < config.least[0]) | (beyond < config.least[1]) | (following - index > config.gap)] = 0.0
    best = sure.argmax(axis=0)
    return frames[best], np.take_along_axis(sure, best[None], axis=0)[0] >= config.share


def _solid(mask: NDArray[np.bool_], unit: float, config: TurnedConfig) -> NDArray[np.bool_]:
    """Of a mask [h, w] the regions that are large enough, without what is thin."""
    import cv2

    side = 2 * max(1, round(unit)) + 1
    opened = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((side, side), np.uint8))
    regions = np.asarray(opened > 0, np.bool_)
    return large(regions, regions, config.area * unit**2)
