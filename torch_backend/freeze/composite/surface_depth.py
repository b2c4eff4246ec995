"""Depth of frozen frames that a compositor can use: smooth on surfaces, with the edges of the frame's picture.

The median depth of splats is the depth of single Gaussians. A plane looks like shingles, and translucent Gaussians give
the depth behind them. The depth of static surfaces is therefore measured, once for all frames of a run:

1. Key views, spread over the clip, start from the inverse depth of the static splats.
2. Each key view's plate is compared with the plates of the key views around it. Gauss-Newton steps in inverse depth
   minimise their difference (Lucas and Kanade 1981, along epipolar lines). Pixels in motion mattes are left out.
   The noise of each pair of plates is measured around each pixel and gives the variance of the inverse depth.
3. After each step, planes are fitted to inverse depth in windows of two sizes, weighted by 1 / variance. The inverse
   depth of a plane is affine in the image, so planes stay planes. Each pixel averages the planes of the windows around
   it whose residuals their variance explains: a window across an edge is not planar (Kuwahara et al. 1976).

A frame takes its depth from the nearest key views: the value on which most of them and the splats agree. Moving
pixels, and pixels that no key view shows, keep the splats' depth. Planes are then fitted again in small windows. Each
pixel averages the planes of its neighbours that have a depth near the splats' and a similar colour in the frame's
picture: a joint bilateral filter of planes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...contract import NO_DEPTH
from ...motion.mattes import UNKNOWN, load_motion
from ...scene import Scene, evenly_spaced, read_image, resize_intrinsics
from ...shot import Shot
from ...torch_types import from_numpy
from ...train import LoadedRun
from ..frozen import FrozenGaussians, fade, freeze_at, render_frozen, span_of
from ..views.source_views import MARGIN
from ..views.working_plates import MEASURED_WIDTH, VIEWS
from .plane_filter import filtered
from .planes import Array, Planes, fit_planes, grid_of, smoothed, window_means

LEAST_INVERSE = 1e-4
"""Smallest inverse depth, in 1 / scene units. A clip's cameras extend over about one scene unit, so surfaces farther
than 10,000 units have no parallax."""
TO_SIGMA = 1.4826
"""Ratio of standard deviation to median absolute deviation for Gaussian errors."""
SAME = 3.0
"""Number of standard deviations within which two depths, or the brightness of two plates, belong to one surface."""
_QUANTUM = 1.0 / 255.0
"""Least standard deviation of a plate's brightness: a step of 8 bits."""
_SURE = 2.0
"""Slope, in standard deviations of the slope of 8-bit quantisation noise, below which it may be only noise."""
_SLOPE_NOISE = 12.0**0.5 / 8.0
"""Ratio of the standard deviation of `_slope` to that of the picture, for independent pixel noise."""


@dataclass(frozen=True)
class SurfaceDepthConfig:
    """Parameters of the surface depth. Lengths are in pixels of pictures `width` wide."""

    width: int = MEASURED_WIDTH
    """Width in pixels at which surfaces are measured; at most that of the working frames."""
    keys: int = VIEWS
    """Number of key views, spread evenly over the clip."""
    around: int = 6
    """Number of key views on either side with which a key view is compared. Also the number of nearest key views from
    which a frame takes its depth."""
    steps: int = 4
    """Number of Gauss-Newton steps."""
    radii: tuple[int, ...] = (3, 8)
    """Radii in pixels of the windows in which planes are fitted in key views. In a frame only the first is used; it is
    also the spacing of the nine windows that each pixel averages."""
    small: int = 2
    """Radius in pixels of the windows in which the noise of plates is measured, and a frame's splats are smoothed."""
    detail: float = 1.5
    """Standard deviation in pixels of the blur that is subtracted from plates, so that light and exposure cancel."""
    noise: float = 0.03
    """Relative standard deviation of the splats' inverse depth: their median error is 1.2 to 1.8 % on the tuning
    scenes arm-000 and arm-001."""
    uneven: float = 0.1
    """Scale of a window's mean squared residual, in units of variance, at which its weight falls off."""
    outlier: float = 1e-6
    """Probability that a pixel's splats belong to another surface than the pixel. Where a colour difference is less
    likely than this, depth edges follow the picture."""
    color: float = 0.1
    """Sigma of the colour difference between a pixel and a window, display-referred, in the bilateral filter."""


@dataclass
class KeyView:
    """A frame of the clip at which static surfaces are measured, at `SurfaceDepthConfig.width`."""

    viewmat: NDArray[np.float64]
    """[4, 4] world-to-camera, scene units."""
    K: NDArray[np.float64]
    """[3, 3] pixels."""
    picture: Array
    """[h, w] high-passed brightness of its plate."""
    still: Array
    """[h, w] 1 where its plate shows a static surface, else 0."""
    inverse: Array
    """[h, w] inverse depth of the static surfaces, in 1 / scene units."""
    sigma: Array
    """[h, w] standard deviation of `inverse`."""


class StillSurfaces:
    """Inverse depth of static surfaces at the key views of a clip. Construction takes seconds."""

    def __init__(self, keys: list[KeyView], config: SurfaceDepthConfig | None = None) -> None:
        """`keys` are in the clip's order and hold the splats' inverse depth, which is refined in place."""
        self.config, self.keys = config or SurfaceDepthConfig(), keys
        found: list[tuple[Array, Array]] = []
        for i, key in enumerate(keys):
            reach = range(max(0, i - self.config.around), min(len(keys), i + self.config.around + 1))
            found.append(refined(key, [keys[j] for j in reach if j != i], self.config))
        for key, (inverse, sigma) in zip(keys, found, strict=True):
            key.inverse, key.sigma = inverse, sigma

    def near(self, viewmat: NDArray[np.float64]) -> list[KeyView]:
        """The key views whose cameras are nearest to a camera (world-to-camera [4, 4]), nearest first."""
        centre = -viewmat[:3, :3].T @ viewmat[:3, 3]

        def distance(key: KeyView) -> float:
            offset = float(np.linalg.norm(-key.viewmat[:3, :3].T @ key.viewmat[:3, 3] - centre))
            return offset + float(np.linalg.norm(key.viewmat[2, :3] - viewmat[2, :3]))

        return sorted(self.keys, key=distance)[: self.config.around]


def key_picture(plate: Array, config: SurfaceDepthConfig) -> Array:
    """[h, w] high-passed brightness of a plate [h, w, 3]."""
    import cv2

    grey = plate.mean(2, dtype=np.float32)
    return np.asarray(grey - cv2.GaussianBlur(grey, (0, 0), config.detail), np.float32)


def refined(key: KeyView, neighbours: Sequence[KeyView], config: SurfaceDepthConfig) -> tuple[Array, Array]:
    """(inverse depth [h, w] of a key view at which plates agree, its standard deviation [h, w])."""
    start, inverse = key.inverse, key.inverse.copy()
    prior = 1.0 / np.square(start)  # relative error of 100 %: splats only count where plates have no texture
    variance = 1.0 / prior
    for _ in range(config.steps if neighbours else 1):
        information, pull, parallax = gauss_newton(key, neighbours, inverse, config)
        weight = information + prior
        step = (pull + prior * (start - inverse)) / weight
        pixel = 1.0 / np.maximum(parallax, 1e-3)  # a step of one pixel: the linearisation holds no further
        inverse, variance = smoothed(inverse + np.clip(step, -pixel, pixel), weight, config.radii, config.uneven)
        inverse = np.maximum(inverse, LEAST_INVERSE).astype(np.float32)
    return inverse, np.sqrt(variance).astype(np.float32)


def gauss_newton(
    key: KeyView, neighbours: Sequence[KeyView], inverse: Array, config: SurfaceDepthConfig
) -> tuple[Array, Array, Array]:
    """(information, pull, parallax) of a key view's inverse depth from the plates of `neighbours`, [h, w] each.

    Information is 1 / variance. Pull is information times the Gauss-Newton step. Parallax is the largest image motion
    in any of the plates, in pixels per unit of inverse depth.
    """
    information, pull, parallax = np.zeros_like(inverse), np.zeros_like(inverse), np.zeros_like(inverse)
    rays = rays_of(key.K, inverse.shape)
    for neighbour in neighbours:
        place = Place.of(key, neighbour, rays, inverse)
        shift = place.look(neighbour.picture) - key.picture
        slope = (
            place.look(_slope(neighbour.picture, 1)) * place.dx + place.look(_slope(neighbour.picture, 0)) * place.dy
        )
        clear = place.look(neighbour.inverse) < (1.0 + SAME * config.noise) * place.inverse
        weight = place.look(neighbour.still) * key.still * clear
        seen = weight > 0.5
        if not seen.any():
            continue
        count, square = window_means([weight, weight * np.square(shift)], config.small)
        noise = np.sqrt(np.maximum(square / np.maximum(count, 1e-6), _QUANTUM**2))
        # Robust weight: beyond SAME standard deviations two plates show different points.
        weight /= np.square(noise * (1.0 + np.square(shift / (SAME * noise))))
        # A slope within 8-bit quantisation noise carries no information on depth.
        steps = np.square(_SURE * _SLOPE_NOISE * _QUANTUM) * (np.square(place.dx) + np.square(place.dy))
        weight *= np.maximum(1.0 - steps / np.maximum(np.square(slope), 1e-20), 0.0)
        information += weight * slope * slope
        pull -= weight * slope * shift
        np.maximum(parallax, np.where(seen, np.hypot(place.dx, place.dy), 0.0), out=parallax)
    return information, pull, parallax


@dataclass
class Place:
    """Projection of the points of one view into another."""

    x: Array
    """[h, w] column in the other view, pixel centres at whole numbers."""
    y: Array
    """[h, w] row in the other view, pixel centres at whole numbers."""
    dx: Array
    """[h, w] derivative of x with respect to inverse depth, in pixels."""
    dy: Array
    """[h, w] derivative of y with respect to inverse depth, in pixels."""
    inverse: Array
    """[h, w] inverse depth in the other view; 0 behind its camera."""

    @classmethod
    def of(cls, view: KeyView, target: KeyView, rays: Array, inverse: Array) -> Place:
        """Projection of the points of `view` at inverse depth `inverse` [h, w] along `rays` [h, w, 3]."""
        turn, shift = between(view.viewmat, target.viewmat)
        points = rays @ turn.T + inverse[..., None] * shift
        in_front = points[..., 2] > 1e-3
        depth = np.where(in_front, points[..., 2], 1.0)
        fx, fy, cx, cy = (float(target.K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
        x, y = points[..., 0] / depth, points[..., 1] / depth
        dx, dy = (f * (shift[i] - at * shift[2]) / depth for i, f, at in ((0, fx, x), (1, fy, y)))
        outside = np.where(in_front, 0.0, -1e6).astype(np.float32)
        places = fx * x + (cx - 0.5) + outside, fy * y + (cy - 0.5), dx, dy, in_front * inverse / depth
        return cls(*(a.astype(np.float32) for a in places))

    def look(self, picture: Array) -> Array:
        """[h, w] a picture of the other view sampled at these points, 0 outside of it."""
        import cv2

        return cv2.remap(picture, self.x, self.y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)


def between(view: NDArray[np.float64], target: NDArray[np.float64]) -> tuple[Array, Array]:
    """(rotation [3, 3], translation [3]) from one world-to-camera [4, 4] to another."""
    turn = target[:3, :3] @ view[:3, :3].T
    return turn.astype(np.float32), (target[:3, 3] - turn @ view[:3, 3]).astype(np.float32)


def rays_of(K: NDArray[np.float64], size: tuple[int, ...]) -> Array:
    """[h, w, 3] rays of unit depth through the pixel centres."""
    x, y = np.meshgrid(np.arange(size[1]) + 0.5, np.arange(size[0]) + 0.5)
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], axis=-1)
    return rays.astype(np.float32)


def _slope(picture: Array, axis: int) -> Array:
    import cv2

    return cv2.Sobel(picture, cv2.CV_32F, axis, 1 - axis, ksize=3, scale=0.125)


@dataclass
class Splats:
    """The splats' render of a frame at its full size."""

    viewmat: NDArray[np.float64]
    """[4, 4] world-to-camera, scene units."""
    K: NDArray[np.float64]
    """[3, 3] pixels of the picture, overscan included."""
    inverse: Array
    """[H, W] inverse of the median depth, 0 where there is no splat."""
    moving: Array
    """[H, W] in 0..1: share of the pixel that moves in the clip."""


class Correction(Protocol):
    """Another measurement of the depth of movers (`measured_depth.InstantDepth`)."""

    def correction(self, view: KeyView, moving: Array) -> tuple[Array, Array]:
        """(factor for the splats' inverse depth in a view, relative standard deviation of the result), [h, w] each."""
        ...


def frame_depth(
    surfaces: StillSurfaces, splats: Splats, picture: Array, measured: Correction | None = None
) -> tuple[Array, Array]:
    """(inverse depth [H, W] of a frame, its standard deviation [H, W]), in 1 / scene units; 0 without a splat.

    `picture` [H, W, 3] is the finished frame, display-referred. `measured` corrects the depth of moving splats.
    """
    import cv2

    config = surfaces.config
    height, width = splats.inverse.shape
    # The focal length is that of the key views, so that overscan does not change the pixels of the frame.
    focal = float(surfaces.keys[0].K[0, 0]) if surfaces.keys else splats.K[0, 0] * config.width / width
    w = max(min(64, width), min(width, round(width * float(focal / splats.K[0, 0]))))
    h = max(8, round(height * w / width))
    inverse = cv2.resize(splats.inverse, (w, h), interpolation=cv2.INTER_NEAREST)
    moving = cv2.resize(splats.moving, (w, h), interpolation=cv2.INTER_AREA)
    K = splats.K.copy()
    K[0] *= w / width
    K[1] *= h / height
    still, mover = np.clip(1.0 - 2.0 * moving, 0.0, 1.0), moving > 0.5
    full_inverse, noise = splats.inverse, np.full_like(inverse, config.noise)
    if measured is not None:
        factor, noise = measured.correction(KeyView(splats.viewmat, K, inverse, still, inverse, inverse), mover)
        inverse = np.asarray(inverse * factor, np.float32)
        factor = np.asarray(cv2.resize(factor, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
        full_inverse = np.where(splats.moving > 0.5, full_inverse * factor, full_inverse)
    sigma = noise * np.maximum(inverse, LEAST_INVERSE)
    inverse, _ = smoothed(inverse, 1.0 / np.square(sigma), (config.small,), config.uneven)  # single splats stick out
    values, sigma = combined(surfaces, KeyView(splats.viewmat, K, inverse, still, inverse, sigma))
    # Movers and static surfaces are fitted separately, so that planes never span both.
    weight = 1.0 / np.square(np.maximum(sigma, LEAST_INVERSE * config.noise))
    still, moved = (fit_planes(values, weight * (of + 1e-9), config.radii[0]) for of in (~mover, mover))
    planes = Planes(*(np.where(mover, *pair) for pair in zip(moved, still, strict=True)))
    guide = np.concatenate([picture, (4.0 * config.color * (splats.moving > 0.5))[..., None]], axis=2, dtype=np.float32)
    small = cv2.resize(picture, (w, h), interpolation=cv2.INTER_AREA)
    small = np.concatenate([small, (4.0 * config.color * mover)[..., None]], axis=2, dtype=np.float32)
    return selected(planes, sigma, small, full_inverse, guide, config)


def combined(surfaces: StillSurfaces, view: KeyView) -> tuple[Array, Array]:
    """(inverse depth, its standard deviation), [h, w] each: the value on which most key views and the splats agree.

    `view` has the splats' inverse depth and its standard deviation. Only splats are used for movers.
    """
    rays, splats = rays_of(view.K, view.inverse.shape), np.maximum(view.inverse, LEAST_INVERSE).astype(np.float32)
    seen = [(splats, view.sigma), *(seen_in(key, view, rays, splats) for key in surfaces.near(view.viewmat))]
    values, sigmas = (np.stack(rows) for rows in zip(*seen, strict=True))
    votes = (sigmas > 0).astype(np.float32)
    votes[1:] *= (view.still > 0) / max(len(values) - 1, 1)  # key views share plates: together they have one vote
    all_votes = np.maximum(votes.sum(0), 1e-12)
    variances = np.square(np.maximum(sigmas, 1e-4 * splats))
    densities, means, spreads = (np.zeros_like(values) for _ in range(3))
    for i, (value, variance) in enumerate(zip(values, variances, strict=True)):
        squared_difference = np.square(values - value)
        densities[i] = (votes[i] > 0) * (
            votes * np.exp(-0.5 * squared_difference / variances) / np.sqrt(variances)
        ).sum(0)
        agree = votes * np.exp(-0.5 * squared_difference / (variances + variance))
        weight = agree / variances
        total = np.maximum(weight.sum(0), 1e-12)
        means[i] = (weight * values).sum(0) / total
        # The values that disagree may be right, with a probability of their share of the votes.
        doubt = agree * weight / total + (votes - agree) / all_votes
        spreads[i] = 1.0 / total + (doubt * np.square(values - means[i])).sum(0)
    # The value of highest density wins. Density is divided by sigma, because an uncertain value agrees with all others.
    # A high power replaces the maximum, so that rounding cannot switch the winner.
    share = (densities / np.maximum(densities.max(0), 1e-12)) ** 8
    share /= np.maximum(share.sum(0), 1e-12)
    mean = (share * means).sum(0)
    variance = (share * (spreads + np.square(means - mean))).sum(0)
    return mean.astype(np.float32), np.sqrt(variance).astype(np.float32)


def seen_in(key: KeyView, view: KeyView, rays: Array, inverse: Array) -> tuple[Array, Array]:
    """(inverse depth of a view's points, from a key view, its standard deviation), [h, w] each.

    The standard deviation is 0 where the key view has no depth. `inverse` [h, w] is the initial guess. A point's pixel
    in the key view depends on its depth, so two fixed-point iterations are made.
    """
    turn, shift = between(view.viewmat, key.viewmat)
    along_axis = (rays @ turn.T)[..., 2]

    def refine(inverse: Array) -> tuple[Array, Array]:
        place = Place.of(view, key, rays, inverse)
        depth = place.look(key.inverse)
        better = depth * along_axis / np.maximum(1.0 - depth * shift[2], 1e-3)
        better = np.maximum(np.where(depth > 0, better, inverse), LEAST_INVERSE).astype(np.float32)
        return better, np.where(depth > 0, place.look(key.sigma) * better / np.maximum(depth, LEAST_INVERSE), 0.0)

    return refine(refine(inverse)[0])


def selected(
    planes: Planes, sigma: Array, small: Array, splats: Array, picture: Array, config: SurfaceDepthConfig
) -> tuple[Array, Array]:
    """(inverse depth [H, W] of a picture, its standard deviation [H, W]): per pixel from the planes around it.

    Args:
        planes: [h, w], fitted at a lower resolution.
        sigma: [h, w] standard deviation of the planes' values.
        small: [h, w, C] the frame's picture at the resolution of the planes.
        splats: [H, W] the splats' inverse depth, 0 where there is no splat.
        picture: [H, W, C] the frame.
    """
    import cv2

    rows, columns = (axis.astype(np.float32) for axis in grid_of(planes.value.shape))
    level = planes.value - planes.along * columns - planes.down * rows
    maps = [level, planes.along, planes.down, planes.fits(config.uneven), np.square(sigma)]
    rough = np.asarray(cv2.medianBlur(splats, 3), np.float32)
    out, deviation = filtered(
        np.concatenate([np.stack(maps, axis=-1), small], axis=2), rough, picture, config.radii[0], config.noise,
        config.outlier, config.color, LEAST_INVERSE,
    )  # fmt: skip
    return np.where(splats > 0, out, 0.0), np.where(splats > 0, deviation, 0.0)


class FrameDepths:
    """Makes compositor-ready depth of a run's frozen frames. Static surfaces are measured at the first frame."""

    def __init__(self, run: LoadedRun, scene: Scene, config: SurfaceDepthConfig | None = None) -> None:
        self.run, self.scene, self.config = run, scene, config or SurfaceDepthConfig()
        self._surfaces: StillSurfaces | None = None

    @property
    def surfaces(self) -> StillSurfaces:
        """The run's static surfaces. They do not depend on t*, so that the order of frames changes nothing."""
        if self._surfaces is None:
            frozen = freeze_at(self.run.model, 0.5, span_of(self.scene, self.run))
            still = fade(frozen, (frozen.motion < 0.5).float())
            shot = Shot(self.scene.folder.parent)
            frames = [f for f in self.run.train_frames if shot.plate(f).is_file()]
            chosen = [frames[i] for i in evenly_spaced(len(frames), min(self.config.keys, len(frames)))]
            self._surfaces = StillSurfaces([self._key(shot, frame, still) for frame in chosen], self.config)
        return self._surfaces

    @torch.no_grad()
    def of(
        self, viewmat: Tensor, K: Tensor, depth: Tensor, motion: Tensor, picture: Tensor,
        measured: Correction | None = None,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """(depth, its standard deviation) of a frozen frame, [H, W] each in scene units; 1e10 and 0 without a splat.

        Args:
            viewmat: [4, 4] world-to-camera, scene units.
            K: [3, 3] pixels of the picture, overscan included.
            depth: [H, W] the splats' median depth.
            motion: [H, W] in 0..1, share of the pixel that moves in the clip.
            picture: [H, W, 3] the finished frame, display-referred.
            measured: correction by the artist's depth map of the instant; None without a map.
        """
        has_depth = depth < NO_DEPTH
        inverse = torch.where(has_depth, 1.0 / depth.clamp(1.0 / 1e4, 1.0 / LEAST_INVERSE), 0.0)
        splats = Splats(viewmat.double().numpy(), K.double().numpy(), inverse.numpy(), motion.numpy())
        clipped = picture.clamp(0.0, 1.0).numpy()
        found, sigma = (from_numpy(a) for a in frame_depth(self.surfaces, splats, clipped, measured))
        refined = torch.where(has_depth, 1.0 / found.clamp_min(LEAST_INVERSE), NO_DEPTH)
        return refined, torch.where(has_depth, sigma * refined.square(), 0.0)

    def _key(self, shot: Shot, frame: int, still: FrozenGaussians) -> KeyView:
        import cv2

        i, scene = self.scene.frames.index(frame), self.scene
        width = min(self.config.width, scene.width)
        height = max(8, round(scene.height * width / scene.width))
        K = resize_intrinsics(scene.Ks[i][None], scene.width, scene.height, width, height)[0]
        image = render_frozen(still, scene.viewmats[i], K, width, height).cpu()
        inverse = (1.0 / image.depth.clamp(1.0 / 1e4, 1.0 / LEAST_INVERSE)).numpy()
        plate = read_image(shot.plate(frame), width, height, scene.display).numpy()
        moving = load_motion(shot, frame)
        clear = np.ones((height, width), np.float32)
        if moving is not None:
            moving = cv2.resize(moving, (width, height), interpolation=cv2.INTER_NEAREST)
            around = np.ones((2 * MARGIN + 1, 2 * MARGIN + 1), np.uint8)
            clear[cv2.dilate(moving, around) > UNKNOWN] = 0.0
        pose = scene.viewmats[i].double().numpy(), K.double().numpy()
        return KeyView(*pose, key_picture(plate, self.config), clear, inverse, self.config.noise * inverse)
