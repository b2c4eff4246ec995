"""Placement of a solve in the scene: floor, origin and scale from selected points. Plain numpy, no bpy.

A change is a [4, 4] float64 world matrix: a rotation, a translation or a uniform scale. It is multiplied from the left
onto the transform of the shot's root. A uniform scale of the root therefore stays uniform.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...torch_backend.contract import ExitCode, JobError

Floats = NDArray[np.float32] | NDArray[np.float64]
FLATTEST = 0.02
"""Sine of the angle between two sides below which three points count as collinear."""


def unit(vectors: Floats) -> NDArray[np.float64]:
    """Vectors [..., 3] normalised to length 1. Zero vectors stay 0."""
    vectors = np.asarray(vectors, dtype=np.float64)
    length = np.sqrt((vectors * vectors).sum(-1, keepdims=True))
    return vectors / np.where(length > 0, length, 1.0)


def middle(values: Floats) -> NDArray[np.float64]:
    """The median along the first axis."""
    # Not `np.median`, whose first call takes 20 ms to set up masked arrays.
    ordered = np.sort(np.asarray(values, dtype=np.float64), axis=0)
    return (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2.0


def turn(start: Floats, end: Floats) -> NDArray[np.float64]:
    """The shortest rotation [3, 3] from the direction of `start` to that of `end`, both [3]."""
    start, end = unit(start), unit(end)
    axis = np.asarray(np.cross(start, end), dtype=np.float64)
    cosine = float((start * end).sum())
    if cosine < -1.0 + 1e-12:  # a half turn around any perpendicular axis
        square = np.asarray(np.cross(start, np.eye(3)[np.argmin(np.abs(start))]), dtype=np.float64)
        about = unit(square)
        return 2.0 * np.outer(about, about) - np.eye(3)
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + cosine)


def level(places: Floats, centres: Floats, ups: Floats) -> NDArray[np.float64]:
    """The change that moves three points into z = 0, with the cameras above. Their mean keeps its x and y.

    Args:
        places: the points, [3, 3], one per row, world.
        centres: camera positions, [F, 3], world.
        ups: the camera's upward directions, [F, 3], world. They decide if the positions lie in the plane of the points.

    Raises:
        JobError: the points are collinear.
    """
    places, centres = np.asarray(places, dtype=np.float64), np.asarray(centres, dtype=np.float64)
    first, second = places[1] - places[0], places[2] - places[0]
    normal = np.cross(first, second)
    longest = max(_length(first), _length(second), _length(second - first))
    if _length(normal) <= FLATTEST * longest * longest:
        raise JobError("The three points lie on one line.", "Choose three points that span the floor.", ExitCode.USAGE)
    normal = unit(normal)
    above = float(((centres - places[0]) @ normal).mean())
    if abs(above) < 1e-3 * longest:  # the positions lie in the plane of the points
        above = float((np.asarray(ups, dtype=np.float64) @ normal).mean())
    rotation = turn(normal if above >= 0 else -normal, np.array([0.0, 0.0, 1.0]))
    middle = places.mean(axis=0)
    change = np.eye(4)
    change[:3, :3] = rotation
    change[:3, 3] = np.array([middle[0], middle[1], 0.0]) - rotation @ middle
    return change


def to_origin(place: Floats) -> NDArray[np.float64]:
    """The change that moves a world point [3] to the world's origin."""
    change = np.eye(4)
    change[:3, 3] = -np.asarray(place, dtype=np.float64)
    return change


def scaled(places: Floats, distance: float) -> NDArray[np.float64]:
    """The change that scales two points [2, 3] to a distance. The world's origin, and so the floor, stays.

    Raises:
        JobError: the points are equal, or the distance is not positive.
    """
    places = np.asarray(places, dtype=np.float64)
    now = _length(places[1] - places[0])
    if not (distance > 0 and np.isfinite(distance)):
        raise JobError("The distance must be greater than 0.", "Enter the distance between the points.", ExitCode.USAGE)
    if now <= 1e-9 * max(1.0, float(np.abs(places).max())):
        raise JobError("The two points are at the same position.", "Choose two different points.", ExitCode.USAGE)
    return np.diag([distance / now] * 3 + [1.0])


def nearest(pixel: tuple[float, float], places: Floats, matrix: Floats, size: tuple[int, int], reach: float) -> int:
    """Index of the place whose projection is nearest to a pixel, or -1 if none is within reach.

    Args:
        pixel: x, y from the region's lower left corner.
        places: [P, 3], world.
        matrix: world to clip space of the region, [4, 4].
        size: width and height of the region in pixels.
        reach: maximum distance in pixels.
    """
    at, before = seen(places, matrix, size)
    distance = np.where(before, np.hypot(at[:, 0] - pixel[0], at[:, 1] - pixel[1]), np.inf)
    if not len(distance) or distance.min() > reach:
        return -1
    return int(distance.argmin())


def seen(places: Floats, matrix: Floats, size: tuple[int, int]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(pixels [P, 2] of places [P, 3] in a region, which of them lie in front of the view). Arguments as in
    `nearest`."""
    matrix = np.asarray(matrix, dtype=np.float64)
    clip = np.asarray(places, dtype=np.float64).reshape(-1, 3) @ matrix[:, :3].T + matrix[:, 3]
    before = clip[:, 3] > 1e-9
    ratio = clip[:, :2] / np.where(before, clip[:, 3], 1.0)[:, None]
    return (ratio + 1.0) * 0.5 * np.array(size, dtype=np.float64), before


def _length(vector: Floats) -> float:
    return float(np.sqrt((vector * vector).sum()))
