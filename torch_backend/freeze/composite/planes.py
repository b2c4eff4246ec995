"""Inverse depth as planes: weighted least squares in a window around each pixel.

Inverse depth of a plane is affine in the image, so planes of the scene stay planes here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
"""float32 unless it says otherwise."""


class Planes(NamedTuple):
    """Inverse depth around each pixel as a plane: value + along * (x - its column) + down * (y - its row)."""

    value: Array
    """[h, w] at the window's middle."""
    along: Array
    """[h, w] change per pixel to the right."""
    down: Array
    """[h, w] change per pixel downwards."""
    chi: Array
    """[h, w] mean square of what the window's values are off the plane, in their variances."""
    information: Array
    """[h, w] 1 / variance of the value, if the window's values are a plane."""

    def fits(self, uneven: float) -> Array:
        """[h, w] in 0..1: how well a window is a plane; `uneven` is a `chi` that is no fault."""
        return np.square(np.square(uneven / (uneven + self.chi)))


def smoothed(values: Array, weight: Array, radii: Sequence[int], uneven: float) -> tuple[Array, Array]:
    """(inverse depth [h, w], variance [h, w]) of the planes of all windows that hold a pixel, those that fit.

    `values` [h, w] is inverse depth, `weight` [h, w] 1 / its variance.
    """
    rows, columns = grid_of(values.shape)

    def weighted(radius: int) -> list[Array]:
        planes = fit_planes(values, weight, radius)
        fit = np.maximum(planes.fits(uneven) * planes.information, 1e-20)
        offset = planes.value - planes.along * columns - planes.down * rows
        spread = (1.0 + planes.chi) / planes.information
        return window_means([fit, fit * offset, fit * planes.along, fit * planes.down, fit * spread], radius)

    total, level, along, down, variance = np.sum([weighted(radius) for radius in radii], axis=0)
    return (level + along * columns + down * rows) / total, variance / total


def fit_planes(values: Array, weight: Array, radius: int) -> Planes:
    """The planes that fit `values` [h, w], weighted by 1 / their variance [h, w], in the windows around all pixels."""
    rows, columns = grid_of(values.shape)
    near = weight.astype(np.float64)
    terms = [near * f for f in (1.0, columns, rows, columns**2, columns * rows, rows**2)]
    terms += [near * values * f for f in (1.0, columns, rows, values)]
    total, *moments = window_means(terms, radius)
    total = np.maximum(total, 1e-12)
    x, y, xx, xy, yy, v, vx, vy, vv = (moment / total for moment in moments)
    least = 1.0 / 12.0  # the variance within a pixel: slopes stay finite where all the weight lies in one
    xx, xy, yy = xx - x * x + least, xy - x * y, yy - y * y + least
    vx, vy, vv = vx - v * x, vy - v * y, vv - v * v
    determinant = xx * yy - xy * xy
    along, down = (yy * vx - xy * vy) / determinant, (xx * vy - xy * vx) / determinant
    chi = np.maximum(vv - along * vx - down * vy, 0.0) * total
    value = v + along * (columns - x) + down * (rows - y)
    return Planes(*(a.astype(np.float32) for a in (value, along, down, chi, total * (2 * radius + 1) ** 2)))


def grid_of(size: tuple[int, ...]) -> tuple[Array, Array]:
    """([h, 1] rows, [1, w] columns), counted from the middle."""
    height, width = size
    return np.arange(height)[:, None] - 0.5 * height, np.arange(width)[None] - 0.5 * width


def window_means(terms: Sequence[Array], radius: int) -> list[Array]:
    """Each [h, w] averaged over windows; what is beyond the picture counts as 0."""
    import cv2

    side = 2 * radius + 1, 2 * radius + 1
    return [cv2.blur(np.ascontiguousarray(term, np.float64), side, borderType=cv2.BORDER_CONSTANT) for term in terms]
