"""Depth of what moves in a frozen instant, by the artist's depth map of plate t*.

Only one plate shows a mover at t*, so no parallax gives its depth; a depth map does. Where the splats of a frozen frame
are those that plate t* shows, their inverse depth and the map's are averaged, each weighted by its variance. The map's
variance is that of its fit. The splats' variance is that of their difference from the map, less the map's variance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ...scene import Scene, resize_intrinsics
from ...train import LoadedRun
from ..frozen import FrozenGaussians, render_frozen
from .surface_depth import LEAST_INVERSE, SAME, TO_SIGMA, KeyView, SurfaceDepthConfig, rays_of, seen_in

Array = NDArray[Any]
"""float32 unless it says otherwise."""
_UNKNOWN = 1.0
"""Relative standard deviation from which on a map counts as knowing nothing: so holes are filled, see `_instant`."""
_AROUND = 15
"""Side in pixels of the windows whose mean correction a mover's pixel takes that has none of its own: its outline."""


@dataclass
class InstantDepth:
    """What the depth map of plate t* says of one frozen instant."""

    splats: KeyView
    """Plate t*'s camera, with the inverse depth of the instant's splats."""
    measured: KeyView
    """The same camera with the map's inverse depth, and its standard deviation."""
    splat_noise: float
    """Standard deviation of the inverse depth of splats that move, as a share of it."""
    noise: float
    """That of splats that stand still."""

    def correction(self, view: KeyView, moving: Array) -> tuple[Array, Array]:
        """(factor of the inverse depth of a frame's splats, their relative standard deviation after it), [h, w] each.

        Args:
            view: the frame's camera with its splats' inverse depth [h, w].
            moving: bool [h, w] where these move; elsewhere the factor is 1.
        """
        rays, inverse = rays_of(view.K, view.inverse.shape), np.maximum(view.inverse, LEAST_INVERSE).astype(np.float32)
        shown, _ = seen_in(self.splats, view, rays, inverse)
        found, sigma = seen_in(self.measured, view, rays, inverse)
        own = np.maximum(sigma / np.maximum(found, LEAST_INVERSE), 1e-4)
        near = SAME * np.sqrt(np.square(own) + self.splat_noise**2)
        known = moving & (sigma > 0) & (own < _UNKNOWN) & (np.abs(shown / inverse - 1.0) < SAME * self.noise)
        known &= np.abs(found / inverse - 1.0) < near
        weight, prior = 1.0 / np.square(own), 1.0 / self.splat_noise**2
        factor = 1.0 + weight / (weight + prior) * (found / inverse - 1.0)
        count, total = (
            cv2.blur(part.astype(np.float32), (_AROUND, _AROUND), borderType=cv2.BORDER_CONSTANT)
            for part in (known, np.where(known, factor, 0.0))
        )
        around = np.where(count > 0.5 / _AROUND**2, total / np.maximum(count, 1e-6), 1.0)
        factor = np.where(known, factor, np.where(moving, around, 1.0))
        deviation = np.where(known, 1.0 / np.sqrt(weight + prior), np.where(moving, self.splat_noise, self.noise))
        return factor.astype(np.float32), deviation.astype(np.float32)


class MeasuredDepths:
    """What the artist's depth maps say of a run's instants; nothing for a run without maps."""

    def __init__(self, run: LoadedRun, scene: Scene, config: SurfaceDepthConfig | None = None) -> None:
        """JobError (TRAIN) if the run's maps are damaged."""
        self.scene, self.config = scene, config or SurfaceDepthConfig()
        self._maps = run.depth()
        self._at: tuple[float, InstantDepth | None] | None = None

    def at(self, t_star: float, frozen: FrozenGaussians) -> InstantDepth | None:
        """Of the instant at frame t*, frozen; None without a map of that frame, or where nothing moves in it."""
        if self._maps is None:
            return None
        if self._at is None or self._at[0] != t_star:
            self._at = t_star, self._instant(t_star, frozen)
        return self._at[1]

    @torch.no_grad()
    def _instant(self, t_star: float, frozen: FrozenGaussians) -> InstantDepth | None:
        frame, scene = round(t_star), self.scene
        found = self._maps.at(frame) if self._maps is not None and frame == t_star and frame in scene.frames else None
        if found is None:
            return None
        i, (height, width) = scene.frames.index(frame), found.shape[1:]
        K = resize_intrinsics(scene.Ks[i][None], scene.width, scene.height, width, height)[0]
        image = render_frozen(frozen, scene.viewmats[i], K, width, height)
        splats = (1.0 / image.depth.clamp(1.0 / 1e4, 1.0 / LEAST_INVERSE)).numpy()
        inverse, sigma = found.numpy()
        has_depth = inverse > 0
        moving = has_depth & (image.motion.numpy() > 0.5)
        if not moving.any():
            return None
        own = float(np.median(sigma[moving] / inverse[moving]))
        apart = TO_SIGMA * float(np.median(np.abs(inverse[moving] / splats[moving] - 1.0)))
        splat_noise = float(np.sqrt(max(apart**2 - own**2, self.config.noise**2)))
        pose = scene.viewmats[i].double().numpy(), K.double().numpy()
        # Where the map knows nothing it agrees with the splats, and is not sure of it.
        measured = np.where(has_depth, inverse, splats), np.where(has_depth, sigma, 10.0 * splats)
        none = np.zeros_like(splats)
        return InstantDepth(
            KeyView(*pose, none, none, splats, self.config.noise * splats),
            KeyView(*pose, none, none, *(a.astype(np.float32) for a in measured)),
            splat_noise,
            self.config.noise,
        )
