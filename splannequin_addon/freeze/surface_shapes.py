"""The meshes of a take's surface, read from its file in a separate thread."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...torch_backend import contract


@dataclass(frozen=True, eq=False)
class Shape:
    """Data of a mesh."""

    places: np.ndarray
    """[V, 3] float32."""
    colors: np.ndarray
    """[V, 4] float32 in 0..1, display-referred."""
    # Blender would need a second to compute the edges of a large mesh.
    edges: np.ndarray
    """[E, 2] int32, vertex indices of each edge."""
    corners: np.ndarray
    """[T, 3] int32, vertex indices of each triangle."""
    sides: np.ndarray
    """[T, 3] int32, index into `edges` of the edge from corner k to corner k+1 of each triangle."""


def begin(path: Path) -> Future[list[Shape]]:
    """Starts to read a surface in a thread. The result is [room, people]."""
    pool = ThreadPoolExecutor(1)
    future = pool.submit(shapes, path)
    pool.shutdown(wait=False)
    return future


def shapes(path: Path) -> list[Shape]:
    """Shapes of a surface, as [room, people]. Raises ValueError as `read` does."""
    whole = read(path)
    return [_part(*whole, people) for people in (False, True)]


def read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a take's surface, as structured arrays with the contract's fields.

    Raises ValueError for another kind of file, a truncated file, or triangles with invalid vertices.
    """
    with contract.open_regular(path, contract.LONGEST_CHECKPOINT) as handle:
        header = contract.read_surface_header(handle, path)
        of_vertices, of_triangles = (np.dtype(list(f)) for f in (contract.VERTEX_FIELDS, contract.TRIANGLE_FIELDS))
        vertices = np.frombuffer(handle.read(header.vertices * of_vertices.itemsize), of_vertices)
        triangles = np.frombuffer(handle.read(header.triangles * of_triangles.itemsize), of_triangles)
    corners = _corners(triangles)
    is_right = np.isin(triangles["corners"], 3).all() and (corners >= 0).all() and (corners < header.vertices).all()
    if not is_right or not all(np.isfinite(vertices[axis]).all() for axis in "xyz"):
        raise contract.UserError(f"{path} is damaged. Create it again.")
    return vertices, triangles


def _corners(triangles: np.ndarray) -> np.ndarray:
    """[T, 3] int32."""
    return np.stack([triangles[name] for name in "abc"], axis=1)


def _part(vertices: np.ndarray, triangles: np.ndarray, people: bool) -> Shape:
    """The room or the people of a surface."""
    kept, flat = np.unique(_corners(triangles[(triangles["people"] > 0) == people]), return_inverse=True)
    corners = flat.reshape(-1, 3).astype(np.int32)
    chosen = vertices[kept]
    colors = np.stack([chosen[name] for name in ("red", "green", "blue")], axis=1).astype(np.float32) / 255.0
    places = np.stack([chosen[axis] for axis in "xyz"], axis=1)
    ends = np.sort(np.stack([corners, np.roll(corners, -1, axis=1)], axis=-1).reshape(-1, 2).astype(np.int64), axis=1)
    count = max(len(kept), 1)
    found, sides = np.unique(ends[:, 0] * count + ends[:, 1], return_inverse=True)
    return Shape(
        places,
        np.concatenate([colors, np.ones((len(kept), 1), np.float32)], axis=1),
        np.stack([found // count, found % count], axis=1).astype(np.int32),
        corners,
        sides.reshape(-1, 3).astype(np.int32),
    )
