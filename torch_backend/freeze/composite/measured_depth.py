"""Depth of movers in a frozen instant, from the artist's depth map of plate t*.

Only one plate shows a mover at t*, so its depth cannot be triangulated; a depth map supplies it. Where a frozen frame
shows the same splats as plate t*, their inverse depth and the map's are averaged, weighted by 1 / variance. The map's
variance comes from its fit. The splats' variance is the variance of their difference from the map, minus the map's
variance.
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
"""Array of float32, if not stated otherwise."""
_UNKNOWN = 1.0
"""Relative standard deviation above which a depth map's value is ignored; `_instant` fills holes with such values."""
_AROUND = 15
"""Side in pixels of a window. Pixels at a mover's outline without a correction take the mean correction in it."""


@dataclass
class InstantDepth:
    """Depth map of plate t*, for one frozen instant."""

    splats: KeyView
    """Plate t*'s camera, with the inverse depth of the instant's splats."""
    measured: KeyView
    """Plate t*'s camera, with the map's inverse depth and its standard deviation."""
    splat_noise: float
    """Relative standard deviation of the inverse depth of moving splats."""
    noise: float
    """Relative standard deviation of the inverse depth of static splats."""

    def correction(self, view: KeyView, moving: Array) -> tuple[Array, Array]:
        """(factor for the inverse depth of a frame's splats, relative standard deviation of the result), [h, w] each.

        Args:
            view: the frame's camera with its splats' inverse depth [h, w].
            moving: bool [h, w], True where the splats move; elsewhere the factor is 1.
        """
        rays, inverse = rays_of(view.K, view.inverse.shape), np.maximum(view.inverse, LEAST_INVERSE).astype(np.float32)
        splat_inverse, _ = seen_in(self.splats, view, rays, inverse)
        found, sigma = seen_in(self.measured, view, rays, inverse)
        relative_sigma = np.maximum(sigma / np.maximum(found, LEAST_INVERSE), 1e-4)
        near = SAME * np.sqrt(np.square(relative_sigma) + self.splat_noise**2)
        known = (
            moving
            & (sigma > 0)
            & (relative_sigma < _UNKNOWN)
            & (np.abs(splat_inverse / inverse - 1.0) < SAME * self.noise)
        )
        known &= np.abs(found / inverse - 1.0) < near
        weight, prior = 1.0 / np.square(relative_sigma), 1.0 / self.splat_noise**2
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
    """The artist's depth maps for a run's instants. The last instant is cached."""

    def __init__(self, run: LoadedRun, scene: Scene, config: SurfaceDepthConfig | None = None) -> None:
        """JobError (TRAIN) if the run's maps are damaged."""
        self.scene, self.config = scene, config or SurfaceDepthConfig()
        self._maps = run.depth()
        self._at: tuple[float, InstantDepth | None] | None = None

    def at(self, t_star: float, frozen: FrozenGaussians) -> InstantDepth | None:
        """Depth of the instant at frame t*. None if that frame has no map, or if nothing moves in it."""
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
        image = render_frozen(frozen, scene.viewmats[i], K, width, height).cpu()
        splats = (1.0 / image.depth.clamp(1.0 / 1e4, 1.0 / LEAST_INVERSE)).numpy()
        inverse, sigma = found.numpy()
        has_depth = inverse > 0
        moving = has_depth & (image.motion.numpy() > 0.5)
        if not moving.any():
            return None
        map_noise = float(np.median(sigma[moving] / inverse[moving]))
        spread = TO_SIGMA * float(np.median(np.abs(inverse[moving] / splats[moving] - 1.0)))
        splat_noise = float(np.sqrt(max(spread**2 - map_noise**2, self.config.noise**2)))
        pose = scene.viewmats[i].double().numpy(), K.double().numpy()
        # Holes of the map get the splats' depth with a standard deviation above `_UNKNOWN`.
        measured = np.where(has_depth, inverse, splats), np.where(has_depth, sigma, 10.0 * splats)
        none = np.zeros_like(splats)
        return InstantDepth(
            KeyView(*pose, none, none, splats, self.config.noise * splats),
            KeyView(*pose, none, none, *(a.astype(np.float32) for a in measured)),
            splat_noise,
            self.config.noise,
        )
