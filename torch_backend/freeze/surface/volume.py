"""Truncated signed distance function (TSDF) of a frozen scene, averaged over the depth of many views.

The method is that of Curless and Levoy, "A Volumetric Method for Building Complex Models from Range Images" (SIGGRAPH
1996). Only blocks of voxels near surfaces are stored (Nießner et al. 2013). Voxels grow with the distance from the
cameras: they are uniform in a contracted space (as in Barron et al., "Mip-NeRF 360", 2022, with a logarithm).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

SIDE = 8
"""Number of voxels along each edge of a block."""
# Number of bits per coordinate in a block's key: a million blocks along each axis.
_BITS = 20
# Number of blocks that are processed at once: 4 MB per float of a voxel.
_CHUNK = 2048


@dataclass(frozen=True)
class SurfaceConfig:
    """Parameters of the fusion of a surface."""

    width: int = 320
    """Largest width in pixels at which depth is fused: that of `SurfaceDepthConfig`, at which it is measured."""
    views: int = 24
    """Largest number of evenly spaced frames of a take that are fused: each takes 1 s of one core."""
    truncation: float = 4.0
    """Distance from the surface, in voxels, at which signed distances are truncated. It is 1.5 to 3 % of the distance
    from the cameras, so that views with the splats' depth error of 1 to 2 % give one surface."""
    near: float = 0.1
    """Quantile of depth up to which voxels have the same size; beyond, they grow with the distance from the cameras."""
    far: float = 0.995
    """Quantile of depth beyond which nothing is fused, so that stray pixels do not stretch the volume."""
    voxels: int = 3_000_000
    """Largest number of voxels. Voxels are enlarged until there are no more than this. Each takes 8 bytes, and about 12
    while a surface is extracted."""
    part: float = 0.005
    """Share of all triangles below which a separate piece is dropped as noise, unless most views confirm it."""


@dataclass(frozen=True, eq=False)
class View:
    """One frozen frame, at the resolution at which it is fused."""

    viewmat: NDArray[np.float64]
    """[4, 4] world-to-camera, OpenCV axes."""
    K: NDArray[np.float64]
    """[3, 3] pixels, centres at +0.5."""
    depth: NDArray[np.float32]
    """[h, w] depth along the camera's axis; 0 if unknown."""
    sigma: NDArray[np.float32]
    """[h, w] standard deviation of `depth`, in the same units."""
    color: NDArray[np.uint8]
    """[h, w, 3] sRGB picture."""
    motion: NDArray[np.float32]
    """[h, w] in 0..1: share of the pixel that moves in the clip."""

    def seen(self, points: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        """(column, row, depth) of points [N, M, 3] in this view, float32 [N, M]; pixel centres at whole numbers.

        Points behind the camera get column and row -2.
        """
        moved = points @ self.viewmat[:3, :3].T.astype(points.dtype) + self.viewmat[:3, 3].astype(points.dtype)
        depth = moved[..., 2]
        is_in_front = depth > 0.0
        safe_depth = np.where(is_in_front, depth, 1.0)
        x = np.where(is_in_front, self.K[0, 0] * moved[..., 0] / safe_depth + (self.K[0, 2] - 0.5), -2.0)
        y = np.where(is_in_front, self.K[1, 1] * moved[..., 1] / safe_depth + (self.K[1, 2] - 0.5), -2.0)
        return x.astype(np.float32), y.astype(np.float32), depth.astype(np.float32)

    def look(self, picture: NDArray[Any], x: NDArray[Any], y: NDArray[Any], nearest: bool = False) -> NDArray[Any]:
        """A picture of the view sampled at pixels [N, M], N below 32768; 0 outside of it."""
        method = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
        return cv2.remap(picture, x, y, method, borderMode=cv2.BORDER_CONSTANT, borderValue=0)

    def depth_at(self, x: NDArray[Any], y: NDArray[Any], edge: NDArray[Any]) -> NDArray[Any]:
        """[N, M] depth at pixels, 0 if unknown: interpolated on a surface, that of the nearest pixel at an edge.

        `edge` [N, M] is the difference in depth above which two pixels show two surfaces.
        """
        known = np.where(self.depth > 0, self.depth, np.float32(np.nan))
        between = cv2.remap(known, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan"))
        nearest = self.look(self.depth, x, y, nearest=True)
        return np.where(np.abs(nearest - between) < edge, between, nearest)


@dataclass(frozen=True, eq=False)
class Contraction:
    """A space in which distances from a centre beyond `radius` are replaced by their logarithm."""

    centre: NDArray[np.float64]
    """[3] mean of the camera centres."""
    radius: float
    """Distance up to which the space is not contracted."""

    def scale(self, points: NDArray[Any]) -> NDArray[Any]:
        """[...] size of voxels along the ray at points [..., 3], relative to voxels within the radius."""
        offset = points - self.centre.astype(points.dtype)
        return np.maximum(np.sqrt((offset * offset).sum(-1)) / self.radius, 1.0).astype(points.dtype)

    def into(self, points: NDArray[Any]) -> NDArray[Any]:
        """Points [..., 3] in the contracted space."""
        # Far pixels resolve less, and their depth is less exact, so voxels grow with the distance.
        scale = self.scale(points)[..., None]
        return self.centre + (points - self.centre) * ((1.0 + np.log(scale)) / scale)

    def back(self, points: NDArray[Any]) -> NDArray[Any]:
        """Inverse of `into`."""
        offset = points - self.centre
        scale = np.exp(np.maximum(np.sqrt((offset * offset).sum(-1, keepdims=True)) / self.radius, 1.0) - 1.0)
        return self.centre + offset * (scale / (1.0 + np.log(scale)))


@dataclass(frozen=True, eq=False)
class Volume:
    """Signed distances near surfaces, relative to `cut`: positive in front of a surface, negative behind it."""

    keys: NDArray[np.int64]
    """[B] keys of the blocks, ascending; see `block_keys`."""
    distance: NDArray[np.float32]
    """[B, 8, 8, 8] signed distances, indexed by x, y, z; NaN if unknown."""
    voxel: float
    """Edge of a voxel in the contracted space; the centre of voxel (0, 0, 0) of block (0, 0, 0) is the origin."""
    cut: float
    """Distance from the surface at which signed distances are truncated, in the contracted space."""
    space: Contraction
    """The space in which voxels are uniform."""


def block_keys(blocks: NDArray[Any]) -> NDArray[np.int64]:
    """[...] int64 key of each block [..., 3] (integers); keys sort like the blocks' coordinates."""
    x, y, z = np.moveaxis(blocks.astype(np.int64) + (1 << _BITS - 1), -1, 0)
    return (x << 2 * _BITS) + (y << _BITS) + z


def blocks_of(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """[B, 3] blocks of keys [B]: the inverse of `block_keys`."""
    mask = (1 << _BITS) - 1
    return np.stack([keys >> 2 * _BITS, (keys >> _BITS) & mask, keys & mask], -1) - (1 << _BITS - 1)


def contraction(views: Sequence[View], config: SurfaceConfig) -> Contraction:
    """The contracted space for the surfaces in views. ValueError if no view has depth."""
    seen = [v.depth[v.depth > 0] for v in views if (v.depth > 0).any()]
    if not seen:
        raise ValueError("no view has any depth")
    centres = [-v.viewmat[:3, :3].T @ v.viewmat[:3, 3] for v in views]
    return Contraction(np.mean(centres, axis=0), float(np.quantile(np.concatenate(seen), config.near)))


def resolved(views: Sequence[View], space: Contraction) -> float:
    """Median width of a pixel of the views in the contracted space: the resolution of depth."""
    widths: list[NDArray[Any]] = []
    for view in views:
        points, rows, columns = unprojected(view)
        widths.append(view.depth[rows, columns] / view.K[0, 0] / space.scale(points))
    return float(np.median(np.concatenate(widths)))


def fuse(
    views: Sequence[View], config: SurfaceConfig | None = None, voxel: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> Volume:  # fmt: skip
    """Fuses the depth of views. ValueError if no view has depth.

    Args:
        views: views of one static scene.
        config: parameters of the fusion.
        voxel: smallest edge of a voxel in the contracted space; None: the width of a pixel.
        progress: called with the finished share in 0..1.
    """
    config = config or SurfaceConfig()
    space = contraction(views, config)
    voxel = resolved(views, space) if voxel is None else voxel
    while True:
        cut = config.truncation * voxel
        keys = _near_surfaces(views, voxel, cut, space)
        if len(keys) * SIDE**3 <= config.voxels:
            break
        voxel *= 1.25
    total, weight = (np.zeros((len(keys), SIDE**3), np.float32) for _ in range(2))
    inside = np.stack(np.meshgrid(*[np.arange(SIDE)] * 3, indexing="ij"), -1).reshape(1, -1, 3)
    for first in range(0, len(keys), _CHUNK):
        if progress is not None:
            progress(first / len(keys))
        part = slice(first, first + _CHUNK)
        corners = blocks_of(keys[part])[:, None] * SIDE
        points = space.back((corners + inside) * voxel).astype(np.float32)
        cuts = cut * space.scale(points)
        for view in views:
            _add(total[part], weight[part], view, points, cuts)
    distance = np.where(weight > 0.0, total / np.maximum(weight, 1e-20), np.nan).astype(np.float32)
    return Volume(keys, distance.reshape(-1, SIDE, SIDE, SIDE), voxel, cut, space)


def unprojected(view: View, offset: NDArray[Any] | float = 0.0) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """(points [N, 3] of a view's pixels with depth, their rows, their columns); `offset` [N] is added to the depth."""
    rows, columns = np.nonzero(view.depth > 0)
    depth = view.depth[rows, columns].astype(np.float64)
    rays = np.stack(
        [
            (columns + 0.5 - view.K[0, 2]) / view.K[0, 0],
            (rows + 0.5 - view.K[1, 2]) / view.K[1, 1],
            np.ones_like(depth),
        ],
        -1,
    )
    return (rays * (depth + offset)[:, None] - view.viewmat[:3, 3]) @ view.viewmat[:3, :3], rows, columns


def _near_surfaces(views: Sequence[View], voxel: float, cut: float, space: Contraction) -> NDArray[np.int64]:
    """Keys of the blocks that the views' rays cross within `cut` of the surface."""
    found: list[NDArray[np.int64]] = []
    steps = np.linspace(-cut, cut, 1 + 2 * math.ceil(2 * cut / (SIDE * voxel)))  # steps of at most half a block
    for view in views:
        scale = space.scale(unprojected(view)[0])
        for offset in steps:
            points = space.into(unprojected(view, offset * scale)[0])
            # Half a voxel is added, because the centres of a block's first voxels are on its border.
            found.append(np.unique(block_keys(np.floor((points / voxel + 0.5) / SIDE))))
    return np.unique(np.concatenate(found))


def _add(total: NDArray[Any], weight: NDArray[Any], view: View, points: NDArray[Any], cuts: NDArray[Any]) -> None:
    """Adds a view's signed distances at voxel centres `points` [B, 512, 3], truncated at `cuts` [B, 512]."""
    x, y, depth = view.seen(points)
    height, width = view.depth.shape
    rows = np.flatnonzero(((x > -1) & (x < width) & (y > -1) & (y < height)).any(1))
    if not len(rows):
        return
    x, y, depth, cuts = x[rows], y[rows], depth[rows], cuts[rows]
    surface = view.depth_at(x, y, cuts)
    distance = (surface - depth) / cuts
    # Beyond the truncation behind a surface, a view knows nothing (Curless and Levoy 1996).
    is_valid = (surface > 0.0) & (distance > -1.0)
    sigma = view.look(view.sigma, x, y, nearest=True)
    # DepthSigma only weights: a view with a large error counts less, it is not excluded.
    trust = np.where(is_valid, 1.0 / (1.0 + np.square(sigma / cuts)), 0.0).astype(np.float32)
    total[rows] += trust * np.minimum(distance, 1.0)
    weight[rows] += trust
