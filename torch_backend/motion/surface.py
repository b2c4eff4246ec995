"""Points of the surfaces that stand still, as dense as the pictures let: what the search for motion finds on its way.

A wall, a jacket, a dark trouser leg hardly have a sparse point, so training would have nothing there to start from but
a guess. The search for motion knows the depth of most of their pixels: the still point that explains their matches.
What several matches agree on, under enough parallax, is kept by key frame beside the mattes, with which it comes and
goes: SHOT/solve/motion/NNNNNN.npz.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..contract import SURFACE, atomic_path, frame_number, open_arrays
from .flow import Map, Mask
from .misfit import Sight
from .still import Evidence

LEAST_AGREEING = 3
"""Matches that have to agree on a point."""
LEAST_PARALLAX = 5.0
"""Pixels of a picture 640 wide by which its place in another frame would differ if it were twice as near: an error of
one moves it by at most a fifth of its depth."""
MOST_OFF = 0.5
"""Largest weight of moving evidence for a still point, relative to its still evidence."""
AWAY = 6.0
"""Pixels of a picture 640 wide from what is not known to stand still, at least."""
PER_KEY = 2048
"""Points kept of a key frame, at most."""


@dataclass(frozen=True)
class SurfacePoints:
    """Points of still surfaces, [S]."""

    xyz: NDArray[np.float32]
    """[S, 3] solve units."""
    rgb: NDArray[np.uint8]
    """[S, 3] as the working frames show them."""
    frames: NDArray[np.int64]
    """[S] key frame in which each was found."""


NO_SURFACE = SurfacePoints(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, np.int64))


@dataclass(frozen=True)
class KeyEvidence:
    """What is known of a key frame."""

    evidence: Evidence
    """On the grid [h, w]."""
    grid: tuple[Map, Map]
    """Positions x and y of its points in flow pixels."""
    sight: Sight
    """Colours on the grid, and the camera."""


def surface_points(
    key: KeyEvidence, unit: float, excluded: Mask, seed: int
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """(xyz [S, 3] solve units, rgb [S, 3]) of up to `PER_KEY` points of a key frame, drawn evenly over its picture.

    Args:
        unit: flow pixels in one pixel of a picture 640 wide.
        excluded: [H, W] of the working frame: none of that.
        seed: of the draw.
    """
    found, sight = key.evidence, key.sight
    known = (found.agree >= LEAST_AGREEING) & (found.parallax >= LEAST_PARALLAX * unit) & (found.inverse > 1e-6)
    known &= found.off <= MOST_OFF * found.on
    known &= cv2.resize(excluded.astype(np.uint8), known.shape[::-1], interpolation=cv2.INTER_NEAREST_EXACT) == 0
    places = np.flatnonzero(known)
    if len(places) > PER_KEY:
        places = np.sort(np.random.default_rng(seed).choice(places, PER_KEY, replace=False))
    x, y, inverse = (plane.reshape(-1)[places].astype(np.float64) for plane in (*key.grid, found.inverse))
    z, K, V = 1.0 / inverse, sight.K, sight.viewmat
    local = np.stack([(x - K[0, 2]) / K[0, 0] * z, (y - K[1, 2]) / K[1, 1] * z, z], axis=1)
    xyz = (local - V[:3, 3]) @ V[:3, :3]
    return xyz.astype(np.float32), sight.colors.reshape(-1, 3)[places]


def write_surface(path: Path, xyz: NDArray[np.float32], rgb: NDArray[np.uint8]) -> None:
    """Keeps the points of a key frame, whole or not at all."""
    with atomic_path(path) as half, half.open("wb") as handle:
        np.savez(handle, xyz=xyz, rgb=rgb)


def read_surface(folder: Path) -> SurfacePoints:
    """All points that a folder of mattes holds. A file that is damaged is left out: training can do without."""
    parts: list[tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.int64]]] = []
    for path in sorted(folder.glob("*" + SURFACE)):
        frame = frame_number(path.stem)
        if frame is None:
            continue
        arrays = _arrays(path)
        if arrays is not None:
            parts.append((*arrays, np.full(len(arrays[0]), frame, np.int64)))
    if not parts:
        return NO_SURFACE
    xyz, rgb, frames = zip(*parts, strict=True)
    return SurfacePoints(np.concatenate(xyz), np.concatenate(rgb), np.concatenate(frames))


def is_damaged(path: Path) -> bool:
    """True if a file of points is there and cannot be read."""
    return path.is_file() and _arrays(path) is None


def _arrays(path: Path) -> tuple[NDArray[np.float32], NDArray[np.uint8]] | None:
    """(xyz, rgb) of a file; None if they cannot be read, or are not what was written."""
    try:
        with open_arrays(path) as handle, np.load(handle, allow_pickle=False) as data:
            xyz, rgb = data["xyz"], data["rgb"]
    except Exception:  # zipfile, zlib and numpy raise a dozen kinds
        return None
    whole = xyz.dtype == np.float32 and rgb.dtype == np.uint8 and xyz.shape == rgb.shape == (len(xyz), 3)
    return (xyz, rgb) if whole and np.isfinite(xyz).all() else None
