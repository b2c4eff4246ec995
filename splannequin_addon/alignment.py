"""Where a solve stands in the scene: floor, origin and scale. Plain numpy, no bpy.

A change is a [4, 4] float64 matrix of the world, to be multiplied from the left onto the transform of the shot's root:
a turn, a shift or one factor for all axes. None of them can make a uniform scale anything else.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ..torch_backend.contract import ExitCode, JobError

FLATTEST = 0.02
"""Sine of the angle between two sides under which three points count as one line."""
TILT_DEGREES = 40.0
"""Most that the floor may lean against the cameras' mean up: people hold cameras level, but look down."""
LEAST_POINTS = 50
"""Fewer points say nothing about a floor."""
BIG = 0.08
"""Least share of the points on the floor."""
BELOW = 0.05
"""Most of the points under it: outliers. A table has the floor under it."""
NEAR = 0.01
"""A point this near is on a plane, in median distances from the cameras."""
_TRIES, _LOOKED_AT, _FINAL, _ALL = 5000, 400, 12, 3000
"""Triples drawn; points that each is judged by at first; those judged by all points; most points used."""
_AT_ONCE = 128
"""Planes judged together."""


def unit(vectors: NDArray) -> NDArray[np.float64]:
    """Vectors [..., 3] at length 1; those of length 0 stay 0."""
    vectors = np.asarray(vectors, dtype=np.float64)
    length = np.sqrt((vectors * vectors).sum(-1, keepdims=True))
    return vectors / np.where(length > 0, length, 1.0)


def middle(values: NDArray) -> NDArray[np.float64]:
    """The median along the first axis. numpy's own takes 20 ms the first time, for its masked arrays."""
    ordered = np.sort(np.asarray(values, dtype=np.float64), axis=0)
    return (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2.0


def turn(one: NDArray, other: NDArray) -> NDArray[np.float64]:
    """The shortest rotation [3, 3] that brings the direction of `one` to that of `other`, both [3]."""
    one, other = unit(one), unit(other)
    axis, cosine = np.cross(one, other), float((one * other).sum())
    if cosine < -1.0 + 1e-12:  # half a turn, about whatever is square to it
        about = unit(np.cross(one, np.eye(3)[np.argmin(np.abs(one))]))
        return 2.0 * np.outer(about, about) - np.eye(3)
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + cosine)


def level(places: NDArray, centres: NDArray, ups: NDArray) -> NDArray[np.float64]:
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


def to_origin(place: NDArray) -> NDArray[np.float64]:
    """The change that moves a point [3] of the world to the world's origin."""
    change = np.eye(4)
    change[:3, 3] = -np.asarray(place, dtype=np.float64)
    return change


def scaled(places: NDArray, distance: float) -> NDArray[np.float64]:
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


def floor(points: NDArray, centres: NDArray, ups: NDArray) -> tuple[NDArray[np.float64], float] | None:
    """The floor under a solve: the plane with most points among those that have next to nothing under them.

    The same points give the same floor, always.

    Args:
        points: sparse points, [P, 3], solve units; outliers are expected.
        centres: where the camera was, [F, 3], solve units. All of it is above the floor.
        ups: its upward directions, [F, 3]; the floor faces their mean within `TILT_DEGREES`.

    Returns:
        (normal [3] of length 1, upwards; height h): the points x with normal . x = h. None if there is none.
    """
    points = np.asarray(points, dtype=np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < LEAST_POINTS or not len(centres):
        return None
    points = points[_shuffled(len(points))[:_ALL]]
    centres, up = np.asarray(centres, dtype=np.float64), unit(np.asarray(ups, dtype=np.float64).mean(axis=0))
    away = points - middle(centres)
    near = NEAR * float(middle(np.sqrt((away * away).sum(axis=1))))
    corners = points[np.reshape(_scattered(3 * _TRIES) % np.uint64(len(points)), (_TRIES, 3)).astype(np.intp)]
    normals = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    facing = normals @ up
    normals *= np.where(facing < 0, -1.0, 1.0)[:, None]
    heights = (normals * corners[:, 0]).sum(axis=1)
    keep = np.abs(facing) > np.cos(np.radians(TILT_DEGREES))
    normals, heights = normals[keep], heights[keep]
    keep = np.concatenate([h.min(axis=0) for h in _heights(centres, normals, heights)]) > near
    normals, heights = normals[keep], heights[keep]
    few = points[:_LOOKED_AT]
    # A sample is judged with some leave: chance adds to either share.
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


def nearest(pixel: tuple[float, float], places: NDArray, matrix: NDArray, size: tuple[int, int], reach: float) -> int:
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


def seen(places: NDArray, matrix: NDArray, size: tuple[int, int]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Pixels [P, 2] of places [P, 3] in a region, and which of them lie before the view; as `nearest` takes them."""
    matrix = np.asarray(matrix, dtype=np.float64)
    clip = np.asarray(places, dtype=np.float64).reshape(-1, 3) @ matrix[:, :3].T + matrix[:, 3]
    before = clip[:, 3] > 1e-9
    ratio = clip[:, :2] / np.where(before, clip[:, 3], 1.0)[:, None]
    return (ratio + 1.0) * 0.5 * np.array(size, dtype=np.float64), before


def _length(vector: NDArray) -> float:
    return float(np.sqrt((vector * vector).sum()))


def _judged(points: NDArray, normals: NDArray, heights: NDArray, near: float, big: float, below: float) -> NDArray:
    """Share of the points on each of K planes, [K]; 0 for a plane that is too small or has too much under it."""
    shares = []
    for above in _heights(points, normals, heights):
        on = np.count_nonzero(np.abs(above) < near, axis=0) / len(points)
        under = np.count_nonzero(above < -2.0 * near, axis=0) / len(points)
        shares.append(np.where((on >= big) & (under <= below), on, 0.0))
    return np.concatenate(shares)


def _heights(points: NDArray, normals: NDArray, heights: NDArray) -> Iterator[NDArray[np.float64]]:
    """How far each point [P, 3] is over each of K planes, as [P, k] for some planes after others.

    All at once would be megabytes that the machine has to give first, which takes longer than to fill them.
    """
    for first in range(0, max(1, len(normals)), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        yield points @ normals[some].T - heights[some]


def _scattered(count: int) -> NDArray[np.uint64]:
    """Numbers over all 64 bits, [count], always the same: the integers mixed as SplitMix64 does.

    numpy.random and Python's own would do, but the one is imported and the other looped over while Blender waits.
    """
    mixed = np.arange(1, count + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return mixed ^ (mixed >> np.uint64(31))


def _shuffled(count: int) -> NDArray[np.intp]:
    """The numbers below `count` in an order that says nothing, always the same, [count]."""
    return np.argsort(_scattered(count), kind="stable")


def _refined(points: NDArray, normal: NDArray, height: float, near: float) -> tuple[NDArray[np.float64], float]:
    """A plane fitted to the points that are near it, three times over: heights over it by least squares."""
    for _ in range(3):
        on = points[np.abs(points @ normal - height) < near]
        if len(on) < 3:
            break
        middle = on.mean(axis=0)
        across = unit(np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))]))
        along = np.cross(normal, across)
        off = on - middle
        x, y, z = off @ across, off @ along, off @ normal
        # z = a x + b y, as the two normal equations; written out, as `cameras` has no LAPACK either.
        xx, xy, yy, xz, yz = (x * x).sum(), (x * y).sum(), (y * y).sum(), (x * z).sum(), (y * z).sum()
        determinant = xx * yy - xy * xy
        if determinant <= 1e-12 * max(xx, yy) ** 2:
            break
        a, b = (xz * yy - yz * xy) / determinant, (yz * xx - xz * xy) / determinant
        normal = unit(normal - a * across - b * along)
        height = float(middle @ normal)
    return normal, height
