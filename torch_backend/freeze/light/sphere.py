"""Pictures of all directions: equirectangular, as Blender's Environment Texture reads them, of faces and filled.

Column u and row v of a picture 1 wide and 1 high look along the longitude pi - 2 pi u, counted from +X over +Y, and the
latitude pi / 2 - pi v: the middle looks along +X, the quarter from the left along +Y, the top along +Z.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

FACES = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
"""Axes that the faces look along."""
HALF_FACE = math.radians(50.0)
"""Half the angle of a face: beyond 45 degrees neighbours overlap, and fade into each other."""
OVERSAMPLING = 2
"""Pixels of the panorama that are looked up per pixel that leaves, in each direction."""
_COARSEST = 32
"""Rows of the picture that the fill begins with, a row for every 6 degrees."""
_SWEEPS = 24
"""Relaxations of each size of the fill: what is left over has the wavelength of the next coarser size."""


def directions(width: int, height: int) -> NDArray[np.float32]:
    """Unit vectors [height, width, 3] that the pixels of an equirectangular picture look along, z up."""
    longitude = np.pi - 2.0 * np.pi * (np.arange(width) + 0.5) / width
    latitude = np.pi / 2.0 - np.pi * (np.arange(height) + 0.5) / height
    out = np.empty((height, width, 3), np.float32)
    out[..., 0] = np.cos(latitude)[:, None] * np.cos(longitude)
    out[..., 1] = np.cos(latitude)[:, None] * np.sin(longitude)
    out[..., 2] = np.sin(latitude)[:, None]
    return out


def solid_angles(width: int, height: int) -> NDArray[np.float64]:
    """[height, 1] share of the sphere that a pixel of each row has; `width` times their sum is 1."""
    edges = np.sin(np.pi / 2.0 - np.pi * np.arange(height + 1) / height)
    return ((edges[:-1] - edges[1:]) / 2.0 / width)[:, None]


def face_rotations() -> Iterator[NDArray[np.float64]]:
    """World-to-camera rotations [3, 3] of `FACES`, OpenCV axes."""
    for axis in FACES:
        forward = np.array(axis, np.float64)
        down = np.array((0.0, -1.0, 0.0) if axis[2] else (0.0, 0.0, -1.0))
        yield np.stack([np.cross(down, forward), down, forward])


def face_camera(width: int) -> tuple[float, int]:
    """(focal length in pixels, side in pixels) of the faces of a panorama `width` wide, oversampled."""
    focal = OVERSAMPLING * width / (2.0 * math.pi)
    return focal, 2 * math.ceil(focal * math.tan(HALF_FACE))


def panorama(width: int, render: Callable[[NDArray[np.float64]], NDArray[np.float32]]) -> NDArray[np.float32]:
    """[width / 2, width, 4] of six faces: linear colour, premultiplied, and coverage.

    Args:
        width: even, pixels.
        render: world-to-camera rotation [3, 3] -> the face [side, side, 4] that `face_camera` says, of such colour.
    """
    fine = OVERSAMPLING * width
    focal, side = face_camera(width)
    along = directions(fine, fine // 2)
    total = np.zeros((fine // 2, fine, 4), np.float32)
    weights = np.zeros((fine // 2, fine, 1), np.float32)
    for rotation in face_rotations():
        x, y, z = np.moveaxis(along @ rotation.T.astype(np.float32), -1, 0)
        positive_z = np.maximum(z, np.float32(1e-6))
        weight = (_fade(x, z) * _fade(y, z))[..., None]
        columns, rows = (focal * part / positive_z + np.float32(side / 2.0 - 0.5) for part in (x, y))
        face = cv2.remap(render(rotation), columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        total += weight * face
        weights += weight
    return _smaller(total / weights, width // 2)


def _smaller(picture: NDArray[np.float32], rows: int) -> NDArray[np.float32]:
    """[rows, 2 rows, C]: the means of a panorama's pixels."""
    return np.asarray(cv2.resize(picture, (2 * rows, rows), interpolation=cv2.INTER_AREA), np.float32)


def _fade(across: NDArray[np.float32], ahead: NDArray[np.float32]) -> NDArray[np.float32]:
    """Weight of a face by the angle from its axis: 1 up to 40 degrees, 0 from `HALF_FACE` on."""
    beyond = HALF_FACE - np.abs(np.arctan2(across, ahead))
    return np.clip(beyond / np.float32(2.0 * (HALF_FACE - math.pi / 4.0)), 0.0, 1.0).astype(np.float32)


def filled(picture: NDArray[np.float32]) -> tuple[NDArray[np.float32], float]:
    """(colour [H, W, 3], share of the sphere that was filled) of a panorama [H, W, 4], premultiplied by its coverage.

    What is covered keeps its colour; the rest is a membrane between: each pixel is the mean of its neighbours on the
    sphere. It is relaxed from coarse to fine; the coarsest is a mean of all that is covered, weighted by the fourth
    power of the distance on the sphere, so that it knows no seam and no pole. W is 2 H, H 32 or a power of two above.

    ValueError if nothing is covered.
    """
    height, width = picture.shape[:2]
    alpha = np.clip(picture[..., 3:], 0.0, 1.0)
    share = float(((1.0 - alpha[..., 0]) * solid_angles(width, height)).sum())
    if share > 1.0 - 1e-6:
        raise ValueError("nothing is covered")
    color: NDArray[np.float32] | None = None
    rows = _COARSEST
    while True:
        small = picture if rows == height else _smaller(picture, rows)
        start = _weighted(small) if color is None else _twice(color)
        color = _relaxed(small, start)
        if rows == height:
            return color, min(max(share, 0.0), 1.0)
        rows *= 2


def _weighted(small: NDArray[np.float32]) -> NDArray[np.float32]:
    """[h, w, 3] of a coarse panorama [h, w, 4]: everywhere the mean of what is covered, near more than far."""
    height, width = small.shape[:2]
    along = directions(width, height).reshape(-1, 3)
    areas = np.broadcast_to(solid_angles(width, height), (height, width)).reshape(-1, 1)
    known = (small.reshape(-1, 4) * areas).astype(np.float32)
    apart = np.maximum(2.0 - 2.0 * along @ along.T, 0.0) + np.float32((math.pi / height) ** 2)  # squared chords
    sums = (1.0 / np.square(apart)) @ known
    return (sums[:, :3] / sums[:, 3:]).reshape(height, width, 3).astype(np.float32)


def _twice(color: NDArray[np.float32]) -> NDArray[np.float32]:
    """A panorama [h, w, 3] at twice the size, bilinear, round the back."""
    around = np.concatenate([color[:, -1:], color, color[:, :1]], axis=1)
    large = cv2.resize(around, (2 * around.shape[1], 2 * len(around)), interpolation=cv2.INTER_LINEAR)
    return np.asarray(large[:, 2:-2], np.float32)


def _relaxed(small: NDArray[np.float32], start: NDArray[np.float32]) -> NDArray[np.float32]:
    """[h, w, 3]: `start` relaxed towards the membrane that a panorama [h, w, 4] holds by its coverage."""
    height = len(small)
    alpha = np.clip(small[..., 3:], 0.0, 1.0)
    held = np.where(alpha > 1e-4, small[..., :3], 0.0)
    loose = np.where(alpha > 1e-4, 1.0 - alpha, 1.0)
    # The Laplacian of the sphere on even steps of both angles: circles of latitude shrink towards the poles.
    edges = np.cos(np.pi / 2.0 - np.pi * np.arange(height + 1) / height)[:, None, None]
    middles = np.cos(np.pi / 2.0 - np.pi * (np.arange(height) + 0.5) / height)[:, None, None]
    up, down, aside = edges[:-1] * middles, edges[1:] * middles, np.ones_like(middles)
    total = up + down + 2.0 * aside
    up, down, aside = ((part / total).astype(np.float32) for part in (up, down, aside))
    color = start
    for _ in range(_SWEEPS):
        above = np.concatenate([color[:1], color[:-1]])
        below = np.concatenate([color[1:], color[-1:]])
        mean = up * above + down * below + aside * (np.roll(color, 1, axis=1) + np.roll(color, -1, axis=1))
        color = np.asarray(held + loose * mean, np.float32)
    return color
