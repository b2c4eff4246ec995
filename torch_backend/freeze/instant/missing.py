"""What plate t* shows moving and the scene lacks, set where it stood: a waving hand, an arm raised for a moment.

The field learns from all frames, and what only a few of them show is in none of its states. Developing would paint it
onto whatever lies behind. Plate t* shows it, but not how far away it is: it is as deep as what it hangs on, the parts
of the scene beside it that are nearer than what the scene shows in its place. Its pixels become Gaussians of the
plate's colours at that depth, and what the field has astray there is hidden. What hangs on nothing is left to
developing.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...gaussians.model import SH_C0
from ...scene import Scene
from ...torch_types import from_numpy
from ...train import LoadedRun
from ...train.model import gathered
from ..frozen import FrozenGaussians, FrozenImage, render_frozen
from ..views.reproject import beyond, blurred, dilate, pixel_centres, unproject
from ..views.scene_flow import HIDDEN
from ..views.source_views import LENGTHS_OF, MovingOf, VisibilityConfig
from ..views.working_plates import SEEN, WorkingPlates


@dataclass(frozen=True)
class MissingConfig:
    """What is missing, and of what Gaussians it is made."""

    plates: VisibilityConfig = field(default_factory=VisibilityConfig)
    """How pictures and depths are compared."""
    sigma: float = 0.6
    """Standard deviation of the Gaussian of one pixel, in pixels: neighbours blend, and outlines stay."""


@torch.no_grad()
def with_missing(
    run: LoadedRun, scene: Scene, frozen: FrozenGaussians, t_star: int, moving: MovingOf,
    config: MissingConfig | None = None,
) -> FrozenGaussians:  # fmt: skip
    """The scene without what the field has astray and, behind its rows, Gaussians of what plate t* shows moving and it
    lacks.

    Args:
        frozen: the run's scene at t*.
        t_star: frame number. The plate of one that was not trained on is not looked at.
        moving: what moves in the clip's frames.
    """
    config = config or MissingConfig()
    if t_star not in run.train_frames:
        return frozen
    plates, time = WorkingPlates(scene, LENGTHS_OF, moving), scene.time_of_frame(t_star)
    viewmat, K, width, height = plates.camera(t_star)
    picture, matte, ignored = plates.picture(t_star), plates.matte(t_star), plates.ignored(t_star)
    matte = matte if ignored is None else matte * (~ignored).float()
    unit, moves = width / LENGTHS_OF, frozen.motion > 0.5

    def shown(scene: FrozenGaussians) -> FrozenImage:
        return render_frozen(scene, viewmat, K, width, height, run.model.exposure, time)

    # What the field has where the plate shows something else is astray, and tells no depth.
    wrong = matte * nowhere(picture, shown(frozen).color, unit, config.plates)
    weights = torch.stack([wrong, torch.ones_like(wrong)], dim=-1).to(moves.device)
    inside, whole = gathered(frozen.state, viewmat.to(moves.device), K.to(moves.device), width, height, weights).T
    frozen = _without(frozen, moves & (whole > SEEN) & (inside > 0.5 * whole))
    missing, inverse = found(picture, shown(frozen), shown(_without(frozen, moves)), matte, unit, config.plates)
    at = missing > 0.5
    depth, colour = 1.0 / inverse[at], picture[at]
    if run.model.exposure.config.on:
        gain, offset = (value.cpu() for value in run.model.exposure.at(time))
        colour = (colour - offset) / gain
    added = {
        "means": unproject(pixel_centres(width, height)[at], depth, viewmat, K),
        "quats": torch.tensor([1.0, 0.0, 0.0, 0.0], device="cpu").expand(len(depth), 4),
        "log_scales": (config.sigma * depth / K[0, 0]).log()[:, None].expand(-1, 3),
        "opacity_logits": torch.logit(missing[at].clamp_max(0.99)),
        "sh0": ((colour - 0.5) / SH_C0)[:, None],
        "shN": torch.zeros(len(depth), *frozen.state["shN"].shape[1:], device="cpu"),
    }
    ones = frozen.support.new_ones(len(depth))
    return FrozenGaussians(
        {name: torch.cat([value, added[name].to(value)]) for name, value in frozen.state.items()},
        frozen.sh_degree, torch.cat([frozen.support, ones]), torch.cat([frozen.motion, ones]),
    )  # fmt: skip


def found(
    picture: Tensor, image: FrozenImage, behind: FrozenImage, matte: Tensor, unit: float, config: VisibilityConfig
) -> tuple[Tensor, Tensor]:
    """([h, w] in 0..1 how much of each pixel is missing and hangs on something, [h, w] its inverse depth).

    Args:
        picture: [h, w, 3] plate t*, display-referred.
        image: the frozen scene as its camera sees it, scene units; behind: the same without what moves.
        matte: [h, w] in 0..1, what moves.
        unit: pixels to one of 640.
    """
    sigma, reach = 2.0 * config.margin * unit, max(1, round(2.0 * config.margin * unit))

    def unlike(shown: FrozenImage) -> Tensor:
        return _sure((picture - shown.color).abs().amax(-1), config)

    # Where the plate shows what is behind, the scene shows something too much, and lacks nothing.
    absent, other = (nowhere(picture, each.color, unit, config) for each in (image, behind))
    gone = matte * torch.minimum(absent, other)
    outline = torch.minimum(unlike(image), unlike(behind))
    inverse, near = 1.0 / image.depth.clamp_min(1e-6), blurred(gone, sigma)
    hidden = blurred(gone * inverse, sigma) / near.clamp_min(1e-6)
    nearer = (inverse / hidden.clamp_min(1e-12) - 1.0).clamp_min(0.0) / config.depth_tolerance
    holds = (1.0 - absent) * (1.0 - torch.exp(-nearer.square())) * (near > 1e-6)
    depths = _depths(dilate(gone > 0.5, 2 * reach), gone, holds, inverse, 2.0 * np.pi * sigma**2)
    return torch.minimum(gone, outline) * (depths > 0.0).float(), depths


def nowhere(picture: Tensor, shown: Tensor, unit: float, config: VisibilityConfig) -> Tensor:
    """[h, w] in 0..1: how sure a plate shows something that a render has nowhere near. Splats are soft, and a little
    off. Both [h, w, 3], display-referred."""
    margin = config.margin * unit
    return _sure(beyond(blurred(picture, margin), blurred(shown, margin), max(1, round(2.0 * margin))), config)


def _sure(difference: Tensor, config: VisibilityConfig) -> Tensor:
    return 1.0 - torch.exp(-(difference / config.unexplained).square())


def _without(frozen: FrozenGaussians, hidden: Tensor) -> FrozenGaussians:
    """A scene in which the rows `hidden`, bool [N], are not to be seen."""
    opacity = torch.where(hidden, HIDDEN, frozen.state["opacity_logits"])
    return replace(frozen, state={**frozen.state, "opacity_logits": opacity})


def _depths(around: Tensor, gone: Tensor, holds: Tensor, inverse: Tensor, least: float) -> Tensor:
    """[h, w] inverse depth of the regions of `around`, bool: the median of what holds them; 0 where nothing does, and
    where less than `least` pixels are `gone`, which is less than the low-pass that found them."""
    count, labels = cv2.connectedComponents(around.byte().numpy())
    regions = np.asarray(labels, np.int32)
    weights, values, amounts = (each.numpy() for each in (holds, inverse, gone))
    deep = np.zeros(count, np.float32)
    for n in range(1, count):
        of = regions == n
        holding = of & (weights > 0.0)
        if holding.any() and amounts[of].sum() >= least:
            deep[n] = weighted_median(values[holding], weights[holding])
    return from_numpy(deep[regions])


def weighted_median(values: NDArray[np.float32], weights: NDArray[np.float32]) -> float:
    """Of values [N] with weights [N]: half of the weight lies on either side."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])
