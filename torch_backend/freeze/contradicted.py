"""What of plate t* is not where the frozen scene has it: other plates see that place, and something else is there.

A run may explain a hand that waves by painting it onto the wall behind, in colours that t*'s camera alone sees. Plate
and render agree then, and from the side the hand is a smear on the wall. But other plates see that place on the wall,
in which nothing moves there. Where most of them show another colour than plate t*, its hand is not there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ..scene import evenly_spaced
from ..torch_types import from_numpy
from .frozen import FrozenImage
from .instant_bench import InstantBench, low_passed
from .instant_depth import View
from .reproject import project


@dataclass(frozen=True)
class ContradictedConfig:
    """When other plates speak against a place. Lengths are in pixels of pictures 320 wide."""

    frames: int = 24
    """Frames that are asked, at most, evenly over the clip."""
    least: int = 3
    """So many at least have to see a place."""
    surface: float = 0.05
    """A frame sees a place if what it shows there is as far away, to this share."""
    blur: float = 1.0
    """Standard deviation of the low-pass before colours are compared."""
    shift: float = 1.0
    """Places may be off by this in other plates."""
    differs: float = 0.12
    """Colours farther apart than this are of different things (display-referred, the greatest of the channels)."""


def contradicted(
    bench: InstantBench, image: FrozenImage, config: ContradictedConfig | None = None
) -> NDArray[np.bool_]:
    """bool [h, w]: where most plates that see what t*'s camera sees of a frozen scene show other colours than plate t*.

    Args:
        image: the scene frozen at t*, `bench.render`.
    """
    config = config or ContradictedConfig()
    grid, depth = bench.view.grid(), image.depth.numpy().astype(np.float64)
    places = from_numpy(bench.view.unproject(grid[..., 0], grid[..., 1], depth)).float()
    own = low_passed(bench.view.picture, config.blur * bench.unit)
    sees, differs = np.zeros((2, *depth.shape), np.int32)
    for index in evenly_spaced(len(bench.scene.frames), config.frames):
        found = None if index == bench.index else bench.frame(index)
        if found is not None:
            off, moving = difference_at(bench, *found, places, own, config)
            off[moving] = np.nan
            sees, differs = sees + np.isfinite(off), differs + (np.nan_to_num(off) > config.differs)
    return np.asarray((sees >= config.least) & (2 * differs > sees), np.bool_)


def difference_at(
    bench: InstantBench, other: View, moving: NDArray[np.bool_], places: Tensor, own: NDArray[np.float32],
    config: ContradictedConfig,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:  # fmt: skip
    """Difference [h, w] between `own` colours [h, w, 3] and those of another plate, in which `moving` [h, w] moves, at
    `places` [h, w, 3], which t*'s camera sees; NaN where that plate does not see them. And bool [h, w]: where something
    that moves is seen in it."""
    import cv2

    pixels, depth = project(places, bench.scene.viewmats[other.index], bench.Ks[other.index])
    at, away = pixels.numpy() - np.float32(0.5), depth.numpy()

    def there(values: NDArray[np.float32], how: int) -> NDArray[np.float32]:
        return np.asarray(cv2.remap(values, at[..., 0], at[..., 1], how, borderMode=cv2.BORDER_CONSTANT), np.float32)

    then = bench.at_its_time(other.index)
    moves = ((then.motion.numpy() >= 0.5) | moving).astype(np.float32)
    shown = there(then.depth.numpy().astype(np.float32), cv2.INTER_NEAREST)
    seen = (away > 0.0) & (np.abs(shown - away) < config.surface * away)
    picture = bench.as_exposed(low_passed(other.picture, config.blur * bench.unit), other.index)
    side = 2 * max(1, round(config.shift * bench.unit)) + 1
    around = np.ones((side, side), np.uint8)
    most = there(np.asarray(cv2.dilate(picture, around), np.float32), cv2.INTER_LINEAR)
    least = there(np.asarray(cv2.erode(picture, around), np.float32), cv2.INTER_LINEAR)
    off = np.maximum(np.maximum(own - most, least - own).max(axis=-1), 0.0)
    moved = seen & (there(moves, cv2.INTER_NEAREST) > 0.5)
    return np.where(seen, off, np.float32(np.nan)).astype(np.float32), np.asarray(moved, np.bool_)
