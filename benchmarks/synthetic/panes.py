"""Flat panes: window glass, and mirrors. Where a ray meets one, and what it shows there by reflection.

A pane is no part of the scene's triangles: the world behind it is rendered without it, its reflection by itself, and
the two are mixed by how much it reflects (render_bpy.py). World in metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .noise import Array

GLASS, MIRROR = "glass", "mirror"
GLASS_INDEX = 2.333
"""Index of refraction whose one surface reflects 16 % straight on: what the four surfaces of double glazing do."""
MIRROR_SHARE = 0.95
"""Of the light, that a mirror gives back."""


@dataclass(frozen=True)
class Pane:
    """A rectangle that reflects to the side along x up."""

    kind: str
    """GLASS or MIRROR."""
    origin: Array
    """[3] one corner."""
    along: Array
    """[3] one side."""
    up: Array
    """[3] the other, square to it."""

    @classmethod
    def of(cls, kind: str, origin: ArrayLike, along: ArrayLike, up: ArrayLike) -> Pane:
        """From anything that numpy reads."""
        return cls(kind, *(np.asarray(v, np.float64) for v in (origin, along, up)))

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Pane:
        """Inverse of `to_json`."""
        return cls.of(data["kind"], data["origin"], data["along"], data["up"])

    def to_json(self) -> dict[str, Any]:
        """As it stands in plan.json."""
        return {"kind": self.kind, **{name: getattr(self, name).tolist() for name in ("origin", "along", "up")}}

    @property
    def normal(self) -> Array:
        """[3] unit, towards the side that reflects."""
        normal = np.cross(self.along, self.up)
        return normal / np.linalg.norm(normal)

    def within(self, points: Array, margin: float = 0.0) -> NDArray[np.bool_]:
        """[...] whether points [..., 3], seen along the normal, lie in the rectangle widened by `margin` metres."""
        inside = np.ones(points.shape[:-1], bool)
        for side in (self.along, self.up):
            length = np.linalg.norm(side)
            at = (points - self.origin) @ side / length
            inside &= (at >= -margin) & (at <= length + margin)
        return inside

    def above(self, points: Array) -> Array:
        """[...] metres by which points [..., 3] stand before the pane's plane."""
        return (points - self.origin) @ self.normal

    def distance_to(self, eye: Array, rays: Array) -> Array:
        """[R] lengths of the rays [R, 3] from `eye` [3] at which they meet the side that reflects; inf where not."""
        toward = rays @ self.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.where(toward < 0, -self.above(eye) / toward, np.inf)
        hit = np.isfinite(distance) & (distance > 0)
        hit[hit] = self.within(eye + rays[hit] * distance[hit, None])
        return np.where(hit, distance, np.inf)

    def mirrored(self, points: Array) -> Array:
        """[..., 3] where the images of points [..., 3] stand."""
        return points - 2.0 * self.above(points)[..., None] * self.normal

    def turned_back(self, rays: Array) -> Array:
        """[..., 3] directions after the reflection."""
        return rays - 2.0 * (rays @ self.normal)[..., None] * self.normal
