"""Flat panes of window glass and mirrors: ray intersection and reflection.

Panes are not among the scene's triangles. render_bpy.py renders the world behind a pane without it, and the reflection
separately, and mixes both by the pane's reflectance. World in metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .noise import Array

GLASS, MIRROR = "glass", "mirror"
GLASS_INDEX = 2.333
"""Index of refraction of one surface that reflects 16 % at normal incidence, like four surfaces of double glazing."""
MIRROR_SHARE = 0.95
"""Share of the light reflected by a mirror."""


@dataclass(frozen=True)
class Pane:
    """A rectangle that reflects on the side of the cross product `along` × `up`."""

    kind: str
    """GLASS or MIRROR."""
    origin: Array
    """[3] one corner."""
    along: Array
    """[3] one side, as a vector."""
    up: Array
    """[3] the other side, perpendicular to `along`."""

    @classmethod
    def of(cls, kind: str, origin: ArrayLike, along: ArrayLike, up: ArrayLike) -> Pane:
        """A pane from anything that numpy can convert."""
        return cls(kind, *(np.asarray(v, np.float64) for v in (origin, along, up)))

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Pane:
        """Inverse of `to_json`."""
        return cls.of(data["kind"], data["origin"], data["along"], data["up"])

    def to_json(self) -> dict[str, Any]:
        """The pane's entry in plan.json."""
        return {"kind": self.kind, **{name: getattr(self, name).tolist() for name in ("origin", "along", "up")}}

    @property
    def normal(self) -> Array:
        """[3] unit normal of the reflecting side."""
        normal = np.cross(self.along, self.up)
        return normal / np.linalg.norm(normal)

    def within(self, points: Array, margin: float = 0.0) -> NDArray[np.bool_]:
        """bool [...]: points [..., 3] that project along the normal into the rectangle widened by `margin` metres."""
        inside = np.ones(points.shape[:-1], bool)
        for side in (self.along, self.up):
            length = np.linalg.norm(side)
            at = (points - self.origin) @ side / length
            inside &= (at >= -margin) & (at <= length + margin)
        return inside

    def above(self, points: Array) -> Array:
        """[...] signed distance in metres of points [..., 3] in front of the pane's plane."""
        return (points - self.origin) @ self.normal

    def distance_to(self, eye: Array, rays: Array) -> Array:
        """[R] lengths at which rays [R, 3] from `eye` [3] hit the reflecting side; inf without a hit."""
        toward = rays @ self.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.where(toward < 0, -self.above(eye) / toward, np.inf)
        hit = np.isfinite(distance) & (distance > 0)
        hit[hit] = self.within(eye + rays[hit] * distance[hit, None])
        return np.where(hit, distance, np.inf)

    def mirrored(self, points: Array) -> Array:
        """[..., 3] mirror images of points [..., 3]."""
        return points - 2.0 * self.above(points)[..., None] * self.normal

    def turned_back(self, rays: Array) -> Array:
        """[..., 3] reflected directions."""
        return rays - 2.0 * (rays @ self.normal)[..., None] * self.normal
