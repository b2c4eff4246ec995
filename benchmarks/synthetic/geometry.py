"""Textured triangle shapes for rooms and furniture. Metres, z up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .noise import Array


@dataclass
class Mesh:
    """V vertices, F triangles."""

    vertices: NDArray[np.float32]
    """[V, 3] metres."""
    triangles: NDArray[np.int32]
    """[F, 3]."""
    uv: NDArray[np.float32]
    """[F, 3, 2] texture coordinates per corner, v upwards."""
    material: NDArray[np.int32]
    """[F] index into the scene's materials."""


def turn(yaw: float) -> Array:
    """[3, 3] rotation by `yaw` radians about z."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


class Builder:
    """Collects the faces of one mesh. A material's scale is its picture's size in metres; 0 stretches it over a
    face."""

    def __init__(self, scales: list[float]) -> None:
        self.scales = scales
        self.corners: list[Array] = []
        self.uvs: list[Array] = []
        self.materials: list[int] = []

    def rect(self, origin: ArrayLike, along: ArrayLike, up: ArrayLike, material: int) -> None:
        """Adds a rectangle from `origin` along two vectors (metres), facing their cross product `along` × `up`."""
        o, a, b = (np.asarray(v, np.float64) for v in (origin, along, up))
        self._quad(np.array([o, o + a, o + a + b, o + b]), float(np.linalg.norm(a)), float(np.linalg.norm(b)), material)

    def box(
        self, centre: ArrayLike, size: ArrayLike, material: int, yaw: float = 0.0, front: int | None = None
    ) -> None:
        """Adds a box centred at `centre`; the side towards local -y may have another material."""
        centre, half = np.asarray(centre, np.float64), np.asarray(size, np.float64) / 2
        rotation = turn(yaw)
        for axis in range(3):
            a, b = (axis + 1) % 3, (axis + 2) % 3
            if axis == 1:
                a, b = 0, 2
            for sign in (-1.0, 1.0):
                normal = np.zeros(3)
                normal[axis] = sign
                along, up = np.zeros(3), np.zeros(3)
                along[a], up[b] = 2 * half[a], 2 * half[b]
                if np.cross(along, up) @ normal < 0:
                    along = -along
                corner = normal * half - along / 2 - up / 2
                used = front if front is not None and axis == 1 and sign < 0 else material
                self.rect(centre + rotation @ corner, rotation @ along, rotation @ up, used)

    def cylinder(self, base: ArrayLike, radius: float, height: float, material: int, sides: int = 28) -> None:
        """Adds an upright column without a bottom; `base` is the centre of its foot."""
        base = np.asarray(base, np.float64)
        angles = np.linspace(0.0, 2 * np.pi, sides + 1)
        ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(sides + 1)], 1) * radius
        length = 2 * np.pi * radius / sides
        up = np.array([0.0, 0.0, height])
        for i in range(sides):
            low, high = base + ring[i], base + ring[i + 1]
            self._quad(
                np.array([low, high, high + up, low + up]), length, height, material, (i * length, 0.0), sides * length
            )
            self._quad(np.array([base + up, low + up, high + up, base + up]), radius, length, material)

    def ball(self, centre: ArrayLike, radii: ArrayLike, material: int, sides: int = 20, rings: int = 12) -> None:
        """Adds an ellipsoid."""
        centre, radii = np.asarray(centre, np.float64), np.asarray(radii, np.float64)
        phi, theta = np.linspace(0, 2 * np.pi, sides + 1), np.linspace(-np.pi / 2, np.pi / 2, rings + 1)

        def at(i: int, j: int) -> Array:
            unit = [np.cos(theta[j]) * np.cos(phi[i]), np.cos(theta[j]) * np.sin(phi[i]), np.sin(theta[j])]
            return centre + radii * unit

        width, height = 2 * np.pi * radii[0] / sides, np.pi * radii[2] / rings
        for j in range(rings):
            for i in range(sides):
                quad = np.array([at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)])
                self._quad(quad, width, height, material, (i * width, j * height), sides * width, rings * height)

    def _quad(
        self,
        corners: Array,
        width: float,
        height: float,
        material: int,
        start: tuple[float, float] = (0.0, 0.0),
        whole_width: float = 0.0,
        whole_height: float = 0.0,
    ) -> None:
        scale = self.scales[material]
        over = np.array([scale, scale] if scale else [whole_width or width, whole_height or height])
        uv = (np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]]) + start) / over
        for order in ([0, 1, 2], [0, 2, 3]):
            triangle = corners[order]
            # At the poles of balls and on the lids of columns, half of a quad has no area.
            if np.linalg.norm(np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0])) > 1e-9:
                self.corners.append(triangle)
                self.uvs.append(uv[order])
                self.materials.append(material)

    def mesh(self) -> Mesh:
        """The mesh of all added faces."""
        count = len(self.materials)
        return Mesh(
            np.asarray(self.corners, np.float32).reshape(-1, 3),
            np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
            np.asarray(self.uvs, np.float32).reshape(-1, 3, 2),
            np.asarray(self.materials, np.int32),
        )
