"""Seeded noise over time for motion, and over images and space for textures. Each use has its own random stream."""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def stream(seed: int, *name: str | int) -> np.random.Generator:
    """The random stream of one part of one scene, independent of the number of draws in other parts."""
    return np.random.default_rng([seed, *(zlib.crc32(str(part).encode()) for part in name)])


def wander(rng: np.random.Generator, seconds: Array, period: float, width: int = 1) -> Array:
    """[T, width] smooth noise of unit RMS over time: five sinusoids with periods around `period` seconds."""
    octaves = period * 2.0 ** rng.uniform(-1.0, 1.0, (5, width))
    phase = rng.uniform(0.0, 2.0 * np.pi, (5, width))
    waves = np.sin(2.0 * np.pi * seconds[:, None, None] / octaves + phase)
    return waves.sum(axis=1) * np.sqrt(2.0 / 5.0)


def bumps(rng: np.random.Generator, seconds: Array, every: float, width: float) -> Array:
    """[T] short events between 0 and 1, `every` seconds apart on average, each about `width` seconds long."""
    start, end = -2.0 * every, 3600.0
    gaps = rng.uniform(0.6, 1.4, 512) * every
    centres = start + np.cumsum(gaps)
    centres = centres[centres < end]
    nearest = np.abs(seconds[:, None] - centres[None]).min(axis=1)
    return np.exp(-((nearest / (0.5 * width)) ** 4))


def smooth_step(seconds: Array, begin: float, end: float) -> Array:
    """[T] smooth step from 0 at `begin` to 1 at `end`, with zero slope at both."""
    share = np.clip((seconds - begin) / (end - begin), 0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)


def fractal(
    rng: np.random.Generator, size: int, slope: float = 1.6, stretch: tuple[float, float] = (1.0, 1.0)
) -> Array:
    """[size, size] tiling noise in (0, 1) whose amplitude falls with frequency^-slope; `stretch` is along (y, x)."""
    fy = np.fft.fftfreq(size)[:, None] * size * stretch[0]
    fx = np.fft.rfftfreq(size)[None] * size * stretch[1]
    frequency = np.hypot(fy, fx)
    frequency[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal((size, size))) * frequency**-slope
    field = np.fft.irfft2(spectrum, (size, size))
    return 0.5 + 0.5 * np.tanh(field / (1.5 * field.std()))


def solid(seed: int, points: Array, scale: float) -> Array:
    """[P] spatial value noise in [0, 1]: random values on a lattice of pitch `scale`, smoothly interpolated."""
    at = points / scale
    cell = np.floor(at).astype(np.int64)
    f = at - cell
    f = f * f * (3.0 - 2.0 * f)
    total = np.zeros(len(points))
    for corner in range(8):
        offset = np.array([corner & 1, corner >> 1 & 1, corner >> 2 & 1])
        weight = np.where(offset, f, 1.0 - f).prod(axis=1)
        total += weight * _hash(cell + offset, seed)
    return total


def _hash(cell: NDArray[np.int64], seed: int) -> Array:
    """[P] hash in [0, 1) of integer cells [P, 3], by 64-bit multiply and xorshift."""
    keys = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
    x = (cell.astype(np.uint64) * keys).sum(axis=1, dtype=np.uint64) + np.uint64(
        seed * 0xD6E8FEB86659FD93 & 0xFFFFFFFFFFFFFFFF
    )
    for shift in (32, 29, 32):
        x ^= x >> np.uint64(shift)
        x *= np.uint64(0xD6E8FEB86659FD93)
    return (x >> np.uint64(11)).astype(np.float64) / float(1 << 53)
