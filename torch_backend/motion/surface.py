"""Dense points of still surfaces, a by-product of the motion search from which training initialises Gaussians.

Sparse points are rare on a wall, a jacket or a dark trouser leg. The motion search knows the depth of most of their
pixels, from the still point that explains their matches. Points that several matches confirm with enough parallax are
stored per key frame in the mattes' folder, SHOT/solve/motion/NNNNNN.npz, and are valid as long as the mattes are.
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
"""Smallest number of matches that agree with a kept point."""
LEAST_PARALLAX = 5.0
"""Smallest parallax of a kept point: its shift in another frame if its depth halved, in pixels of a picture 640 wide. A
match error of one pixel then changes the depth by at most a fifth."""
MAX_MOVING = 0.5
"""Largest weight of moving evidence for a still point, relative to its still evidence."""
BORDER_DISTANCE = 6.0
"""Smallest distance of a kept point from pixels not labelled still, in pixels of a picture 640 wide."""
PER_KEY = 2048
"""Largest number of points kept per key frame."""


@dataclass(frozen=True)
class SurfacePoints:
    """Points of still surfaces; S is their number."""

    xyz: NDArray[np.float32]
    """[S, 3] solve units."""
    rgb: NDArray[np.uint8]
    """[S, 3] colours of the working frames."""
    frames: NDArray[np.int64]
    """[S] number of the key frame in which each point was found."""


NO_SURFACE = SurfacePoints(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, np.int64))


@dataclass(frozen=True)
class KeyEvidence:
    """Evidence of a key frame with its colours and camera."""

    evidence: Evidence
    """On the grid [h, w]."""
    grid: tuple[Map, Map]
    """Positions x and y of the grid's points in flow pixels."""
    sight: Sight
    """Colours on the grid, and the camera."""


def surface_points(
    key: KeyEvidence, unit: float, excluded: Mask, seed: int
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """(xyz [S, 3] solve units, rgb [S, 3]) of up to `PER_KEY` points of a key frame, drawn evenly over its picture.

    Args:
        unit: flow pixels in one pixel of a picture 640 wide.
        excluded: [H, W] mask of working-frame pixels without points.
        seed: random seed of the draw.
    """
    found, sight = key.evidence, key.sight
    known = (found.agree >= LEAST_AGREEING) & (found.parallax >= LEAST_PARALLAX * unit) & (found.inverse > 1e-6)
    known &= found.moving <= MAX_MOVING * found.still
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
    """Writes the points of a key frame, whole or not at all."""
    with atomic_path(path) as half, half.open("wb") as handle:
        np.savez(handle, xyz=xyz, rgb=rgb)


def read_surface(folder: Path) -> SurfacePoints:
    """All points in a folder of mattes. Damaged files are skipped."""
    parts: list[tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.int64]]] = []
    for path in sorted(folder.glob("*" + SURFACE)):
        frame = frame_number(path.stem)
        if frame is None:
            continue
        arrays = _arrays(path)
        if arrays is not None:  # training does not depend on the points
            parts.append((*arrays, np.full(len(arrays[0]), frame, np.int64)))
    if not parts:
        return NO_SURFACE
    xyz, rgb, frames = zip(*parts, strict=True)
    return SurfacePoints(np.concatenate(xyz), np.concatenate(rgb), np.concatenate(frames))


def is_damaged(path: Path) -> bool:
    """True if a file of points exists but cannot be read."""
    return path.is_file() and _arrays(path) is None


def _arrays(path: Path) -> tuple[NDArray[np.float32], NDArray[np.uint8]] | None:
    """(xyz, rgb) of a file; None if it cannot be read or holds arrays of the wrong type, shape or values."""
    try:
        with open_arrays(path) as handle, np.load(handle, allow_pickle=False) as data:
            xyz, rgb = data["xyz"], data["rgb"]
    except Exception:  # zipfile, zlib and numpy raise a dozen kinds
        return None
    whole = xyz.dtype == np.float32 and rgb.dtype == np.uint8 and xyz.shape == rgb.shape == (len(xyz), 3)
    return (xyz, rgb) if whole and np.isfinite(xyz).all() else None
