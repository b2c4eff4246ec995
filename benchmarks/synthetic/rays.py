# pyright: reportAttributeAccessIssue=false
"""Exact visibility by casting rays at triangles with Warp, on the CPU. World coordinates in metres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

SLACK = 2e-3
"""Tolerance in metres by which a ray may end before its target point."""


@wp.kernel(enable_backward=False)
def _cast(
    mesh: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    distance: wp.array(dtype=wp.float32),
    face: wp.array(dtype=wp.int32),
    barycentric: wp.array(dtype=wp.vec3),
):
    i = wp.tid()
    hit = wp.mesh_query_ray(mesh, origins[i], directions[i], 1.0e6)
    if hit.result:
        distance[i] = hit.t
        face[i] = hit.face
        barycentric[i] = wp.vec3(hit.u, hit.v, 1.0 - hit.u - hit.v)
    else:
        distance[i] = wp.inf
        face[i] = -1


@wp.kernel(enable_backward=False)
def _nearest(mesh: wp.uint64, points: wp.array(dtype=wp.vec3), found: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    result = wp.mesh_query_point_no_sign(mesh, points[i], 1.0e6)
    found[i] = wp.mesh_eval_position(mesh, result.face, result.u, result.v)


@dataclass
class Hits:
    """First hits of R rays."""

    distance: NDArray[np.float32]
    """[R] in lengths of the ray's direction; inf without a hit."""
    face: NDArray[np.int32]
    """[R] triangle; -1 without a hit."""
    barycentric: NDArray[np.float32]
    """[R, 3] weights of its corners."""


class RayScene:
    """Triangles for ray casting: `vertices` [V, 3] in metres, `triangles` [F, 3]."""

    def __init__(self, vertices: NDArray, triangles: NDArray) -> None:
        self.vertices = np.ascontiguousarray(vertices, np.float32)
        self.triangles = np.ascontiguousarray(triangles, np.int32)
        points = wp.array(self.vertices, dtype=wp.vec3, device="cpu")
        indices = wp.array(self.triangles.ravel(), dtype=wp.int32, device="cpu")
        self._mesh = wp.Mesh(points, indices)

    def cast(self, origins: NDArray, directions: NDArray) -> Hits:
        """First hits of rays from `origins` [R, 3] along `directions` [R, 3] of any length."""
        count = len(origins)
        length = np.linalg.norm(directions, axis=1, keepdims=True)
        hits = Hits(np.empty(count, np.float32), np.empty(count, np.int32), np.zeros((count, 3), np.float32))
        arrays = [
            wp.array(np.ascontiguousarray(value, np.float32), dtype=wp.vec3, device="cpu")
            for value in (origins, directions / length)
        ]
        outputs = [
            wp.array(hits.distance, dtype=wp.float32, device="cpu", copy=False),
            wp.array(hits.face, dtype=wp.int32, device="cpu", copy=False),
            wp.array(hits.barycentric, dtype=wp.vec3, device="cpu", copy=False),
        ]
        wp.launch(_cast, dim=count, inputs=[self._mesh.id, *arrays], outputs=outputs, device="cpu")
        hits.distance /= length[:, 0].astype(np.float32)
        return hits

    def nearest(self, points: NDArray) -> NDArray[np.float64]:
        """[P, 3] points on the triangles nearest to `points` [P, 3]."""
        found = np.empty((len(points), 3), np.float32)
        places = wp.array(np.ascontiguousarray(points, np.float32), dtype=wp.vec3, device="cpu")
        output = wp.array(found, dtype=wp.vec3, device="cpu", copy=False)
        wp.launch(_nearest, dim=len(points), inputs=[self._mesh.id, places], outputs=[output], device="cpu")
        return found.astype(np.float64)

    def sees(self, eye: NDArray, points: NDArray) -> NDArray[np.bool_]:
        """bool [P]: no triangle is between `eye` [3] and `points` [P, 3]."""
        return self.clear(np.broadcast_to(eye, points.shape), points)

    def clear(self, begin: NDArray, end: NDArray) -> NDArray[np.bool_]:
        """bool [P]: no triangle is between points `begin` [P, 3] and `end` [P, 3]; surfaces at `end` are ignored."""
        offset = end - begin
        length = np.linalg.norm(offset, axis=1)
        return self.cast(begin, offset).distance * length >= length - SLACK

    def escapes(self, eye: NDArray, directions: NDArray) -> NDArray[np.bool_]:
        """bool [R]: rays from `eye` [3] along `directions` [R, 3] hit nothing."""
        return self.cast(np.broadcast_to(eye, directions.shape), directions).face < 0
