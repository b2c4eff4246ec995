"""Shadow of a ball on a surface by ray casting, as seen by a shadow catcher, and the similarity of two shadows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.report.metrics import ssim_map
from benchmarks.synthetic.rays import RayScene
from benchmarks.synthetic.regions import View

RADIUS = 0.15
"""Radius of the ball in metres."""
TO_LAMP = np.array([0.8, -0.5, 1.2])
"""Offset from the ball to the lamp's centre in metres, about 1.5 long to stay below ceilings."""
LAMP = 0.1
"""Radius of the lamp, a horizontal disc, in metres. It gives the shadow an edge a few pixels wide."""
SAMPLES = 32
"""Number of sampled points of the lamp."""


@dataclass(frozen=True, eq=False)
class Set:
    """A ball and a lamp, in metres."""

    ball: NDArray[np.float64]
    """[3] centre of the ball."""
    lamps: NDArray[np.float64]
    """[SAMPLES, 3] sampled points of the lamp."""

    @classmethod
    def on(cls, place: NDArray[np.float64]) -> Set:
        """A ball resting on a point [3], z up, with its lamp."""
        n = np.arange(SAMPLES) + 0.5
        radius, turn = (
            LAMP * np.sqrt(n / SAMPLES),
            n * np.pi * (3.0 - np.sqrt(5.0)),
        )  # sunflower spiral for even spacing
        disc = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.zeros(SAMPLES)], axis=1)
        ball = place + np.array([0.0, 0.0, RADIUS])
        return cls(ball, ball + TO_LAMP + disc)

    def stops(self, begin: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.bool_]:
        """bool [...]: whether the ball blocks the segment between points `begin` and `end`, each [..., 3]."""
        along, offset = end - begin, self.ball - begin
        share = np.clip((offset * along).sum(-1) / np.maximum((along * along).sum(-1), 1e-20), 0.0, 1.0)
        return np.asarray(np.linalg.norm(share[..., None] * along - offset, axis=-1) < RADIUS)


def places_of(truth: RayScene, view: View) -> list[NDArray[np.float64]]:
    """Surface points for a resting ball, seen at a quarter, half and three quarters of a low pixel row."""
    at = [(int(share * view.width), int(0.8 * view.height)) for share in (0.25, 0.5, 0.75)]
    rays = view.rays().reshape(view.height, view.width, 3)
    found = [(ray, truth.cast(view.eye[None], ray[None]).distance[0]) for ray in (rays[y, x] for x, y in at)]
    return [view.eye + ray * float(distance) for ray, distance in found if np.isfinite(distance)]


def shadow(surface: RayScene, view: View, of: Set) -> NDArray[np.float32]:
    """[H, W] in 0..1: share of the lamp's light that passes the ball, at the surface point of each pixel.

    1 where no surface is visible or the surface itself blocks all light, because a shadow catcher is empty there.
    """
    rays = view.rays()
    distance = surface.cast(np.broadcast_to(view.eye, rays.shape), rays).distance.astype(np.float64)
    points = view.eye + rays * np.where(np.isfinite(distance), distance, 0.0)[:, None]
    stopped = of.stops(points[:, None], of.lamps) & np.isfinite(distance)[:, None]
    left = np.ones(len(rays), np.float32)
    rows = np.flatnonzero(stopped.any(1))
    ends = np.repeat(points[rows], SAMPLES, axis=0)
    arrives = surface.clear(np.tile(of.lamps, (len(rows), 1)), ends).reshape(-1, SAMPLES)
    lit = arrives.sum(1)
    left[rows] = np.where(lit > 0, 1.0 - (arrives & stopped[rows]).sum(1) / np.maximum(lit, 1), 1.0)
    return left.reshape(view.height, view.width)


def likeness(surface: RayScene, truth: RayScene, view: View, of: Set) -> float | None:
    """Mean SSIM of the shadows on a surface and on the true one, over pixels in either shadow not hidden by the ball.

    None if neither has a shadow.
    """
    pair = np.stack([shadow(one, view, of) for one in (surface, truth)])
    rays = view.rays()
    hits = truth.cast(np.broadcast_to(view.eye, rays.shape), rays).distance[:, None]
    ends = view.eye + rays * np.where(np.isfinite(hits), hits, 1e3)
    hidden = of.stops(np.broadcast_to(view.eye, ends.shape), ends).reshape(view.height, view.width)
    pair[:, hidden] = 1.0
    dark = torch.from_numpy((pair.min(0) < 1.0) & ~hidden)
    found = ssim_map(*(torch.from_numpy(one)[..., None] for one in pair))
    return float(found[dark].mean()) if bool(dark.any()) else None
