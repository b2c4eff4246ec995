"""The shadow of a ball on a surface, by rays: what a shadow catcher shows of it, and how alike two of them are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.report.metrics import ssim_map
from benchmarks.synthetic.rays import RayScene
from benchmarks.synthetic.regions import View

RADIUS = 0.15
"""Metres: that of the ball."""
TO_LAMP = np.array([0.8, -0.5, 1.2])
"""Metres from the ball to the middle of the lamp: about 1.5, so that it hangs below ceilings."""
LAMP = 0.1
"""Metres: radius of the lamp, a level disc. It gives the shadow an edge a few pixels wide."""
SAMPLES = 32
"""Points of the lamp that light is sampled at."""


@dataclass(frozen=True, eq=False)
class Set:
    """A ball and a lamp, in metres."""

    ball: NDArray[np.float64]
    """[3] the middle of the ball."""
    lamps: NDArray[np.float64]
    """[SAMPLES, 3] points of the lamp."""

    @classmethod
    def on(cls, place: NDArray[np.float64]) -> Set:
        """A ball that rests on a place [3], z up."""
        n = np.arange(SAMPLES) + 0.5
        away, turn = LAMP * np.sqrt(n / SAMPLES), n * np.pi * (3.0 - np.sqrt(5.0))  # a sunflower's seeds: even
        disc = np.stack([away * np.cos(turn), away * np.sin(turn), np.zeros(SAMPLES)], axis=1)
        ball = place + np.array([0.0, 0.0, RADIUS])
        return cls(ball, ball + TO_LAMP + disc)

    def stops(self, begin: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.bool_]:
        """[...] whether the ball lies between points [..., 3] and points [..., 3]."""
        along, off = end - begin, self.ball - begin
        share = np.clip((off * along).sum(-1) / np.maximum((along * along).sum(-1), 1e-20), 0.0, 1.0)
        return np.asarray(np.linalg.norm(share[..., None] * along - off, axis=-1) < RADIUS)


def places_of(truth: RayScene, view: View) -> list[NDArray[np.float64]]:
    """Points of a surface on which a ball can rest: seen at a quarter, half and three quarters of a row low down."""
    at = [(int(share * view.width), int(0.8 * view.height)) for share in (0.25, 0.5, 0.75)]
    rays = view.rays().reshape(view.height, view.width, 3)
    found = [(ray, truth.cast(view.eye[None], ray[None]).distance[0]) for ray in (rays[y, x] for x, y in at)]
    return [view.eye + ray * float(distance) for ray, distance in found if np.isfinite(distance)]


def shadow(surface: RayScene, view: View, of: Set) -> NDArray[np.float32]:
    """[H, W] in 0..1: what the ball leaves of the lamp's light on the surface that each pixel shows.

    1 where nothing is shown, or where the surface itself keeps all light away: a shadow catcher shows nothing there.
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
    """Mean SSIM of the shadows on a surface and on the true one, where either is and the ball does not hide it.

    None if neither shows any.
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
