"""Equirectangular panoramas, as Blender's Environment Texture reads them: resampled from cube faces, and filled.

With u and v in 0..1 from the top left corner, a pixel looks along the longitude pi - 2 pi u, counted from +X towards
+Y, and the latitude pi / 2 - pi v. The centre looks along +X, the column at u = 1/4 along +Y, and the top along +Z.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

FACES = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
"""Viewing axes of the faces."""
HALF_FACE = math.radians(50.0)
"""Half the field of view of a face. Beyond 45 degrees, neighbouring faces overlap and are blended."""
OVERSAMPLING = 2
"""Number of samples per pixel of the panorama, along each axis."""
# Rows of the coarsest level of the fill, one for every 6 degrees.
_COARSEST = 32
# Number of relaxation sweeps per level of the fill. Coarser levels have already solved longer wavelengths.
_SWEEPS = 24


def directions(width: int, height: int) -> NDArray[np.float32]:
    """Unit viewing directions [height, width, 3] of the pixels of an equirectangular picture, z up."""
    longitude = np.pi - 2.0 * np.pi * (np.arange(width) + 0.5) / width
    latitude = np.pi / 2.0 - np.pi * (np.arange(height) + 0.5) / height
    out = np.empty((height, width, 3), np.float32)
    out[..., 0] = np.cos(latitude)[:, None] * np.cos(longitude)
    out[..., 1] = np.cos(latitude)[:, None] * np.sin(longitude)
    out[..., 2] = np.sin(latitude)[:, None]
    return out


def solid_angles(width: int, height: int) -> NDArray[np.float64]:
    """[height, 1] share of the sphere covered by one pixel of each row; `width` times their sum is 1."""
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
    """[width / 2, width, 4] panorama from six faces: linear colour, premultiplied, and coverage.

    Args:
        width: width of the panorama in pixels, even.
        render: world-to-camera rotation [3, 3] -> face [side, side, 4] for `face_camera`, linear and premultiplied.
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
    """[rows, 2 * rows, C] panorama, reduced in size by averaging."""
    return np.asarray(cv2.resize(picture, (2 * rows, rows), interpolation=cv2.INTER_AREA), np.float32)


def _fade(sideways: NDArray[np.float32], forward: NDArray[np.float32]) -> NDArray[np.float32]:
    """Weight of a face by the angle from its axis: 1 up to 40 degrees, 0 from `HALF_FACE` on."""
    beyond = HALF_FACE - np.abs(np.arctan2(sideways, forward))
    return np.clip(beyond / np.float32(2.0 * (HALF_FACE - math.pi / 4.0)), 0.0, 1.0).astype(np.float32)


def filled(picture: NDArray[np.float32]) -> tuple[NDArray[np.float32], float]:
    """(colour [H, W, 3], filled share of the sphere) of a panorama [H, W, 4] that is premultiplied by its coverage.

    Covered pixels keep their colour. The others are filled by a membrane: each pixel is the mean of its neighbours on
    the sphere. The membrane is relaxed from coarse to fine. The coarsest level starts from a mean of all covered
    pixels, weighted by 1 / distance^4 on the sphere. W is 2 H, and H is 32 times a power of two.

    ValueError if no pixel is covered.
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
        # The coarsest level starts without a seam at the border or the poles.
        start = _weighted(small) if color is None else _upsampled(color)
        color = _relaxed(small, start)
        if rows == height:
            return color, min(max(share, 0.0), 1.0)
        rows *= 2


def _weighted(small: NDArray[np.float32]) -> NDArray[np.float32]:
    """[h, w, 3] mean colour of all covered pixels of a coarse panorama [h, w, 4], weighted by 1 / distance^4."""
    height, width = small.shape[:2]
    along = directions(width, height).reshape(-1, 3)
    areas = np.broadcast_to(solid_angles(width, height), (height, width)).reshape(-1, 1)
    known = (small.reshape(-1, 4) * areas).astype(np.float32)
    squared_chords = np.maximum(2.0 - 2.0 * along @ along.T, 0.0) + np.float32((math.pi / height) ** 2)
    sums = (1.0 / np.square(squared_chords)) @ known
    return (sums[:, :3] / sums[:, 3:]).reshape(height, width, 3).astype(np.float32)


def _upsampled(color: NDArray[np.float32]) -> NDArray[np.float32]:
    """A panorama [h, w, 3] at twice the size, bilinear, wrapped around horizontally."""
    around = np.concatenate([color[:, -1:], color, color[:, :1]], axis=1)
    large = cv2.resize(around, (2 * around.shape[1], 2 * len(around)), interpolation=cv2.INTER_LINEAR)
    return np.asarray(large[:, 2:-2], np.float32)


def _relaxed(small: NDArray[np.float32], start: NDArray[np.float32]) -> NDArray[np.float32]:
    """[h, w, 3]: `start` relaxed towards the membrane whose boundary is the covered part of a panorama [h, w, 4]."""
    height = len(small)
    alpha = np.clip(small[..., 3:], 0.0, 1.0)
    fixed = np.where(alpha > 1e-4, small[..., :3], 0.0)
    loose = np.where(alpha > 1e-4, 1.0 - alpha, 1.0)
    # Laplacian of the sphere on a regular grid of latitude and longitude: circles of latitude shrink towards the poles.
    edges = np.cos(np.pi / 2.0 - np.pi * np.arange(height + 1) / height)[:, None, None]
    middles = np.cos(np.pi / 2.0 - np.pi * (np.arange(height) + 0.5) / height)[:, None, None]
    up, down, horizontal = edges[:-1] * middles, edges[1:] * middles, np.ones_like(middles)
    total = up + down + 2.0 * horizontal
    up, down, horizontal = ((part / total).astype(np.float32) for part in (up, down, horizontal))
    color = start
    for _ in range(_SWEEPS):
        above = np.concatenate([color[:1], color[:-1]])
        below = np.concatenate([color[1:], color[-1:]])
        mean = up * above + down * below + horizontal * (np.roll(color, 1, axis=1) + np.roll(color, -1, axis=1))
        color = np.asarray(fixed + loose * mean, np.float32)
    return color
