"""Initial Gaussians: from the sparse points, points of still surfaces, and seeds for regions without points.

COLMAP finds almost no points on walls and skin. Motion detection knows the depth of most still surfaces, textured or
not (`solve.surface`), and training starts from a random sample of these points. Pixels far from any point become seeds
at the depth of the nearest points in the same image. Their error is about the width of a piece of furniture, and a few
hundred steps correct it. Holes, which densification must fill from their edges, are worse (docs/decisions.md has
figures for both). Larger errors are not corrected: a man in front of a plain wall whose seeds get the depth of a person
in front of him is not reconstructed, and is taken for motion.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..scene import Scene, evenly_spaced, surface_of
from ..torch_types import from_numpy
from .model import SH_C0, Gaussians, sh_bases
from .neighbours import nearest

_OUTLIERS = 0.005
"""Share of the sparse points at either end of each axis that is ignored when the scene's bounds are measured."""
_PIXELS_PER_SEED = 100
"""Least number of pixels per seed in a frame, which limits the number of seeds of small images."""


@dataclass
class InitConfig:
    """Number and appearance of the initial Gaussians."""

    surface: int = 20_000
    """Maximum number of points of still surfaces; also limited to a third of the budget."""
    seeds: int = 8000
    """Number of seeds in all frames together, lifted from pixels far from any point."""
    frames: int = 12
    """Number of training frames from which seeds are lifted, evenly spaced over the clip."""
    opacity: float = 0.1
    """Initial opacity of points (3DGS create_from_pcd: 0.1)."""
    seed_opacity: float = 0.1
    """Initial opacity of seeds."""
    sh_degree: int = 2
    """Highest SH degree that the model can store."""
    min_scale: float = 1e-4
    """Smallest initial scale in scene units."""


def initialise(
    scene: Scene, images: Tensor, indices: list[int], bins: int, config: InitConfig, generator: torch.Generator,
    budget: int, ignored: Mapping[int, Tensor] | None = None, depth: Callable[[int], Tensor | None] | None = None,
) -> Gaussians:  # fmt: skip
    """Initial Gaussians from points and seeds, on the CPU. ValueError if there are fewer than 4 points.

    Args:
        scene: scene with its points [P, 3], on the CPU.
        images: [I, H, W, 3] display-referred training frames, on any device.
        indices: [I] index of each image in the scene's frames.
        bins: number of time bins of the support bitmap.
        budget: maximum number of initial Gaussians; a random subset is kept.
        ignored: index of a scene frame -> bool [H, W] ignored pixels, which give no seeds.
        depth: frame number -> [2, h, w] inverse depth (0: unknown) and its standard deviation, used for seeds.
    """
    points, colors = _known(scene, indices, min(config.surface, budget // 3), generator)
    known = points, colors
    opacity = torch.full((len(points),), config.opacity, device="cpu")
    if config.seeds > 0:
        picked = evenly_spaced(len(indices), config.frames)
        seeds_per_frame = min(config.seeds // len(picked), images.shape[1] * images.shape[2] // _PIXELS_PER_SEED)
        seeds = [
            _lift_seeds(
                scene,
                known,
                images[n],
                indices[n],
                seeds_per_frame,
                generator,
                (ignored or {}).get(indices[n]),
                None if depth is None else depth(scene.frames[indices[n]]),
            )
            for n in picked
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
    """Root mean square distance to the 3 nearest neighbours (3DGS create_from_pcd), float32 [N].

    Uses fewer neighbours if there are fewer points; 0 for a single point. points: [N, 3] on the CPU. ValueError if one
    is not finite.
    """
    if not bool(points.isfinite().all()):
        raise ValueError("points must be finite")
    neighbours = min(3, len(points) - 1)
    if neighbours < 1:
        return torch.zeros(len(points), device="cpu")
    distances = nearest(points.numpy(), points.numpy(), neighbours + 1, workers=-1)[0][:, 1:]
    return from_numpy(np.sqrt((distances**2).mean(1))).float()


def _known(scene: Scene, indices: list[int], most: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """(points [P, 3], colours [P, 3]): all sparse points, and up to `most` random points of still surfaces.

    Surface points found in held-out frames (solved frames that are not in `indices`) are left out. So are points far
    outside of the sparse points' bounds.
    """
    points, colors, frames = surface_of(scene)
    held_out = {scene.frames[i] for i in scene.solved} - {scene.frames[i] for i in indices}
    if not len(points) or not len(scene.points):
        return scene.points, scene.colors
    low, high = (torch.quantile(scene.points[:, None], at, dim=0)[0] for at in (_OUTLIERS, 1.0 - _OUTLIERS))
    room = 0.5 * (high - low)
    kept = ((points > low - room) & (points < high + room)).all(1)
    kept &= torch.tensor([frame not in held_out for frame in frames], device="cpu")
    places = kept.nonzero()[:, 0]
    sample = places[torch.randperm(len(places), generator=generator, device="cpu")[:most]]
    return torch.cat([scene.points, points[sample]]), torch.cat([scene.colors, colors[sample]])


def _lift_seeds(
    scene: Scene, known: tuple[Tensor, Tensor], image: Tensor, index: int, count: int, generator: torch.Generator,
    ignored: Tensor | None, measured: Tensor | None,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """(points, colours) of up to `count` pixels of one frame that are far from the `known` points.

    Their depth is interpolated from the nearest known points in the image. Where `measured` [2, h, w] (inverse depth
    and its standard deviation) is known, it is used instead. Pixels in `ignored`, bool [H, W], are left out.
    """
    height, width = image.shape[:2]
    K = scene.camera_at(width, height)[index]
    viewmat = scene.viewmats[index]
    camera = known[0] @ viewmat[:3, :3].T + viewmat[:3, 3]
    in_front = camera[:, 2] > 1e-3
    pixels = (camera[:, :2] / camera[:, 2:].clamp_min(1e-3)) * K[[0, 1], [0, 1]] + K[:2, 2]
    limits = torch.tensor([width, height], device="cpu")
    seen = in_front & ((pixels >= 0) & (pixels < limits)).all(1)
    if seen.sum() < 4:
        return known[0][:0], known[1][:0]
    candidates = torch.rand(4 * count, 2, generator=generator, device="cpu") * limits
    distance, neighbours = (from_numpy(found) for found in nearest(pixels[seen].numpy(), candidates.numpy(), 4))
    far = distance[:, 0].argsort(descending=True, stable=True)[: 2 * count]
    # A random half of the farthest candidates: the farthest alone would all lie in the largest hole.
    keep = far[torch.randperm(len(far), generator=generator, device="cpu")[:count]]
    weights = 1.0 / (distance[keep] + 1.0)
    depth = (weights * camera[seen][:, 2][neighbours[keep]]).sum(1) / weights.sum(1)
    chosen = candidates[keep]
    if measured is not None:
        at = (chosen / limits * torch.tensor(measured[0].T.shape, device="cpu")).long()
        inverse = measured[0, at[:, 1], at[:, 0]]
        depth = torch.where(inverse > 0, 1.0 / inverse.clamp_min(1e-6), depth)
    rays = torch.cat([(chosen - K[:2, 2]) / K[[0, 1], [0, 1]], chosen.new_ones(len(chosen), 1)], dim=1)
    local = rays * depth.float()[:, None]
    world = (local - viewmat[:3, 3]) @ viewmat[:3, :3]
    rows, columns = chosen[:, 1].long().clamp(0, height - 1), chosen[:, 0].long().clamp(0, width - 1)
    if ignored is not None:
        free = ~ignored[rows, columns]
        world, rows, columns = world[free], rows[free], columns[free]
    return world, image[rows, columns].float().cpu()
