"""Measures the plate's grain and draws the same grain on frozen frames, which would look like stills without it.

Grain is measured on undistorted working frames, display-referred, per channel and brightness. A quadratic polynomial
is fitted to each block of the picture. Where a block shows a flat surface, the fit's residual is grain. Flat blocks are
found iteratively: the blocks that vary least give a first estimate of the grain, and blocks are added as long as grain
alone explains their variance. The fit also removes some grain, more of soft grain than of sharp grain. The projection
gives the removed share, and the measured deviation is corrected for it.

Grain is drawn as Gaussian noise with the measured softness and correlation between channels. Its deviation depends on
each pixel's brightness. The frame number is the seed.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...footage.display import PLAIN, Display
from ...footage.images import read_frame
from ...kernel_text import kernel_text
from ...native import INTEGER, POINTER, Snippet
from ...scene import evenly_spaced

BINS = 8
"""Number of brightness levels at which grain is measured."""
SAMPLED = 8
"""Number of frames of a clip that are measured."""
_BLOCK = 16
_FEWEST = 12
"""Number of flat blocks below which a level or a channel is not trusted."""
_LEAST = 0.05
"""Share of a level's blocks, those with the lowest variance, that start the search for flat blocks."""
_OUTLIER = 3.0
"""Outlier threshold. A block's variance may exceed the mean by this many standard deviations, and a level's deviation
may be this many times the median of all levels. Beyond that, the picture's texture is taken to be the cause."""
_MOST = 0.08
"""Deviation, display-referred, above which a level is always rejected as texture."""
_KERNEL = Path(__file__).with_name("kernels") / "grain.cpp"
_SOFTNESS = np.arange(0.0, 2.01, 0.05)


@dataclass(frozen=True, eq=False)
class Grain:
    """Statistics of a plate's grain. Brightness and deviations are display-referred, 0 to 1."""

    deviation: NDArray[np.float32]
    """[3, BINS] standard deviation per channel at the middles of `BINS` equal levels of that channel's brightness."""
    softness: float
    """Sigma in pixels of the Gaussian blur that makes white noise look like the grain; 0: no blur."""
    correlation: NDArray[np.float32]
    """[3, 3] correlation between the channels; 1 on the diagonal."""

    @classmethod
    def none(cls) -> Grain:
        """Grain of a clean plate: zero."""
        return cls(np.zeros((3, BINS), np.float32), 0.0, np.eye(3, dtype=np.float32))

    def to_json(self) -> dict[str, Any]:
        """Values for take.json; deviations are in 8-bit steps, which artists know."""
        return {
            "deviation_8bit": np.round(self.deviation * 255.0, 3).tolist(),
            "softness_px": round(self.softness, 2),
            "correlation": np.round(self.correlation, 3).tolist(),
        }


def measure_plate(files: Sequence[Path], display: Display) -> Grain:
    """Grain of a plate from up to `SAMPLED` evenly spaced PNG frames. JobError if a frame cannot be read.

    Frames of every `display` are converted to sRGB and clipped at white. A shoulder compresses grain to almost nothing,
    and grain extrapolated there from darker levels would be many times too strong.
    """
    picked = evenly_spaced(len(files), SAMPLED)
    frames = [read_frame(files[i]) for i in picked]
    return measure([PLAIN.codes(display.srgb_of(frame)) for frame in frames] if display.bends else frames)


def measure(frames: Sequence[NDArray[Any]]) -> Grain:
    """Grain of frames [H, W, 3], uint8 or uint16, display-referred. `Grain.none()` if no block is flat."""
    found = [_blocks(frame) for frame in frames if min(frame.shape[:2]) >= _BLOCK]
    if not found:
        return Grain.none()
    residual, mean, usable = (np.concatenate(parts) for parts in zip(*found, strict=True))
    # Quantisation noise is not part of the grain, because writing the frozen frame adds it again.
    step = 1.0 / (255.0 if frames[0].dtype == np.uint8 else 65535.0)
    variance = np.einsum("nci,nci->nc", residual, residual) / _BLOCK**2
    level = np.minimum((mean * BINS).astype(int), BINS - 1)
    softness, flat = 0.0, np.zeros_like(usable)
    for _ in range(2):  # flat blocks and softness depend on each other a little
        flat = np.zeros_like(usable)
        for c in range(3):
            for k in range(BINS):
                blocks = np.flatnonzero(usable[:, c] & (level[:, c] == k))
                flat[blocks, c] = _only_grain(variance[blocks, c], softness)
        softness = _softness(residual, flat & (variance > 2.0 * step**2 / 12.0))
    share = _kept(softness)[0]
    deviation: NDArray[Any] = np.full((3, BINS), np.nan)
    for c in range(3):
        for k in range(BINS):
            chosen = variance[flat[:, c] & (level[:, c] == k), c]
            if len(chosen) >= _FEWEST:
                deviation[c, k] = np.sqrt(
                    max(0.0, (np.median(chosen) / _median_ratio(softness) - step**2 / 12.0) / share)
                )
    curve = _filled_curve(deviation)
    return (
        Grain(curve, softness, _agreement(residual, flat[:, 0] & flat[:, 1] & flat[:, 2]))
        if curve.any()
        else Grain.none()
    )


def draw(grain: Grain, frame: int, rgba: NDArray[Any], size: tuple[int, int]) -> NDArray[np.float32]:
    """Grain to add to a frozen frame.

    Args:
        grain: statistics of the plate's grain.
        frame: frame number, used as the seed. The grain is reproducible and differs between frames.
        rgba: [H, W, 4] the frozen frame, display-referred, premultiplied.
        size: width and height of the plate in pixels. Grain is drawn at that size, then resized to the frame.

    Returns:
        [H, W, 3] scene-linear, premultiplied by the frame's alpha. Its mean is 0 except where black or white clips it.
    """
    rgba = np.asarray(rgba, np.float32)
    brush = Brush(grain, frame, rgba.shape[:2], size)
    return brush.rows(slice(0, len(rgba)), rgba[..., :3], rgba[..., 3], np.ones(rgba.shape[:2], np.float32))


class Brush:
    """`draw` for some rows at a time, to save memory on large pictures."""

    def __init__(self, grain: Grain, frame: int, shape: tuple[int, ...], size: tuple[int, int]) -> None:
        """`shape` is [H, W] of the whole picture; the rest as for `draw`."""
        self._deviation, self._shape = np.ascontiguousarray(grain.deviation, np.float32), shape
        self._noise = _noise(grain, frame, size) if grain.deviation.any() else None
        for axis in (0, 1):
            if self._noise is not None and self._noise.shape[axis] > shape[axis]:
                self._noise = _shrunk(self._noise, axis, shape[axis])

    def rows(
        self, rows: slice, color: NDArray[Any], alpha: NDArray[Any], share: NDArray[Any], is_light: bool = False
    ) -> NDArray[np.float32]:
        """Grain of some rows of the picture, as from `draw`.

        Args:
            rows: the rows.
            color: [h, W, 3] their colour, premultiplied: display-referred, or scene-linear with `is_light`.
            alpha: [h, W] their alpha.
            share: [h, W] factor for the grain.

        Returns:
            [h, W, 3] scene-linear, premultiplied.
        """
        if self._noise is None:
            return np.zeros(color.shape, np.float32)
        color, alpha, share, noise = (np.ascontiguousarray(a, np.float32) for a in (color, alpha, share, self._noise))
        out, shoulder = np.empty_like(color), np.zeros(2, np.float32)
        _snippet().run(
            color=color.ctypes.data, alpha=alpha.ctypes.data, share=share.ctypes.data, noise=noise.ctypes.data,
            curve=self._deviation.ctypes.data, out=out.ctypes.data, shoulder=shoulder.ctypes.data,
            height=color.shape[0], width=color.shape[1], noise_height=noise.shape[0], noise_width=noise.shape[1],
            top=rows.start, whole=self._shape[0], is_light=is_light, bends=0,
        )  # fmt: skip
        return out


@functools.cache
def _snippet() -> Snippet:
    pointers = ("color", "alpha", "share", "noise", "curve", "out", "shoulder")
    sizes = ("height", "width", "noise_height", "noise_width", "top", "whole", "is_light", "bends")
    fields = {**dict.fromkeys(pointers, POINTER), **dict.fromkeys(sizes, INTEGER)}
    return Snippet("grain", fields, kernel_text(_KERNEL).replace("@BINS@", str(BINS)))


def warm_up() -> None:
    """Compiles the kernel, or loads it from the cache. Call this from the main thread."""
    _snippet().warm_up()


def _noise(grain: Grain, frame: int, size: tuple[int, int]) -> NDArray[np.float32]:
    """[height, width, 3] noise of unit deviation with the softness and channel correlation of the grain."""
    width, height = size
    kernel = _kernel(grain.softness)
    reach = len(kernel) // 2
    generator = np.random.default_rng(frame % 2**32)
    white = generator.standard_normal((height + 2 * reach, width + 2 * reach, 3), dtype=np.float32)
    soft = cv2.sepFilter2D(white, -1, kernel, kernel)[reach : reach + height, reach : reach + width]
    values, axes = np.linalg.eigh(grain.correlation.astype(np.float64))
    root = (axes * np.sqrt(np.maximum(values, 0.0))) @ axes.T
    return np.asarray(soft.reshape(-1, 3) @ root.astype(np.float32), np.float32).reshape(height, width, 3)


def _shrunk(noise: NDArray[np.float32], axis: int, length: int) -> NDArray[np.float32]:
    """`noise` averaged to fewer pixels along an axis."""
    before = noise.shape[axis]
    # Differences of the integral at the edges of the new pixels are exact means.
    total = np.concatenate([np.zeros_like(noise.take([0], axis)), np.cumsum(noise, axis, dtype=np.float64)], axis)
    at = np.asarray(np.linspace(0.0, before, length + 1), np.float64)
    low = np.minimum(at.astype(int), before - 1)
    share = (at - low).reshape([-1 if n == axis else 1 for n in range(3)])
    edges = total.take(low, axis) * (1.0 - share) + total.take(low + 1, axis) * share
    return np.asarray(np.diff(edges, axis=axis) * (length / before), np.float32)


def _kernel(softness: float) -> NDArray[np.float32]:
    """Blur kernel along one axis that keeps the deviation of white noise; a single 1 for softness 0."""
    reach = int(np.ceil(3.0 * softness))
    x = np.arange(-reach, reach + 1)
    weights = np.exp(-0.5 * (x / softness) ** 2) if softness > 0.0 else np.ones(1)
    return (weights / np.sqrt((weights**2).sum())).astype(np.float32)


@functools.lru_cache(maxsize=1)
def _basis() -> NDArray[np.float64]:
    """[block pixels, 6] orthonormal basis of the quadratic polynomials over a block."""
    y, x = np.mgrid[-1.0 : 1.0 : _BLOCK * 1j, -1.0 : 1.0 : _BLOCK * 1j]
    columns = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1).reshape(-1, 6)
    return np.linalg.qr(columns)[0]


def _blocks(frame: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Per block: residual [n, 3, pixels], mean [n, 3], and bool [n, 3], True if no pixel is clipped."""
    rows, columns = frame.shape[0] // _BLOCK, frame.shape[1] // _BLOCK
    values = frame[: rows * _BLOCK, : columns * _BLOCK].astype(np.float32)
    values /= 255.0 if frame.dtype == np.uint8 else 65535.0
    blocks = values.reshape(rows, _BLOCK, columns, _BLOCK, 3).transpose(0, 2, 4, 1, 3).reshape(-1, 3, _BLOCK**2)
    basis = _basis().astype(np.float32)
    is_unclipped = np.asarray(((blocks > 0.0) & (blocks < 1.0)).all(axis=2), np.bool_)
    residual = np.asarray(blocks - (blocks @ basis) @ basis.T, np.float32)
    return residual, blocks.mean(axis=2), is_unclipped


@functools.lru_cache(maxsize=64)
def _kept(softness: float) -> tuple[float, float, tuple[float, ...]]:
    """Statistics of the fit's residual for grain of deviation 1: (variance, degrees of freedom, correlation at
    `_LAGS`)."""
    kernel = _kernel(softness).astype(np.float64)
    full = np.convolve(kernel, kernel[::-1])
    along = np.zeros(2 * _BLOCK - 1)
    middle, reach = _BLOCK - 1, len(kernel) - 1
    along[middle - reach : middle + reach + 1] = full
    index = np.arange(_BLOCK)
    line = along[index[:, None] - index[None, :] + middle]
    covariance = np.kron(line, line)
    basis = _basis()
    covariance = covariance - basis @ (basis.T @ covariance)
    covariance = covariance - (covariance @ basis) @ basis.T
    trace = np.trace(covariance)
    squares = covariance.reshape(_BLOCK, _BLOCK, _BLOCK, _BLOCK)
    lags = [_lag_mean(squares, dy, dx) * _BLOCK**2 / trace for dy, dx in _LAGS]
    return float(trace / _BLOCK**2), float(trace**2 / (covariance**2).sum()), tuple(float(v) for v in lags)


_LAGS = ((0, 1), (1, 0), (1, 1), (0, 2), (2, 0))


def _lag_mean(covariance: NDArray[Any], dy: int, dx: int) -> float:
    y, x = np.mgrid[0 : _BLOCK - dy, 0 : _BLOCK - dx]
    return float(covariance[y, x, y + dy, x + dx].mean())


def _median_ratio(softness: float) -> float:
    """Median over mean of a grain block's variance, which is chi-squared distributed (Wilson and Hilferty)."""
    return float((1.0 - 2.0 / (9.0 * _kept(softness)[1])) ** 3)


def _only_grain(variance: NDArray[Any], softness: float) -> NDArray[np.bool_]:
    """bool [n]: blocks of one level whose variance [n] grain alone explains, grown from those of lowest variance."""
    if len(variance) < _FEWEST:
        return np.zeros(len(variance), bool)
    most = 1.0 + _OUTLIER * np.sqrt(2.0 / _kept(softness)[1])  # relative to the mean, approximated by the median
    chosen = variance <= np.quantile(variance, _LEAST)
    while True:
        more = variance <= most * float(np.median(variance[chosen]))
        if more.sum() <= chosen.sum():
            return chosen
        chosen = more


def _softness(residual: NDArray[np.float32], flat: NDArray[np.bool_]) -> float:
    """The value of `_SOFTNESS` that best explains the autocorrelation of flat blocks at `_LAGS`."""
    # Only green is used, the most visible channel: chroma is softer in most footage.
    chosen = residual[flat[:, 1], 1].reshape(-1, _BLOCK, _BLOCK)
    if len(chosen) < _FEWEST:
        return 0.0
    power = np.mean(chosen**2, axis=(1, 2))
    like = power < _OUTLIER**2 * np.median(power)  # rejects levels without flat blocks
    chosen, power = chosen[like], power[like]
    seen: list[float] = []
    for dy, dx in _LAGS:
        block, shifted = chosen[:, : _BLOCK - dy, : _BLOCK - dx], chosen[:, dy:, dx:]
        seen.append(float(np.median(np.mean(block * shifted, axis=(1, 2)) / power)))
    errors = [np.abs(np.array(_kept(float(s))[2]) - seen).sum() for s in _SOFTNESS]
    return float(_SOFTNESS[int(np.argmin(errors))])


def _filled_curve(deviation: NDArray[Any]) -> NDArray[np.float32]:
    """[3, BINS] deviation with NaN (too few blocks) interpolated and outlier levels replaced.

    A level at which the clip shows no flat surface is measured too high; grain varies smoothly with brightness.
    """
    typical = np.nanmedian(deviation) if not np.isnan(deviation).all() else 0.0
    known = deviation <= min(_MOST, _OUTLIER * typical)
    curve = np.zeros_like(deviation)
    for c in range(3):
        if known[c].any():
            at = np.flatnonzero(known[c])
            values = deviation[c, at]
            padded = np.concatenate([values[:1], values, values[-1:]])
            curve[c] = np.interp(np.arange(BINS), at, np.median(np.stack([padded[:-2], values, padded[2:]]), axis=0))
        else:
            curve[c] = np.nan
    if np.isnan(curve).all():
        return np.zeros((3, BINS), np.float32)
    # A channel without measurements (all black, for example) takes the mean of the others.
    return np.where(np.isnan(curve), np.nanmean(curve, axis=0), curve).astype(np.float32)


def _agreement(residual: NDArray[np.float32], flat: NDArray[np.bool_]) -> NDArray[np.float32]:
    """[3, 3] correlation between the channels over blocks that are flat in all three."""
    chosen = residual[flat]
    power = np.einsum("nci,nci->nc", chosen, chosen)
    chosen = chosen[(power > 0.0).all(axis=1)]
    if len(chosen) < _FEWEST:
        return np.eye(3, dtype=np.float32)
    product = np.einsum("nci,ndi->ncd", chosen, chosen)
    root = np.sqrt(np.einsum("ncc->nc", product))
    return np.median(product / (root[:, :, None] * root[:, None, :]), axis=0).astype(np.float32)
