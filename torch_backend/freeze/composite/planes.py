"""Fits planes to inverse depth: weighted least squares in a window around each pixel.

The inverse depth of a plane is affine in the image, so planes of the scene stay planes in these maps.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
"""Array of float32, if not stated otherwise."""


class Planes(NamedTuple):
    """Inverse depth around each pixel as a plane: value + along * (x - its column) + down * (y - its row)."""

    value: Array
    """[h, w] inverse depth at the window's centre."""
    along: Array
    """[h, w] change per pixel to the right."""
    down: Array
    """[h, w] change per pixel downwards."""
    chi: Array
    """[h, w] mean squared residual of the window's values, in units of their variance."""
    information: Array
    """[h, w] 1 / variance of `value`, if the window's values lie on a plane."""

    def fits(self, uneven: float) -> Array:
        """[h, w] in 0..1: how planar a window is; `uneven` is the scale of `chi` at which planarity falls off."""
        return np.square(np.square(uneven / (uneven + self.chi)))


def smoothed(values: Array, weight: Array, radii: Sequence[int], uneven: float) -> tuple[Array, Array]:
    """(inverse depth [h, w], its variance [h, w]): per pixel the mean plane of all windows that contain it.

    Planes are weighted by how well they fit. `values` [h, w] is inverse depth, `weight` [h, w] 1 / its variance.
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
    """Weighted least-squares planes of `values` [h, w] in the windows around all pixels.

    `weight` [h, w] is 1 / variance of the values. `radius` of the windows is in pixels.
    """
    rows, columns = grid_of(values.shape)
    near = weight.astype(np.float64)
    terms = [near * f for f in (1.0, columns, rows, columns**2, columns * rows, rows**2)]
    terms += [near * values * f for f in (1.0, columns, rows, values)]
    total, *moments = window_means(terms, radius)
    total = np.maximum(total, 1e-12)
    x, y, xx, xy, yy, v, vx, vy, vv = (moment / total for moment in moments)
    least = 1.0 / 12.0  # variance of positions within a pixel: keeps slopes finite if one pixel has all the weight
    xx, xy, yy = xx - x * x + least, xy - x * y, yy - y * y + least
    vx, vy, vv = vx - v * x, vy - v * y, vv - v * v
    determinant = xx * yy - xy * xy
    along, down = (yy * vx - xy * vy) / determinant, (xx * vy - xy * vx) / determinant
    chi = np.maximum(vv - along * vx - down * vy, 0.0) * total
    value = v + along * (columns - x) + down * (rows - y)
    return Planes(*(a.astype(np.float32) for a in (value, along, down, chi, total * (2 * radius + 1) ** 2)))


def grid_of(size: tuple[int, ...]) -> tuple[Array, Array]:
    """([h, 1] row, [1, w] column) coordinates relative to the image centre."""
    height, width = size
    return np.arange(height)[:, None] - 0.5 * height, np.arange(width)[None] - 0.5 * width


def window_means(terms: Sequence[Array], radius: int) -> list[Array]:
    """Means of each [h, w] over square windows of `radius` pixels; values outside the picture count as 0."""
    import cv2

    side = 2 * radius + 1, 2 * radius + 1
    return [cv2.blur(np.ascontiguousarray(term, np.float64), side, borderType=cv2.BORDER_CONSTANT) for term in terms]
