"""Colours, people and noise of a fused surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...array_types import pieces
from .volume import SIDE, View

_CONFIRMED, _VIEWS = 0.5, 3.0
"""A small piece is kept if at least this share of the views that look there, and this many, see it at its depth. On the
bundled clip two hands that no forearm connects have 0.6 and 0.7 of 22 and 23 views, noise at most 0.4 or 3 views."""
_SMALLEST = 2 * SIDE**2
"""Triangles of the smallest piece that is kept: a square of twice the truncation. Smaller ones lie beside a surface."""
_COLUMNS = 512
"""Vertices are looked up in rows of this many: OpenCV takes no picture of more than 32767 rows or columns."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh of triangles."""

    vertices: NDArray[np.float32]
    """[V, 3]."""
    colors: NDArray[np.uint8]
    """[V, 3] as displayed."""
    triangles: NDArray[np.int32]
    """[T, 3]."""
    people: NDArray[np.bool_]
    """[T] True of what moves in the clip."""


def dress(
    vertices: NDArray[np.float32],
    triangles: NDArray[np.int32],
    views: Sequence[View],
    cut: NDArray[np.float32],
    part: float,
) -> Surface:
    """A surface without noise, in the colours of the views that see each vertex best.

    Args:
        vertices: [V, 3].
        triangles: [T, 3].
        views: frozen frames.
        cut: [V] a vertex that is this far from a view's depth is another surface.
        part: share of all triangles below which a separate piece is noise, unless most views confirm it; also a part of
            people in the room, or of the room in people.
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
    """[T] which triangles are of a large piece, or of a small one that most views confirm."""
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
    """(number of views that know a depth at a vertex [V], number of those whose depth is the vertex's)."""
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
    """[T] which triangles are people, from the vertices [V] that move; small islands are what surrounds them."""
    alike = moves[triangles].all(1) | ~moves[triangles].any(1)
    size = _sizes(triangles[alike], len(moves))
    is_surrounded = size < 0.5 * _sizes(triangles, len(moves))  # else it is most of a separate piece
    is_small = (size < 0.2 * part * len(triangles)) & is_surrounded
    return np.asarray((moves ^ is_small)[triangles].sum(1) >= 2)


def _sizes(triangles: NDArray[np.int32], count: int) -> NDArray[np.int64]:
    """[V] triangles of the piece that each of `count` vertices belongs to."""
    piece = _piece(triangles, count)
    return np.bincount(piece[triangles[:, 0]], minlength=count)[piece]


def _piece(triangles: NDArray[np.int32], count: int) -> NDArray[np.int32]:
    """[V] number of the piece that each of `count` vertices belongs to."""
    ends = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]]])
    return pieces(ends[:, 0], ends[:, 1], count)


def _in_rows(values: NDArray[Any]) -> NDArray[Any]:
    """Values [N, ...] of vertices as [R, 512, ...]; the last row is filled with ones."""
    rows = -(-len(values) // _COLUMNS)
    filled = np.ones((rows * _COLUMNS, *values.shape[1:]), np.float32)
    filled[: len(values)] = values
    return filled.reshape(rows, _COLUMNS, *values.shape[1:])


def _normals(vertices: NDArray[np.float32], triangles: NDArray[np.int32]) -> NDArray[np.float32]:
    """[V, 3] unit normals, those of triangles weighted by their areas."""
    a, b, c = (vertices[triangles[:, n]] for n in range(3))
    of_face = np.cross(b - a, c - a)
    sums = [sum(np.bincount(triangles[:, n], of_face[:, axis], len(vertices)) for n in range(3)) for axis in range(3)]
    normals = np.stack([np.asarray(s) for s in sums], -1)
    return (normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)).astype(np.float32)


def _looked_up(
    vertices: NDArray[np.float32], normals: NDArray[np.float32], views: Sequence[View], cut: NDArray[np.float32]
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """(colours [V, 3] of the view that sees a vertex best, motion [V] by all views that see it)."""
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
        away = np.maximum(np.linalg.norm(to_camera, axis=1), 1e-20)
        facing = np.maximum((to_camera * normals).sum(1) / away, 0.05)  # a normal is noise where the surface is thin
        near = flat(np.where(surface > 0.0, np.exp(-np.square((surface - depth) / edge)), 0.0))[:, 0]
        # Pixels of the view for each unit of the surface's area.
        score = near * facing * np.square(view.K[0, 0] / away)
        better = score > best
        best = np.where(better, score, best)
        colors[better] = flat(view.look(view.color, x, y))[better]
        total += score
        moved += score * flat(view.look(view.motion, x, y))[:, 0]
    return colors, (moved / np.maximum(total, 1e-20)).astype(np.float32)
