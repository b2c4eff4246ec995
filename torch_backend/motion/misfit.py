"""Misfit: detects movers that optical flow misses, as differences between a frame and the static scene.

Dense flow smooths a thin mover, such as an arm in front of a wall or an apple on a thread, into the motion of the wall.
Two pictures predict the static scene: the render of a static model of the clip, and the median of other frames along
the still surface. The misfit of a pixel is the smaller of both differences.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .flow import Map, Mask
from .still import Ray, fitted_brightness

# Depth ratio of `Ray.project` above which a point counts as behind the other camera; the ratio is clamped to 20.
_BEHIND = 19.0
_SPARSE = 4
"""Stride in rows and columns of the points to which brightness is fitted."""


@dataclass(frozen=True)
class MisfitConfig:
    """Thresholds of the misfit. Tuned on scenes `arm` 0, 1, 2 and `swinging` 0."""

    sigma: float = 4.0
    """Sigma of the low-pass of differences, in pixels of a picture 640 wide."""
    usual: float = 0.9
    """Quantile of a frame's differences that serves as unit of the misfit. Thresholds with equally many false pixels
    differ between tuning scenes by a factor of 1.5 with this quantile, of 1.9 with the median."""
    weak: float = 1.3
    """Misfit, in units of `usual`, down to which a moving area extends."""
    strong: float = 3.0
    """Misfit that one pixel of a moving area must reach. Bright edges in frames with fast camera motion reach 3, movers
    5; with a threshold of 2, lamps were partly labelled as moving."""
    references: int = 13
    """Number of key frames, evenly spaced over the clip, whose median is taken."""
    fewest: int = 5
    """Number of references that must show a surface. With 2, the rim of the clip's view is labelled as moving, because
    the static model has little data there: `arm` 0 then loses 1.2 dB in its still regions."""


@dataclass(frozen=True)
class Sight:
    """A frame and its camera."""

    colors: NDArray[np.uint8]
    """[h, w, 3] on the grid of half the flow's pixels."""
    viewmat: NDArray[np.float64]
    """[4, 4] world-to-camera, solve units."""
    K: NDArray[np.float64]
    """[3, 3] intrinsics in flow pixels."""


def misfit(
    frame: Sight, inverse: Map, shown: NDArray[np.uint8], references: Sequence[Sight], grid: tuple[Map, Map],
    unit: float, config: MisfitConfig,
) -> Map:  # fmt: skip
    """[h, w] float32 difference of a frame from the static scene, in units of its quantile `config.usual`.

    Args:
        inverse: [h, w] inverse depths of the frame's still points, in 1 / solve units.
        shown: [h, w, 3] render of a static model of the clip at the frame's camera.
        references: other frames; the misfit is 0 at pixels that too few of them show.
        grid: positions of the grid's points in flow pixels.
        unit: grid points per pixel of a picture 640 wide.
    """
    median, number = _median(frame, inverse, references, grid)
    gaps: list[Map] = [np.max(np.abs(frame.colors - np.asarray(each, np.float32)), axis=-1) for each in (shown, median)]
    from_model, from_views = (cv2.GaussianBlur(gap, (0, 0), config.sigma * unit) for gap in gaps)
    # The smaller difference: the model errs at far skylines, the median at outlines.
    gap = np.where(number >= config.fewest, np.minimum(from_model, from_views), np.float32(0.0))
    return gap / np.float32(max(float(np.quantile(gap, config.usual)), 1.0))


def _median(frame: Sight, inverse: Map, views: Sequence[Sight], grid: tuple[Map, Map]) -> tuple[Map, NDArray[Any]]:
    """([h, w, 3] median of the others along the frame's still surfaces, [h, w] number of others that show the surface).

    The others' brightness is fitted to the frame's. Where none shows the surface, the median is the frame itself.
    """
    colors = frame.colors.astype(np.float32)
    brought: list[Map] = []
    for view in views:
        picture, visible = _carried(frame, inverse, view, grid)
        sample = np.zeros_like(visible)
        sample[::_SPARSE, ::_SPARSE] = visible[::_SPARSE, ::_SPARSE]
        for c in range(3):
            factor, offset = fitted_brightness(colors[..., c][sample], picture[..., c][sample])
            picture[..., c] = factor * picture[..., c] + offset
        brought.append(np.where(visible[..., None], picture, np.float32(np.nan)))
    if not brought:
        return colors, np.zeros(inverse.shape, np.int64)
    stack = np.sort(np.stack(brought), axis=0)  # sorts NaN, the invisible pixels, to the end
    number = np.count_nonzero(~np.isnan(stack[..., 0]), axis=0)
    middle = np.take_along_axis(stack, np.maximum(number - 1, 0)[None, ..., None] // 2, axis=0)[0]
    return np.where(number[..., None] > 0, middle, colors), number


def _carried(frame: Sight, inverse: Map, view: Sight, grid: tuple[Map, Map]) -> tuple[Map, Mask]:
    """([h, w, 3] float32 colours of `view` at this frame's still points, [h, w] which points `view` shows)."""
    at, over = Ray(grid, (frame.viewmat, view.viewmat), (frame.K, view.K)).project(inverse)
    x, y = (np.clip(0.5 * p - 0.5, -1e4, 1e4).astype(np.float32) for p in at)
    height, width = inverse.shape
    inside = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1) & (over < _BEHIND)
    colors = cv2.remap(view.colors.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return colors, inside


def seeded(mask: Mask, seeds: Mask, least: int) -> Mask:
    """The 4-connected areas of a mask that contain a seed and at least `least` points."""
    count, numbers, about, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    numbers = np.asarray(numbers, np.int32)
    keep = about[:, cv2.CC_STAT_AREA] >= least
    keep[0] = False
    has_seed = np.zeros(count, bool)
    has_seed[np.unique(numbers[seeds & mask])] = True
    return (keep & has_seed)[numbers]
