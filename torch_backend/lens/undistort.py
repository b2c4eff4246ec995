"""Resampling pictures through a map, by Catmull-Rom: with weights computed once, or in little memory."""

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
"""Rows of a large picture that are made at a time."""


class Undistorter:
    """Takes each output pixel from where it lies in the input, by Catmull-Rom (exact where nothing moves).

    Holds one sparse matrix of 16 weights per pixel (128 bytes per pixel), which is ten times faster per frame than a
    general warp. Safe to use from several threads.
    """

    def __init__(self, where: NDArray[np.float32]) -> None:
        """`where` is [H, W, 2]: x and y in input pixels, centres at +0.5. Outside of the input its border is taken."""
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
        """[H, W, 3] uint8 or uint16 to the same. ValueError if the size is not the map's."""
        if pixels.shape != (self.height, self.width, 3):
            raise ValueError(f"the picture is {pixels.shape}, the map {self.height}x{self.width}: their sizes differ")
        moved = self._matrix @ pixels.reshape(-1, 3).astype(np.float32)
        np.clip(np.rint(moved, out=moved), 0, np.iinfo(pixels.dtype).max, out=moved)
        return moved.astype(pixels.dtype).reshape(pixels.shape)


class BandUndistorter:
    """What `Undistorter` does, for pictures of any size and values: 8 bytes per pixel, and floats that nothing cuts.

    A Catmull-Rom curve is the straight line between two samples less t (1 - t) / 2 times the line between their second
    differences: four bilinear look-ups a pixel, band by band. What lies below black and above white is left to the
    straight line, or a lamp of fifty times white would wear a black ring.
    """

    def __init__(self, where: NDArray[np.float32]) -> None:
        """`where` as for `Undistorter`, of any size: the output's."""
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
        """Fills `out` [H, W, 3] from `picture` [h, w, 3], and returns it.

        `read` turns rows of the picture to float32, black 0 and white 1; `write` such rows to what `out` holds.
        """
        for top in range(0, len(self._where), _BAND):
            band = slice(top, top + _BAND)
            out[band] = write(_band(picture, read, self._where[band]))
        return out


def of_frames(
    undistort: Undistorter, where: NDArray[np.float32], display: Display
) -> Callable[[NDArray[Any]], NDArray[Any]]:
    """What takes the lens out of working frames [H, W, 3] of a display: `undistort`, which is for `where`, or where the
    display has a shoulder a way on which highlights do not ring (see `footage.display`). Safe for several threads."""
    if not display.bends:
        return undistort
    bands = BandUndistorter(where)
    return lambda pixels: bands(pixels, display.srgb_of, display.codes, np.empty(pixels.shape, np.uint16))


def _band(
    picture: NDArray[Any], read: Callable[[NDArray[Any]], NDArray[np.float32]], where: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Some rows of the output, [h, W, 3] float32."""
    height, width = picture.shape[:2]
    x = np.clip(where[..., 0] - np.float32(0.5), -1.0, width)
    y = np.clip(where[..., 1] - np.float32(0.5), -1.0, height)
    first = int(np.floor(y.min()))
    needed = np.arange(first - 1, int(np.floor(y.max())) + 3)
    rows = read(picture[max(0, int(needed[0])) : int(needed[-1]) + 1])
    rows = rows[needed.clip(0, height - 1) - max(0, int(needed[0]))]
    rows = np.pad(rows, ((0, 0), (2, 2), (0, 0)), mode="edge")
    x, y = x + np.float32(1.0), y - np.float32(first)  # as `inner` below counts
    bend_x, bend_y = _bend(x), _bend(y)

    def sample(inner: NDArray[np.float32]) -> NDArray[np.float32]:
        smooth = cv2.remap(np.ascontiguousarray(inner), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(smooth, np.float32)

    core = np.clip(rows, 0.0, 1.0)
    across = _second_difference(core.swapaxes(0, 1)).swapaxes(0, 1)
    both, down = _second_difference(across), _second_difference(core)[:, 1:-1]
    result = sample(rows[1:-1, 1:-1])
    result -= bend_x * sample(across[1:-1])
    result -= bend_y * (sample(down) - bend_x * sample(both))
    return result


def _bend(at: NDArray[np.float32]) -> NDArray[np.float32]:
    """[h, W, 1]: t (1 - t) / 2 of the fractions of coordinates."""
    t = at - np.floor(at)
    t -= t * t
    t *= 0.5
    return t[..., None].astype(np.float32, copy=False)


def _second_difference(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    """[n, ...] to [n - 2, ...]."""
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
