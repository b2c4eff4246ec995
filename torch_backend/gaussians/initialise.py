"""Where the Gaussians start: the sparse points, and seeds for what has no point.

COLMAP leaves walls and skin almost empty. Pixels far from any sparse point are lifted to the depth of the nearest
points in the same image: right to within a furniture's width, which a few hundred steps repair, and better than
holes that densification must fill from the rims (measured on the bundled clip: docs/benchmarks.md).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..scene import Scene, evenly_spaced
from ..torch_types import from_numpy
from .model import SH_C0, Gaussians, sh_bases
from .neighbours import nearest

_PIXELS_PER_SEED = 100
"""A small picture needs no more seeds than one per so many pixels of a frame."""


@dataclass
class InitConfig:
    """How many Gaussians to start with, and how they look."""

    seeds: int = 8000
    """Seeds lifted from pixels without a sparse point near them, over all frames together."""
    frames: int = 12
    """Training frames that seeds are lifted from, evenly over the clip."""
    opacity: float = 0.1
    """Starting opacity of sparse points (3DGS create_from_pcd: 0.1)."""
    seed_opacity: float = 0.1
    """Starting opacity of seeds."""
    sh_degree: int = 2
    """Highest SH degree the model can hold."""
    min_scale: float = 1e-4
    """Smallest starting scale in scene units."""


def initialise(
    scene: Scene,
    images: Tensor,
    indices: list[int],
    bins: int,
    config: InitConfig,
    generator: torch.Generator,
    budget: int,
    ignored: Mapping[int, Tensor] | None = None,
) -> Gaussians:
    """Gaussians from sparse points and seeds, on the CPU, where the scene is.

    Args:
        scene: the scene; its points [P, 3].
        images: [I, H, W, 3] training frames, display-referred, on any device.
        indices: [I] frame of the scene that each image shows.
        bins: time bins of the support bitmap.
        budget: most Gaussians to start with; a random choice is kept.
        ignored: frame of the scene -> bool [H, W] which pixels of it are no part of the scene: none of them is lifted.
    """
    points, colors = scene.points, scene.colors
    opacity = torch.full((len(points),), config.opacity, device="cpu")
    if config.seeds > 0:
        picked = evenly_spaced(len(indices), config.frames)
        each = min(config.seeds // len(picked), images.shape[1] * images.shape[2] // _PIXELS_PER_SEED)
        seeds = [
            _lift_seeds(scene, images[n], indices[n], each, generator, (ignored or {}).get(indices[n])) for n in picked
        ]
        points = torch.cat([points, *(s[0] for s in seeds)])
        colors = torch.cat([colors, *(s[1] for s in seeds)])
        opacity = torch.cat([opacity, opacity.new_full((len(points) - len(opacity),), config.seed_opacity)])
    finite = points.isfinite().all(1)
    points, colors, opacity = points[finite], colors[finite], opacity[finite]
    if len(points) > budget:
        kept = torch.randperm(len(points), generator=generator, device="cpu")[:budget]
        points, colors, opacity = points[kept], colors[kept], opacity[kept]
    if len(points) < 4:
        raise ValueError(f"the solve left {len(points)} points: at least 4 are needed to start")
    scales = neighbour_distance(points).clamp_min(config.min_scale)
    count = len(points)
    quats = points.new_zeros(count, 4)
    quats[:, 0] = 1.0
    params = {
        "means": points.clone(),
        "quats": quats,
        "log_scales": scales.log()[:, None].repeat(1, 3),
        "opacity_logits": torch.logit(opacity),
        "sh0": ((colors - 0.5) / SH_C0)[:, None, :],
        "shN": points.new_zeros(count, sh_bases(config.sh_degree) - 1, 3),
    }
    return Gaussians(params, bins)


def neighbour_distance(points: Tensor) -> Tensor:
    """Root mean squared distance to the 3 nearest neighbours (3DGS create_from_pcd), float32 [N]; fewer if there are
    fewer points, 0 for a point alone.

    points [N, 3] on the CPU. ValueError if one is not finite.
    """
    if not bool(points.isfinite().all()):
        raise ValueError("points must be finite")
    others = min(3, len(points) - 1)
    if others < 1:
        return torch.zeros(len(points), device="cpu")
    distances = nearest(points.numpy(), points.numpy(), others + 1, workers=-1)[0][:, 1:]
    return from_numpy(np.sqrt((distances**2).mean(1))).float()


def _lift_seeds(
    scene: Scene, image: Tensor, index: int, count: int, generator: torch.Generator, ignored: Tensor | None
) -> tuple[Tensor, Tensor]:
    """`count` pixels of one frame, preferably far from sparse points, at a depth between their neighbours' in it.

    Fewer if some of them are `ignored`, bool [H, W].
    """
    height, width = image.shape[:2]
    K = scene.camera_at(width, height)[index]
    viewmat = scene.viewmats[index]
    camera = scene.points @ viewmat[:3, :3].T + viewmat[:3, 3]
    in_front = camera[:, 2] > 1e-3
    pixels = (camera[:, :2] / camera[:, 2:].clamp_min(1e-3)) * K[[0, 1], [0, 1]] + K[:2, 2]
    limits = torch.tensor([width, height], device="cpu")
    seen = in_front & ((pixels >= 0) & (pixels < limits)).all(1)
    if seen.sum() < 4:
        return scene.points[:0], scene.colors[:0]
    candidates = torch.rand(4 * count, 2, generator=generator, device="cpu") * limits
    distance, neighbours = (from_numpy(found) for found in nearest(pixels[seen].numpy(), candidates.numpy(), 4))
    far = distance[:, 0].argsort(descending=True, stable=True)[: 2 * count]
    # Half the far ones: a bare top-k would put every seed into the largest hole.
    keep = far[torch.randperm(len(far), generator=generator, device="cpu")[:count]]
    weights = 1.0 / (distance[keep] + 1.0)
    depth = (weights * camera[seen][:, 2][neighbours[keep]]).sum(1) / weights.sum(1)
    chosen = candidates[keep]
    rays = torch.cat([(chosen - K[:2, 2]) / K[[0, 1], [0, 1]], chosen.new_ones(len(chosen), 1)], dim=1)
    local = rays * depth.float()[:, None]
    world = (local - viewmat[:3, 3]) @ viewmat[:3, :3]
    rows, columns = chosen[:, 1].long().clamp(0, height - 1), chosen[:, 0].long().clamp(0, width - 1)
    if ignored is not None:
        free = ~ignored[rows, columns]
        world, rows, columns = world[free], rows[free], columns[free]
    return world, image[rows, columns].float().cpu()
