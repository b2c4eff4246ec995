"""Where a solve stands in the scene: floor, origin and scale by chosen points. Plain numpy, no bpy.

A change is a [4, 4] float64 matrix of the world, to be multiplied from the left onto the transform of the shot's root:
a turn, a shift or one factor for all axes. None of them can make a uniform scale anything else.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...torch_backend.contract import ExitCode, JobError

Floats = NDArray[np.float32] | NDArray[np.float64]
FLATTEST = 0.02
"""Sine of the angle between two sides under which three points count as one line."""


def unit(vectors: Floats) -> NDArray[np.float64]:
    """Vectors [..., 3] at length 1; those of length 0 stay 0."""
    vectors = np.asarray(vectors, dtype=np.float64)
    length = np.sqrt((vectors * vectors).sum(-1, keepdims=True))
    return vectors / np.where(length > 0, length, 1.0)


def middle(values: Floats) -> NDArray[np.float64]:
    """The median along the first axis. numpy's own takes 20 ms the first time, for its masked arrays."""
    ordered = np.sort(np.asarray(values, dtype=np.float64), axis=0)
    return (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2.0


def turn(one: Floats, other: Floats) -> NDArray[np.float64]:
    """The shortest rotation [3, 3] that brings the direction of `one` to that of `other`, both [3]."""
    one, other = unit(one), unit(other)
    axis = np.asarray(np.cross(one, other), dtype=np.float64)
    cosine = float((one * other).sum())
    if cosine < -1.0 + 1e-12:  # half a turn, about whatever is square to it
        square = np.asarray(np.cross(one, np.eye(3)[np.argmin(np.abs(one))]), dtype=np.float64)
        about = unit(square)
        return 2.0 * np.outer(about, about) - np.eye(3)
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + cosine)


def level(places: Floats, centres: Floats, ups: Floats) -> NDArray[np.float64]:
    """The change that lays three points into z = 0 with the cameras above; their middle keeps its x and y.

    Args:
        places: the three, [3, 3], a row each, world.
        centres: where the camera was, [F, 3], world.
        ups: its upward directions, [F, 3], world: they decide if it was neither above nor below.

    Raises:
        JobError: the three lie on a line.
    """
    places, centres = np.asarray(places, dtype=np.float64), np.asarray(centres, dtype=np.float64)
    one, other = places[1] - places[0], places[2] - places[0]
    normal = np.cross(one, other)
    longest = max(_length(one), _length(other), _length(other - one))
    if _length(normal) <= FLATTEST * longest * longest:
        raise JobError("The three points lie on one line.", "Choose three that span the floor.", ExitCode.USAGE)
    normal = unit(normal)
    above = float(((centres - places[0]) @ normal).mean())
    if abs(above) < 1e-3 * longest:
        above = float((np.asarray(ups, dtype=np.float64) @ normal).mean())
    rotation = turn(normal if above >= 0 else -normal, np.array([0.0, 0.0, 1.0]))
    middle = places.mean(axis=0)
    change = np.eye(4)
    change[:3, :3] = rotation
    change[:3, 3] = np.array([middle[0], middle[1], 0.0]) - rotation @ middle
    return change


def to_origin(place: Floats) -> NDArray[np.float64]:
    """The change that moves a point [3] of the world to the world's origin."""
    change = np.eye(4)
    change[:3, 3] = -np.asarray(place, dtype=np.float64)
    return change


def scaled(places: Floats, distance: float) -> NDArray[np.float64]:
    """The change that brings two points [2, 3] to a distance; the world's origin, and so the floor, stays.

    Raises:
        JobError: they are the same point, or the distance is not above 0.
    """
    places = np.asarray(places, dtype=np.float64)
    now = _length(places[1] - places[0])
    if not (distance > 0 and np.isfinite(distance)):
        raise JobError("The distance has to be above 0.", "Say how far apart the points are.", ExitCode.USAGE)
    if now <= 1e-9 * max(1.0, float(np.abs(places).max())):
        raise JobError("The two points are the same.", "Choose two that are apart.", ExitCode.USAGE)
    return np.diag([distance / now] * 3 + [1.0])


def nearest(pixel: tuple[float, float], places: Floats, matrix: Floats, size: tuple[int, int], reach: float) -> int:
    """Which of some places is seen nearest to a pixel, -1 if none is within reach.

    Args:
        pixel: x, y from the region's lower left.
        places: [P, 3], world.
        matrix: world to clip space of the region, [4, 4].
        size: of the region in pixels.
        reach: in pixels.
    """
    at, before = seen(places, matrix, size)
    distance = np.where(before, np.hypot(at[:, 0] - pixel[0], at[:, 1] - pixel[1]), np.inf)
    if not len(distance) or distance.min() > reach:
        return -1
    return int(distance.argmin())


def seen(places: Floats, matrix: Floats, size: tuple[int, int]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Pixels [P, 2] of places [P, 3] in a region, and which of them lie before the view; as `nearest` takes them."""
    matrix = np.asarray(matrix, dtype=np.float64)
    clip = np.asarray(places, dtype=np.float64).reshape(-1, 3) @ matrix[:, :3].T + matrix[:, 3]
    before = clip[:, 3] > 1e-9
    ratio = clip[:, :2] / np.where(before, clip[:, 3], 1.0)[:, None]
    return (ratio + 1.0) * 0.5 * np.array(size, dtype=np.float64), before


def _length(vector: Floats) -> float:
    return float(np.sqrt((vector * vector).sum()))
