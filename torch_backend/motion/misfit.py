"""What moves though no flow says so: a frame shows something unlike the world at rest.

Dense flow smooths an arm before a wall, or an apple on a thread, into the motion of the wall. Two pictures tell what is
there at rest: what a static model of the clip shows, and the median of other frames along the still surface. Each errs
in its own places, the model at far skylines, the median at outlines, so a pixel is as unlike as the smaller of both
differences says.
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

_BEHIND = 19.0
"""`Ray.project` returns 20 times the inverse depth for points at or behind a camera."""
_SPARSE = 4
"""Points from one that brightness is fitted to, to the next, in rows and columns."""


@dataclass(frozen=True)
class MisfitConfig:
    """What counts as unlike the world at rest. Chosen on tuning scenes `arm` 0, 1, 2 and `swinging` 0."""

    sigma: float = 4.0
    """Sigma of the low-pass of differences, in pixels of a picture 640 wide."""
    usual: float = 0.9
    """Quantile of a frame's differences that is their unit. With the median, thresholds of equally many false pixels
    differ by a factor of 1.9 between tuning scenes, with this by 1.5."""
    weak: float = 1.3
    """Misfit, in that unit, down to which an area extends that moves."""
    strong: float = 3.0
    """Misfit that a pixel of the area has to reach. Lit edges of hasty frames reach 3, movers 5; with 2 lamps were
    torn."""
    references: int = 13
    """Key frames of the clip, evenly spaced, whose median is taken."""
    fewest: int = 5
    """References that have to have a surface in their picture. With 2 the rim of a clip's view is called moving, where
    a model has little to learn from either: `arm` 0 then loses 1.2 dB where nothing moves."""


@dataclass(frozen=True)
class Sight:
    """A frame and its camera."""

    colors: NDArray[np.uint8]
    """[h, w, 3] on the grid of half the flow's pixels."""
    viewmat: NDArray[np.float64]
    """[4, 4] world-to-camera, solve units."""
    K: NDArray[np.float64]
    """[3, 3] in flow pixels."""


def misfit(
    frame: Sight, inverse: Map, shown: NDArray[np.uint8], references: Sequence[Sight], grid: tuple[Map, Map],
    unit: float, config: MisfitConfig,
) -> Map:  # fmt: skip
    """[h, w] float32 how unlike the world at rest a frame is, in units of what `usual` of the frame stays below.

    Args:
        inverse: [h, w] inverse depths of the frame's still points, in 1 / solve units.
        shown: [h, w, 3] what a static model of the clip shows at the frame's camera.
        references: other frames; pixels that too few of them have in their picture read 0.
        grid: positions of the grid's points in flow pixels.
        unit: points of the grid to one pixel of a picture 640 wide.
    """
    median, number = _median(frame, inverse, references, grid)
    gaps: list[Map] = [np.max(np.abs(frame.colors - np.asarray(each, np.float32)), axis=-1) for each in (shown, median)]
    from_model, from_others = (cv2.GaussianBlur(gap, (0, 0), config.sigma * unit) for gap in gaps)
    gap = np.where(number >= config.fewest, np.minimum(from_model, from_others), np.float32(0.0))
    return gap / np.float32(max(float(np.quantile(gap, config.usual)), 1.0))


def _median(frame: Sight, inverse: Map, others: Sequence[Sight], grid: tuple[Map, Map]) -> tuple[Map, NDArray[Any]]:
    """([h, w, 3] median of the others along the frame's still surfaces, [h, w] how many have those in their picture).

    Others are brought to the frame's brightness. Where none has a surface in its picture it is the frame itself.
    """
    colors = frame.colors.astype(np.float32)
    brought: list[Map] = []
    for other in others:
        picture, visible = _carried(frame, inverse, other, grid)
        few = np.zeros_like(visible)
        few[::_SPARSE, ::_SPARSE] = visible[::_SPARSE, ::_SPARSE]
        for c in range(3):
            factor, offset = fitted_brightness(colors[..., c][few], picture[..., c][few])
            picture[..., c] = factor * picture[..., c] + offset
        brought.append(np.where(visible[..., None], picture, np.float32(np.nan)))
    if not brought:
        return colors, np.zeros(inverse.shape, np.int64)
    stack = np.sort(np.stack(brought), axis=0)  # NaN, outside, comes last
    number = np.count_nonzero(~np.isnan(stack[..., 0]), axis=0)
    middle = np.take_along_axis(stack, np.maximum(number - 1, 0)[None, ..., None] // 2, axis=0)[0]
    return np.where(number[..., None] > 0, middle, colors), number


def _carried(frame: Sight, inverse: Map, other: Sight, grid: tuple[Map, Map]) -> tuple[Map, Mask]:
    """([h, w, 3] float32 another frame's colours at this frame's still points, [h, w] which are in its picture)."""
    at, over = Ray(grid, (frame.viewmat, other.viewmat), (frame.K, other.K)).project(inverse)
    x, y = (np.clip(0.5 * p - 0.5, -1e4, 1e4).astype(np.float32) for p in at)
    height, width = inverse.shape
    inside = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1) & (over < _BEHIND)
    colors = cv2.remap(other.colors.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return colors, inside


def seeded(mask: Mask, seeds: Mask, least: int) -> Mask:
    """The 4-connected areas of a mask that hold a seed and at least this many points."""
    count, numbers, about, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    numbers = np.asarray(numbers, np.int32)
    keep = about[:, cv2.CC_STAT_AREA] >= least
    keep[0] = False
    held = np.zeros(count, bool)
    held[np.unique(numbers[seeds & mask])] = True
    return (keep & held)[numbers]
