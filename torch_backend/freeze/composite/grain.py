"""Grain: how much the plate has, and the same for frozen frames, which have none and look like a still beside it.

Measured on the plate as it is mixed with (undistorted working frames), display-referred, per channel and brightness:
a block of the picture minus the parabola that fits it is grain where the block shows something flat. Which blocks are
flat is found from below: the least deviating ones tell how much grain there is at least, and blocks join as long as
grain alone could explain them. The fit also takes grain away, more of a soft one than of a sharp one; since the
projection is known, so is how much, and what is told is corrected for it.

Drawn as Gaussian noise with that deviation at every pixel's own brightness, that softness, and that agreement between
the channels; the frame's number is the seed.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...footage.color import srgb_to_linear
from ...footage.display import PLAIN, Display
from ...footage.images import read_frame
from ...scene import evenly_spaced

BINS = 8
"""Brightness levels that grain is measured at."""
SAMPLED = 8
"""Frames of a clip that are measured."""
_BLOCK = 16
_FEWEST = 12
"""Blocks that a level or a channel needs to be trusted."""
_LEAST = 0.05
"""Share of the blocks of a level, the least varying ones, that are taken for grain to begin with."""
_STANDS_OUT = 3.0
"""Standard deviations from which on a block, and times the deviation of most from which on a level, show no grain but
what is in the picture."""
_MOST = 0.08
"""So does one with this deviation, whatever the others have."""
_SOFTNESS = np.arange(0.0, 2.01, 0.05)


@dataclass(frozen=True, eq=False)
class Grain:
    """What a plate's grain looks like. Brightness and deviations are display-referred, 0 to 1."""

    deviation: NDArray[np.float32]
    """[3, BINS] standard deviation per channel at the middles of `BINS` equal levels of that channel's brightness."""
    softness: float
    """Deviation in pixels of the Gaussian that white noise is blurred with to look like it; 0: none."""
    correlation: NDArray[np.float32]
    """[3, 3] between the channels; 1 on the diagonal."""

    @classmethod
    def none(cls) -> Grain:
        """That of a clean plate."""
        return cls(np.zeros((3, BINS), np.float32), 0.0, np.eye(3, dtype=np.float32))

    def to_json(self) -> dict[str, Any]:
        """For take.json; deviations in 8-bit steps, which people know."""
        return {
            "deviation_8bit": np.round(self.deviation * 255.0, 3).tolist(),
            "softness_px": round(self.softness, 2),
            "correlation": np.round(self.correlation, 3).tolist(),
        }


def measure_plate(files: Sequence[Path], display: Display) -> Grain:
    """Grain of a plate from up to `SAMPLED` of its PNG frames, spread over it. JobError if one cannot be read.

    Measured on sRGB, cut at white, whatever `display` they are in: on a shoulder the same grain is next to nothing, and
    what is guessed from darker levels would be many times too much.
    """
    picked = evenly_spaced(len(files), SAMPLED)
    frames = [read_frame(files[i]) for i in picked]
    return measure([PLAIN.codes(display.srgb_of(frame)) for frame in frames] if display.bends else frames)


def measure(frames: Sequence[NDArray[Any]]) -> Grain:
    """Grain of frames [H, W, 3], uint8 or uint16, display-referred. None where nothing flat is to be seen."""
    found = [_blocks(frame) for frame in frames if min(frame.shape[:2]) >= _BLOCK]
    if not found:
        return Grain.none()
    residual, mean, usable = (np.concatenate(parts) for parts in zip(*found, strict=True))
    # Quantisation noise is not the plate's grain: the frozen frame gets its own when it is rounded.
    step = 1.0 / (255.0 if frames[0].dtype == np.uint8 else 65535.0)
    variance = np.einsum("nci,nci->nc", residual, residual) / _BLOCK**2
    level = np.minimum((mean * BINS).astype(int), BINS - 1)
    softness, flat = 0.0, np.zeros_like(usable)
    for _ in range(2):  # which blocks are flat depends on the softness a little, and the other way round
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
    curve = _whole_curve(deviation)
    return (
        Grain(curve, softness, _agreement(residual, flat[:, 0] & flat[:, 1] & flat[:, 2]))
        if curve.any()
        else Grain.none()
    )


def draw(grain: Grain, frame: int, rgba: NDArray[Any], size: tuple[int, int]) -> NDArray[np.float32]:
    """The grain of the plate, to be added to a frozen frame.

    Args:
        grain: the plate's.
        frame: frame number, the seed: the same grain whenever it is drawn, another one on every frame.
        rgba: [H, W, 4] display-referred, premultiplied, as splats blend.
        size: width and height of the plate in pixels: grain is drawn there and brought to the frame's size with it.

    Returns:
        [H, W, 3] scene-linear, premultiplied like the picture; its mean is 0 but for what black and white cut off.
    """
    brush = Brush(grain, frame, rgba.shape[:2], size)
    return brush.rows(slice(0, len(rgba)), rgba)


class Brush:
    """`draw` for some rows at a time: of a picture that would be large as a whole."""

    def __init__(self, grain: Grain, frame: int, shape: tuple[int, ...], size: tuple[int, int]) -> None:
        """`shape` is [H, W] of the whole picture; the rest as for `draw`."""
        self._grain, (self._height, self._width) = grain, shape
        self._noise = _noise(grain, frame, size) if grain.deviation.any() else None
        if self._noise is not None and self._noise.shape[0] > self._height:
            self._noise = _resized(self._noise, 0, self._height)

    def rows(self, rows: slice, rgba: NDArray[Any]) -> NDArray[np.float32]:
        """[h, W, 3] as `draw`, of `rgba` [h, W, 4]: these rows of the picture."""
        if self._noise is None:
            return np.zeros((*rgba.shape[:2], 3), np.float32)
        noise = _resized(self._noise, 0, self._height, rows)
        noise = _resized(noise, 1, self._width)
        alpha = rgba[..., 3:4]
        color = np.clip(rgba[..., :3] / np.where(alpha > 0.0, alpha, 1.0), 0.0, 1.0).astype(np.float32)
        middles = (np.arange(BINS) + 0.5) / BINS
        deviation = self._grain.deviation
        curves = [np.asarray(np.interp(color[..., c], middles, deviation[c]), np.float64) for c in range(3)]
        response = np.stack(curves, axis=-1)
        grainy = np.clip(color + response * noise, 0.0, 1.0)
        return ((srgb_to_linear(grainy) - srgb_to_linear(color)) * alpha).astype(np.float32)


def _noise(grain: Grain, frame: int, size: tuple[int, int]) -> NDArray[np.float32]:
    """[height, width, 3] of unit deviation, as soft and as alike between channels as the grain."""
    width, height = size
    kernel = _kernel(grain.softness)
    reach = len(kernel) // 2
    generator = np.random.default_rng(frame % 2**32)
    white = generator.standard_normal((height + 2 * reach, width + 2 * reach, 3), dtype=np.float32)
    rows = np.sum([w * white[i : i + height] for i, w in enumerate(kernel)], axis=0)
    soft = np.sum([w * rows[:, i : i + width] for i, w in enumerate(kernel)], axis=0)
    values, axes = np.linalg.eigh(grain.correlation.astype(np.float64))
    root = (axes * np.sqrt(np.maximum(values, 0.0))) @ axes.T
    return np.asarray(soft @ root.astype(np.float32), np.float32)


def _resized(noise: NDArray[np.float32], axis: int, length: int, part: slice = slice(None)) -> NDArray[np.float32]:
    """`noise` with `length` pixels along an axis, or a part: averaged where it shrinks, blended where it grows."""
    before = noise.shape[axis]
    along = [-1 if n == axis else 1 for n in range(3)]
    if before == length:
        return noise[part] if axis == 0 else noise[:, part]
    if length > before:
        at = (np.arange(length, dtype=np.float64)[part] + 0.5) * before / length - 0.5
        at = np.asarray(np.clip(at, 0.0, before - 1.0), np.float64)
        low = np.minimum(at.astype(int), max(before - 2, 0))
        share = (at - low).reshape(along).astype(np.float32)
        blended = noise.take(low, axis) * (1.0 - share) + noise.take(np.minimum(low + 1, before - 1), axis) * share
        return np.asarray(blended, np.float32)
    # Integral along the axis, read at the edges of the new pixels: exact means over them.
    total = np.concatenate([np.zeros_like(noise.take([0], axis)), np.cumsum(noise, axis, dtype=np.float64)], axis)
    at = np.asarray(np.linspace(0.0, before, length + 1), np.float64)
    low = np.minimum(at.astype(int), before - 1)
    share = (at - low).reshape(along)
    edges = total.take(low, axis) * (1.0 - share) + total.take(low + 1, axis) * share
    shrunk = np.asarray(np.diff(edges, axis=axis) * (length / before), np.float32)
    return shrunk[part] if axis == 0 else shrunk[:, part]


def _kernel(softness: float) -> NDArray[np.float32]:
    """Blur along one axis that keeps the deviation of white noise; a single 1 for softness 0."""
    reach = int(np.ceil(3.0 * softness))
    x = np.arange(-reach, reach + 1)
    weights = np.exp(-0.5 * (x / softness) ** 2) if softness > 0.0 else np.ones(1)
    return (weights / np.sqrt((weights**2).sum())).astype(np.float32)


@functools.lru_cache(maxsize=1)
def _basis() -> NDArray[np.float64]:
    """[block pixels, 6] orthonormal: what a parabola over a block can be."""
    y, x = np.mgrid[-1.0 : 1.0 : _BLOCK * 1j, -1.0 : 1.0 : _BLOCK * 1j]
    columns = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1).reshape(-1, 6)
    return np.linalg.qr(columns)[0]


def _blocks(frame: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Of every block: residual [n, 3, pixels], mean [n, 3], and whether none of it is clipped [n, 3]."""
    rows, columns = frame.shape[0] // _BLOCK, frame.shape[1] // _BLOCK
    values = frame[: rows * _BLOCK, : columns * _BLOCK].astype(np.float32)
    values /= 255.0 if frame.dtype == np.uint8 else 65535.0
    blocks = values.reshape(rows, _BLOCK, columns, _BLOCK, 3).transpose(0, 2, 4, 1, 3).reshape(-1, 3, _BLOCK**2)
    basis = _basis().astype(np.float32)
    whole = np.asarray(((blocks > 0.0) & (blocks < 1.0)).all(axis=2), np.bool_)
    residual = np.asarray(blocks - (blocks @ basis) @ basis.T, np.float32)
    return residual, blocks.mean(axis=2), whole


@functools.lru_cache(maxsize=64)
def _kept(softness: float) -> tuple[float, float, tuple[float, ...]]:
    """What the fit leaves of grain of deviation 1: (variance, degrees of freedom, correlation at `_LAGS`)."""
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
    """Median over mean of the variance of a block of grain: that of chi squared (Wilson and Hilferty)."""
    return float((1.0 - 2.0 / (9.0 * _kept(softness)[1])) ** 3)


def _only_grain(variance: NDArray[Any], softness: float) -> NDArray[np.bool_]:
    """Which blocks of one level vary no more than grain does, found from the least varying upwards."""
    if len(variance) < _FEWEST:
        return np.zeros(len(variance), bool)
    most = 1.0 + _STANDS_OUT * np.sqrt(2.0 / _kept(softness)[1])  # in units of their mean, which their median is near
    chosen = variance <= np.quantile(variance, _LEAST)
    while True:
        more = variance <= most * float(np.median(variance[chosen]))
        if more.sum() <= chosen.sum():
            return chosen
        chosen = more


def _softness(residual: NDArray[np.float32], flat: NDArray[np.bool_]) -> float:
    """Which of `_SOFTNESS` explains how flat blocks agree with themselves a pixel or two away."""
    # The channel that is seen best: chroma is softer in most footage, but the eye reads grain from green.
    chosen = residual[flat[:, 1], 1].reshape(-1, _BLOCK, _BLOCK)
    if len(chosen) < _FEWEST:
        return 0.0
    power = np.mean(chosen**2, axis=(1, 2))
    like = power < _STANDS_OUT**2 * np.median(power)  # levels without anything flat
    chosen, power = chosen[like], power[like]
    seen: list[float] = []
    for dy, dx in _LAGS:
        one, other = chosen[:, : _BLOCK - dy, : _BLOCK - dx], chosen[:, dy:, dx:]
        seen.append(float(np.median(np.mean(one * other, axis=(1, 2)) / power)))
    errors = [np.abs(np.array(_kept(float(s))[2]) - seen).sum() for s in _SOFTNESS]
    return float(_SOFTNESS[int(np.argmin(errors))])


def _whole_curve(deviation: NDArray[Any]) -> NDArray[np.float32]:
    """[3, BINS] with NaN where too little was seen: filled from neighbours, and freed of single levels that stand out.

    A level at which the clip shows nothing flat is told too much; grain follows brightness smoothly.
    """
    typical = np.nanmedian(deviation) if not np.isnan(deviation).all() else 0.0
    known = deviation <= min(_MOST, _STANDS_OUT * typical)
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
    # A channel of which nothing was seen (all black, say) has what the others have.
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
