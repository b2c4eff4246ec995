"""Post-processing of a fused surface: removes noise, and adds colours and the mask of people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...array_types import pieces
from .volume import SIDE, View

# Smallest share and smallest number of views that must confirm the depth of a small piece to keep it. On the bundled
# clip, two hands without a forearm have 0.6 and 0.7 of 22 and 23 views; noise has at most 0.4, or 3 views.
_CONFIRMED, _VIEWS = 0.5, 3.0
# Number of triangles of the smallest piece that is kept: a square of twice the truncation. Smaller pieces are noise
# near a surface.
_SMALLEST = 2 * SIDE**2
# Number of vertices per row in look-ups, because OpenCV limits pictures to 32767 rows and columns.
_COLUMNS = 512


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh of triangles."""

    vertices: NDArray[np.float32]
    """[V, 3] positions."""
    colors: NDArray[np.uint8]
    """[V, 3] sRGB colours."""
    triangles: NDArray[np.int32]
    """[T, 3] indices of vertices."""
    people: NDArray[np.bool_]
    """[T] True for triangles that move in the clip."""


def dress(
    vertices: NDArray[np.float32],
    triangles: NDArray[np.int32],
    views: Sequence[View],
    cut: NDArray[np.float32],
    part: float,
) -> Surface:
    """A surface without noise; each vertex has the colour of the view that shows it best.

    Args:
        vertices: [V, 3] positions.
        triangles: [T, 3] indices of vertices.
        views: frozen frames.
        cut: [V] distance to a view's depth above which the view shows another surface than the vertex.
        part: share of all triangles below which a separate piece is noise, unless most views confirm it. Below a fifth
            of it, islands of people in the room, and of the room in people, are removed.
    """
    triangles = triangles[_is_kept(vertices, triangles, views, cut, part)]
    kept, flat = np.unique(triangles, return_inverse=True)
    vertices, triangles = vertices[kept], flat.reshape(-1, 3).astype(np.int32)
    colors, motion = _looked_up(vertices, _normals(vertices, triangles), views, cut[kept])
    return Surface(vertices, colors, triangles, _people(triangles, motion > 0.5, part))


def _is_kept(
    vertices: NDArray[np.float32],
    triangles: NDArray[np.int32],
    views: Sequence[View],
    cut: NDArray[np.float32],
    part: float,
) -> NDArray[np.bool_]:
    """bool [T]: True for triangles of large pieces, and of small pieces that most views confirm."""
    piece = _piece(triangles, len(vertices))
    size = np.bincount(piece[triangles[:, 0]], minlength=len(vertices))
    is_small = size < part * len(triangles)
    chosen = np.flatnonzero(is_small[piece])
    looked, confirmed = _confirmations(vertices[chosen], views, cut[chosen])
    count, looks, confirms = (
        np.bincount(piece[chosen], weights, len(vertices)) for weights in (np.ones(len(chosen)), looked, confirmed)
    )
    is_confirmed = (confirms >= _CONFIRMED * looks) & (confirms >= _VIEWS * np.maximum(count, 1))
    is_confirmed &= size >= _SMALLEST
    return (~is_small | is_confirmed)[piece[triangles[:, 0]]]


def _confirmations(
    vertices: NDArray[np.float32], views: Sequence[View], cut: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(number of views with depth at each vertex [V], number of these views with the vertex's depth [V])."""
    looked, confirmed = (np.zeros(len(vertices), np.float32) for _ in range(2))
    points, edge = _in_rows(vertices), _in_rows(cut)
    for view in views:
        x, y, depth = view.seen(points)
        surface = view.depth_at(x, y, edge)
        is_known = surface > 0.0
        looked += is_known.reshape(-1)[: len(vertices)]
        confirmed += (is_known & (np.abs(surface - depth) < edge)).reshape(-1)[: len(vertices)]
    return looked, confirmed


def _people(triangles: NDArray[np.int32], moves: NDArray[np.bool_], part: float) -> NDArray[np.bool_]:
    """bool [T]: True for triangles of people, from moving vertices `moves` [V]; small islands are removed."""
    is_uniform = moves[triangles].all(1) | ~moves[triangles].any(1)
    size = _sizes(triangles[is_uniform], len(moves))
    is_surrounded = size < 0.5 * _sizes(triangles, len(moves))  # else it is most of a separate piece
    is_small = (size < 0.2 * part * len(triangles)) & is_surrounded
    return np.asarray((moves ^ is_small)[triangles].sum(1) >= 2)


def _sizes(triangles: NDArray[np.int32], count: int) -> NDArray[np.int64]:
    """[V] number of triangles in the piece of each of `count` vertices."""
    piece = _piece(triangles, count)
    return np.bincount(piece[triangles[:, 0]], minlength=count)[piece]


def _piece(triangles: NDArray[np.int32], count: int) -> NDArray[np.int32]:
    """[V] index of the piece of each of `count` vertices."""
    ends = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]]])
    return pieces(ends[:, 0], ends[:, 1], count)


def _in_rows(values: NDArray[Any]) -> NDArray[Any]:
    """Values [N, ...] of vertices reshaped to [R, 512, ...]; the last row is padded with ones."""
    rows = -(-len(values) // _COLUMNS)
    filled = np.ones((rows * _COLUMNS, *values.shape[1:]), np.float32)
    filled[: len(values)] = values
    return filled.reshape(rows, _COLUMNS, *values.shape[1:])


def _normals(vertices: NDArray[np.float32], triangles: NDArray[np.int32]) -> NDArray[np.float32]:
    """[V, 3] unit normals: means of the triangles' normals, weighted by area."""
    a, b, c = (vertices[triangles[:, n]] for n in range(3))
    of_face = np.cross(b - a, c - a)
    sums = [sum(np.bincount(triangles[:, n], of_face[:, axis], len(vertices)) for n in range(3)) for axis in range(3)]
    normals = np.stack([np.asarray(s) for s in sums], -1)
    return (normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)).astype(np.float32)


def _looked_up(
    vertices: NDArray[np.float32], normals: NDArray[np.float32], views: Sequence[View], cut: NDArray[np.float32]
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """(colours [V, 3] from the view that shows a vertex best, motion [V] averaged over all views that show it)."""
    count = len(vertices)
    points, edge = _in_rows(vertices), _in_rows(cut)
    best, total, moved = (np.zeros(count, np.float32) for _ in range(3))
    colors = np.full((count, 3), 128, np.uint8)

    def flat(values: NDArray[Any]) -> NDArray[Any]:
        return values.reshape(points.shape[0] * _COLUMNS, -1)[:count]

    for view in views:
        x, y, depth = view.seen(points)
        surface = view.depth_at(x, y, edge)
        centre = -view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
        to_camera = (centre - vertices).astype(np.float32)
        distance = np.maximum(np.linalg.norm(to_camera, axis=1), 1e-20)
        # A normal is noise where the surface is thin.
        facing = np.maximum((to_camera * normals).sum(1) / distance, 0.05)
        near = flat(np.where(surface > 0.0, np.exp(-np.square((surface - depth) / edge)), 0.0))[:, 0]
        # Pixels of the view per unit of surface area.
        score = near * facing * np.square(view.K[0, 0] / distance)
        better = score > best
        best = np.where(better, score, best)
        colors[better] = flat(view.look(view.color, x, y))[better]
        total += score
        moved += score * flat(view.look(view.motion, x, y))[:, 0]
    return colors, (moved / np.maximum(total, 1e-20)).astype(np.float32)
