"""Evidence from appearance: whether a surface point looks in one frame as it looks at other times of the clip.

A surface that stands still shows the same colours whenever it is in view. Each pixel is therefore given a depth and
looked up in other frames, and the differences are counted in units of noise. Two depths are tried, and the pixel stands
still if either explains it:

- the depth that a static model of the clip has there. What is compared is the frame less the model's render, so that
  a place where the model is blurred or wrong is so in all frames and cancels out.
- the depth at which the pixel's matches meet (`still`). There colours are compared.

This finds what optical flow misses: things too small or too fast to track, arms before a plain wall, and things that
stand elsewhere at other times. Maps are on the grid of `flow`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .flow import FlowConfig, Map, Mask, sample
from .still import FEW, Ray, inside

_SMOOTH = 0.7
"""Standard deviation in grid points of the low-pass before comparison: a lookup is off by a fraction of a point."""
_SPARSE = 4
"""Stride of the grid on which the offset and the noise of two frames are measured."""


@dataclass(frozen=True)
class StaticView:
    """What a static model of the clip shows from the camera of a frame."""

    colors: NDArray[np.uint8]
    """[h, w, 3] as the working frames are, of any size."""
    depth: NDArray[np.float32]
    """[h, w] along the camera's axis, solve units."""


@dataclass(frozen=True)
class Sight:
    """A frame on the grid, and its camera."""

    colors: NDArray[np.uint8]
    """[h, w, 3]."""
    viewmat: NDArray[np.float64]
    """[4, 4] world-to-camera, solve units."""
    K: NDArray[np.float64]
    """[3, 3] in flow pixels."""


class Appearance:
    """A frame prepared for lookups."""

    def __init__(self, sight: Sight, static: StaticView) -> None:
        """`static` is what the model shows from the frame's camera."""
        size = sight.colors.shape[1::-1]
        how = cv2.INTER_AREA if size[0] < static.colors.shape[1] else cv2.INTER_LINEAR
        self.sight = sight
        self.colors = _smoothed(sight.colors)
        """[h, w, 3] low-passed."""
        self.residual: Map = self.colors - _smoothed(
            np.asarray(cv2.resize(static.colors, size, interpolation=how), np.uint8)
        )
        """[h, w, 3] the frame less the static model's render."""
        self.depth = np.asarray(cv2.resize(static.depth, size, interpolation=cv2.INTER_NEAREST), np.float32)
        """[h, w] of the static model, solve units."""

    def changed(self, grid: tuple[Map, Map], others: Sequence[Appearance], inverse: Map, config: FlowConfig) -> Map:
        """[h, w] float32, at least 0: log of the share of lookups over the share of them that agree.

        A lookup agrees by a Cauchy kernel of its mean square difference over 3 x 3 points, in units of noise. One more
        that agrees is added, so that a surface which no other frame shows has 0. The less of the two depths counts.

        Args:
            grid: positions of the grid's points in flow pixels.
            others: the frames in which the surfaces are looked up.
            inverse: [h, w] inverse depths of the still points that explain the matches best, 1 / solve units.
        """
        gradient = sum(np.square(cv2.Sobel(self.colors, cv2.CV_32F, *axes, scale=0.125)) for axes in ((1, 0), (0, 1)))
        noise = config.sensor**2 + np.mean(gradient, axis=-1) * config.misplaced**2
        inverses = 1.0 / self.depth, np.asarray(cv2.medianBlur(inverse, 3))
        agreed, seen = np.ones((2, 2, *inverse.shape), np.float32)
        for other in others:
            modelled, visible = self._apart(grid, other, inverses[0], noise, config, of_model=True)
            sparse = modelled[::_SPARSE, ::_SPARSE][visible[::_SPARSE, ::_SPARSE]]
            if len(sparse) < FEW:
                continue
            # Compression, blur and exposure differ from pair to pair: half of the picture is noise at least.
            level = max(1.0, float(np.median(sparse)))
            matched = self._apart(grid, other, inverses[1], noise, config, of_model=False)
            for n, (unlike, where) in enumerate(((modelled, visible), matched)):
                agreed[n] += where / (1.0 + unlike / level)
                seen[n] += where
        return np.min(np.log(seen / agreed), axis=0)

    def _apart(
        self, grid: tuple[Map, Map], other: Appearance, inverse: Map, noise: Map, config: FlowConfig, of_model: bool
    ) -> tuple[Map, Mask]:
        """Mean square difference of points at inverse depths in units of `noise`, and which are seen: [h, w] each."""
        ray = Ray(grid, (self.sight.viewmat, other.sight.viewmat), (self.sight.K, other.sight.K))
        at, over = ray.project(inverse)
        x, y = (np.float32(0.5) * (p - np.float32(1.0)) for p in at)
        nearest = cv2.remap(other.depth, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        visible = inside(at, inverse.shape) & (nearest * inverse * over > config.hides)
        one, two = (self.residual, other.residual) if of_model else (self.colors, other.colors)
        apart = one - sample(two, at)
        sparse = apart[::_SPARSE, ::_SPARSE][visible[::_SPARSE, ::_SPARSE]]
        if len(sparse) >= FEW:
            apart -= np.median(sparse, axis=0)  # exposure drifts in a clip
        square = np.asarray(np.mean(apart * apart, axis=-1), np.float32)
        return np.asarray(cv2.blur(square, (3, 3)), np.float32) / noise, np.asarray(visible, np.bool_)


def _smoothed(colors: NDArray[np.uint8]) -> Map:
    return np.asarray(cv2.GaussianBlur(colors.astype(np.float32), (0, 0), _SMOOTH))
