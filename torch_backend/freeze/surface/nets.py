"""Extracts triangles where signed distances change sign: surface nets (Gibson 1998), one vertex per cell."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .volume import SIDE, Volume, block_keys, blocks_of

_CORNERS = np.array(list(itertools.product((0, 1), repeat=3)))
"""[8, 3] corners of a cell."""
_EDGES = [(a, b) for a, b in itertools.combinations(range(8), 2) if np.abs(_CORNERS[a] - _CORNERS[b]).sum() == 1]
"""The 12 edges of a cell, as pairs of corners."""


def extract(volume: Volume) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """(vertices [V, 3] in the views' units, triangles [T, 3]) of the surface.

    Triangles are counter-clockwise as seen from the side of positive distances. Cells with an unknown corner have no
    vertex, and the surface ends there.
    """
    cells, values = _crossed(volume)
    order = np.argsort(block_keys(cells), kind="stable")
    cells, values = cells[order], values[order]
    keys = block_keys(cells)
    places, count = np.zeros((len(cells), 3)), np.zeros(len(cells))
    for a, b in _EDGES:
        of_a, of_b = values[:, a], values[:, b]
        rows = np.flatnonzero((of_a < 0) != (of_b < 0))
        share = (of_a[rows] / (of_a[rows] - of_b[rows]))[:, None]
        places[rows] += _CORNERS[a] + share * (_CORNERS[b] - _CORNERS[a])
        count[rows] += 1
    vertices = volume.space.back((cells + places / np.maximum(count, 1)[:, None]) * volume.voxel)
    found: list[NDArray[Any]] = []
    for axis in range(3):
        along, second, third = (np.eye(3, dtype=np.int64)[(axis + n) % 3] for n in range(3))
        ends = values[:, 0], values[:, int(along @ (4, 2, 1))]
        rows = np.flatnonzero((ends[0] < 0) != (ends[1] < 0))
        around = [_find(keys, cells[rows] - offset) for offset in (0 * second, second, second + third, third)]
        quads = np.stack(around, 1)
        is_complete = (quads >= 0).all(1)
        quads, rises = quads[is_complete], (ends[0][rows] < 0)[is_complete]
        quads[~rises] = quads[~rises, ::-1]
        found += [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
    return vertices.astype(np.float32), np.concatenate(found).astype(np.int32)


def _find(keys: NDArray[np.int64], cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Index of each cell [N, 3] in the ascending `keys`; -1 for missing cells."""
    targets = block_keys(cells)
    at = np.minimum(np.searchsorted(keys, targets), max(len(keys) - 1, 0))
    return np.where(keys[at] == targets, at, -1) if len(keys) else np.full(len(cells), -1)


def _crossed(volume: Volume) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """(cells [C, 3] that the surface crosses, in voxel indices, signed distances [C, 8] at their corners)."""
    cells: list[NDArray[Any]] = []
    values: list[NDArray[Any]] = []
    blocks = blocks_of(volume.keys)
    for first in range(0, len(blocks), 4096):
        part = blocks[first : first + 4096]
        padded = np.full((len(part), *[SIDE + 1] * 3), np.nan, np.float32)  # plus the first voxels of the next blocks
        for corner in _CORNERS:
            at = _find(volume.keys, part + corner)
            rows = np.flatnonzero(at >= 0)
            place, source = zip(*((SIDE, 0) if c else (slice(0, SIDE), slice(0, SIDE)) for c in corner), strict=True)
            padded[(rows, *place)] = volume.distance[(at[rows], *source)]
        shifted = [padded[(slice(None), *(slice(c, c + SIDE) for c in corner))] for corner in _CORNERS]
        below = sum((s < 0).astype(np.int8) for s in shifted)
        known = ~np.isnan(sum(shifted))
        found = np.nonzero(known & (below > 0) & (below < 8))
        cells.append(part[found[0]] * SIDE + np.stack(found[1:], -1))
        values.append(np.stack([s[found] for s in shifted], -1))
    return np.concatenate(cells).astype(np.int64), np.concatenate(values)
