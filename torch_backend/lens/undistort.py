"""Catmull-Rom resampling of pictures through a map: with precomputed weights, or in bands to save memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..array_types import sparse_rows
from ..footage.display import Display

_TAPS = 4
_BAND = 64
"""Number of rows of a large picture processed at a time."""


class Undistorter:
    """Resamples pictures through a map by Catmull-Rom interpolation (exact where the map moves nothing).

    Holds one sparse matrix of 16 weights per pixel (128 bytes per pixel), which is ten times faster per frame than a
    general warp. Thread-safe.
    """

    def __init__(self, where: NDArray[np.float32]) -> None:
        """`where` is [H, W, 2]: x and y in input pixels, centres at +0.5. Outside of the input, the border repeats."""
        if where.ndim != 3 or where.shape[2] != 2:
            raise ValueError(f"the map should be [H, W, 2], got {where.shape}")
        self.height, self.width = where.shape[:2]
        columns, x_weights = _taps(where[..., 0].ravel(), self.width)
        rows, y_weights = _taps(where[..., 1].ravel(), self.height)
        count = self.height * self.width
        index = (rows[:, :, None] * np.int32(self.width) + columns[:, None, :]).reshape(-1)
        weights = (y_weights[:, :, None] * x_weights[:, None, :]).reshape(-1)
        starts = np.arange(count + 1, dtype=np.int64) * _TAPS**2
        if starts[-1] < np.iinfo(np.int32).max:
            starts = starts.astype(np.int32)
        self._matrix = sparse_rows(weights, index, starts, count)

    def __call__(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """Resamples a picture [H, W, 3] uint8 or uint16, same dtype. Raises ValueError if its size is not the map's."""
        if pixels.shape != (self.height, self.width, 3):
            raise ValueError(f"the picture is {pixels.shape}, the map {self.height}x{self.width}: their sizes differ")
        moved = self._matrix @ pixels.reshape(-1, 3).astype(np.float32)
        np.clip(np.rint(moved, out=moved), 0, np.iinfo(pixels.dtype).max, out=moved)
        return moved.astype(pixels.dtype).reshape(pixels.shape)


class BandUndistorter:
    """Like `Undistorter`, for pictures of any size and for unclipped floats. Uses 8 bytes per pixel.

    A Catmull-Rom curve is a linear interpolation of two samples, minus t (1 - t) / 2 times a linear interpolation of
    their second differences. This takes four bilinear look-ups per pixel, band by band.
    """

    def __init__(self, where: NDArray[np.float32]) -> None:
        """`where` as for `Undistorter`; its size is the size of the output."""
        if where.ndim != 3 or where.shape[2] != 2:
            raise ValueError(f"the map should be [H, W, 2], got {where.shape}")
        self._where = where

    def __call__(
        self,
        picture: NDArray[Any],
        read: Callable[[NDArray[Any]], NDArray[np.float32]],
        write: Callable[[NDArray[np.float32]], NDArray[Any]],
        out: NDArray[Any],
    ) -> NDArray[Any]:
        """Resamples `picture` [h, w, 3] into `out` [H, W, 3], and returns `out`.

        `read` converts rows of the picture to float32, black 0 and white 1. `write` converts such rows to the dtype of
        `out`.
        """
        for top in range(0, len(self._where), _BAND):
            band = slice(top, top + _BAND)
            out[band] = write(_band(picture, read, self._where[band]))
        return out


def of_frames(
    undistort: Undistorter, where: NDArray[np.float32], display: Display
) -> Callable[[NDArray[Any]], NDArray[Any]]:
    """A thread-safe function that undistorts working frames [H, W, 3].

    Returns `undistort`, which was built for `where`. If the display has a shoulder (see `footage.display`), returns a
    `BandUndistorter` in sRGB instead, in which highlights do not ring.
    """
    if not display.bends:
        return undistort
    bands = BandUndistorter(where)
    return lambda pixels: bands(pixels, display.srgb_of, display.codes, np.empty(pixels.shape, np.uint16))


def _band(
    picture: NDArray[Any], read: Callable[[NDArray[Any]], NDArray[np.float32]], where: NDArray[np.float32]
) -> NDArray[np.float32]:
    """One band of the output, [h, W, 3] float32, for the same rows of the map."""
    height, width = picture.shape[:2]
    x = np.clip(where[..., 0] - np.float32(0.5), -1.0, width)
    y = np.clip(where[..., 1] - np.float32(0.5), -1.0, height)
    first = int(np.floor(y.min()))
    needed = np.arange(first - 1, int(np.floor(y.max())) + 3)
    rows = read(picture[max(0, int(needed[0])) : int(needed[-1]) + 1])
    rows = rows[needed.clip(0, height - 1) - max(0, int(needed[0]))]
    rows = np.pad(rows, ((0, 0), (2, 2), (0, 0)), mode="edge")
    x, y = x + np.float32(1.0), y - np.float32(first)  # to coordinates of `inner` below
    bend_x, bend_y = _bend(x), _bend(y)

    def sample(inner: NDArray[np.float32]) -> NDArray[np.float32]:
        smooth = cv2.remap(np.ascontiguousarray(inner), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(smooth, np.float32)

    # Clipped, or a lamp of fifty times white would get a black ring.
    core = np.clip(rows, 0.0, 1.0)
    across = _second_difference(core.swapaxes(0, 1)).swapaxes(0, 1)
    both, down = _second_difference(across), _second_difference(core)[:, 1:-1]
    result = sample(rows[1:-1, 1:-1])
    result -= bend_x * sample(across[1:-1])
    result -= bend_y * (sample(down) - bend_x * sample(both))
    return result


def _bend(at: NDArray[np.float32]) -> NDArray[np.float32]:
    """t (1 - t) / 2 for the fractional part t of coordinates, [h, W, 1]."""
    t = at - np.floor(at)
    t -= t * t
    t *= 0.5
    return t[..., None].astype(np.float32, copy=False)


def _second_difference(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    """Second differences [n - 2, ...] of rows [n, ...]."""
    return np.asarray(rows[:-2] - (rows[1:-1] + rows[1:-1]) + rows[2:], np.float32)


def _taps(at: NDArray[np.float32], size: int) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Indices and Catmull-Rom weights [P, 4] of the pixels around coordinates `at` [P] (centres at +0.5)."""
    position = at.astype(np.float64) - 0.5
    base = np.floor(position)
    t = (position - base)[:, None]
    weights = 0.5 * np.concatenate(
        [
            -t + 2 * t**2 - t**3,
            2 - 5 * t**2 + 3 * t**3,
            t + 4 * t**2 - 3 * t**3,
            -(t**2) + t**3,
        ],
        axis=1,
    )
    index = base[:, None] + np.arange(-1, 3)
    return np.clip(index, 0, size - 1).astype(np.int32), weights.astype(np.float32)
