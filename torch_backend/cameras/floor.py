"""Detects the floor plane in the points of a solve. Blender uses it to set the shot upright on the ground."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..contract import CameraPath
from .poses import camera_centre

TILT_DEGREES = 40.0
"""Largest angle between the floor's normal and the mean up direction of the cameras: people hold cameras level, but
tilt them down."""
LEAST_POINTS = 50
"""Minimum number of points for a floor search."""
BIG = 0.08
"""Minimum share of the points that lie on the floor."""
BELOW = 0.05
"""Maximum share of outliers below the floor. A table top has more points below: those of the floor."""
NEAR = 0.01
"""Largest distance of an inlier from the plane, as a share of the points' median distance from the cameras."""
# Number of random triples; points for the first scoring; planes scored on all points; maximum number of points.
_TRIES, _LOOKED_AT, _FINAL, _ALL = 5000, 400, 12, 3000


def floor_of(path: CameraPath, points: NDArray[Any]) -> dict[str, Any] | None:
    """`find_floor` for solved cameras and points [P, 3] as solve.json stores it: normal, height. None if not found."""
    viewmats = np.array([f.viewmat for f in path.frames], dtype=np.float64).reshape(-1, 4, 4)
    found = find_floor(points, np.stack([camera_centre(v) for v in viewmats]), -viewmats[:, 1, :3])
    return None if found is None else {"normal": found[0].tolist(), "height": found[1]}


def find_floor(
    points: NDArray[Any], centres: NDArray[Any], ups: NDArray[Any]
) -> tuple[NDArray[np.float64], float] | None:
    """The floor of a solve: the plane with most inliers among the planes with almost no points below.

    The result is deterministic: the random draws have a fixed seed.

    Args:
        points: sparse points, [P, 3], solve units; outliers are expected.
        centres: camera centres, [F, 3], solve units. All lie above the floor.
        ups: upward directions of the cameras, [F, 3]; the floor faces their mean within `TILT_DEGREES`.

    Returns:
        (normal [3] of length 1, upwards; height h): the points x with normal . x = h. None if no floor was found.
    """
    points = np.asarray(points, dtype=np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < LEAST_POINTS or not len(centres):
        return None
    chance = np.random.default_rng(0)
    points = chance.permutation(points)[:_ALL]
    centres, up = np.asarray(centres, dtype=np.float64), _unit(np.asarray(ups, dtype=np.float64).mean(axis=0))
    offsets = points - np.median(centres, axis=0)
    near = NEAR * float(np.median(np.linalg.norm(offsets, axis=1)))
    corners = points[chance.integers(len(points), size=(_TRIES, 3))]
    normals = _unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    facing = normals @ up
    normals *= np.where(facing < 0, -1.0, 1.0)[:, None]
    heights = (normals * corners[:, 0]).sum(axis=1)
    keep = np.abs(facing) > np.cos(np.radians(TILT_DEGREES))
    keep[keep] &= (centres @ normals[keep].T - heights[keep]).min(axis=0) > near
    normals, heights = normals[keep], heights[keep]
    few = points[:_LOOKED_AT]
    # The limits are relaxed by a factor of 2 here, because both shares are noisy on a sample.
    score = _judged(few, normals, heights, near, BIG / 2, 2 * BELOW)
    first = np.argsort(-score, kind="stable")[:_FINAL]
    first = first[score[first] > 0]
    best: tuple[float, NDArray[np.float64], float] | None = None
    for index in first:
        normal, height = _refined(points, normals[index], float(heights[index]), near)
        share = float(_judged(points, normal[None], np.array([height]), near, BIG, BELOW)[0])
        leans = float(normal @ up) < np.cos(np.radians(TILT_DEGREES))
        if share > 0 and not leans and (best is None or share > best[0]):
            best = (share, normal, height)
    return None if best is None else best[1:]


def _judged(
    points: NDArray[Any], normals: NDArray[Any], heights: NDArray[Any], near: float, big: float, below: float
) -> NDArray[Any]:
    """Share of the points on each of K planes, [K]; 0 for a plane that is too small or has too much under it."""
    above = points @ normals.T - heights
    on = (np.abs(above) < near).mean(axis=0)
    under = (above < -2.0 * near).mean(axis=0)
    return np.where((on >= big) & (under <= below), on, 0.0)


def _refined(
    points: NDArray[Any], normal: NDArray[Any], height: float, near: float
) -> tuple[NDArray[np.float64], float]:
    """The plane refitted three times to the points within `near`, by their direction of least variance."""
    for _ in range(3):
        on = points[np.abs(points @ normal - height) < near]
        if len(on) < 3:
            break
        middle = on.mean(axis=0)
        least = np.linalg.eigh((on - middle).T @ (on - middle))[1][:, 0]
        normal = least if least @ normal >= 0 else -least
        height = float(middle @ normal)
    return normal, height


def _unit(vectors: NDArray[Any]) -> NDArray[np.float64]:
    """Vectors [..., 3] scaled to length 1; zero vectors stay 0."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)
