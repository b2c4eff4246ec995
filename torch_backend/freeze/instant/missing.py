"""Adds Gaussians for movers that plate t* shows and the frozen scene lacks, such as a waving hand.

The deformation field learns from all frames, so it has no state with an object that only a few frames show. Developing
would paint the object onto the surfaces behind it. Plate t* shows the object, but not its depth. The object therefore
gets the depth of the surface to which it is attached. This is the median over adjacent pixels at which the scene is
nearer than at the missing object. Floaters of the field that the plate contradicts are hidden first. An object that is
attached to nothing is left to developing.
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
    """Parameters to find missing movers, and the size of their Gaussians."""

    plates: VisibilityConfig = field(default_factory=VisibilityConfig)
    """Tolerances for comparing pictures and depths."""
    sigma: float = 0.6
    """Standard deviation of an added Gaussian, in pixels of plate t*; one is added per missing pixel. The value is
    small enough to keep outlines and large enough for neighbours to blend."""


@torch.no_grad()
def with_missing(
    run: LoadedRun, scene: Scene, frozen: FrozenGaussians, t_star: int, moving: MovingOf,
    config: MissingConfig | None = None,
) -> FrozenGaussians:  # fmt: skip
    """The frozen scene with floaters hidden, and with Gaussians of missing movers appended after its rows.

    Args:
        frozen: the run's scene at t*.
        t_star: frame number. If it was not trained on, the scene is returned unchanged.
        moving: motion mattes of the clip's frames.
    """
    config = config or MissingConfig()
    if t_star not in run.train_frames:
        return frozen
    plates, time = WorkingPlates(scene, LENGTHS_OF, moving), scene.time_of_frame(t_star)
    viewmat, K, width, height = plates.camera(t_star)
    picture, matte, ignored = plates.picture(t_star), plates.matte(t_star), plates.ignored(t_star)
    matte = matte if ignored is None else matte * (~ignored).float()
    unit, moves = width / LENGTHS_OF, frozen.motion > 0.5

    def rendered(scene: FrozenGaussians) -> FrozenImage:
        return render_frozen(scene, viewmat, K, width, height, run.model.exposure, time).cpu()

    # A moving Gaussian is a floater if plate t* contradicts most of its visible contribution. It could be mistaken for
    # the surface that a hand is attached to, and the hand would be placed too near.
    wrong = matte * mismatch(picture, rendered(frozen).color, unit, config.plates)
    weights = torch.stack([wrong, torch.ones_like(wrong)], dim=-1).to(moves.device)
    inside, total = gathered(frozen.state, viewmat.to(moves.device), K.to(moves.device), width, height, weights).T
    frozen = _hiding(frozen, moves & (total > SEEN) & (inside > 0.5 * total))
    missing, inverse = missing_pixels(
        picture, rendered(frozen), rendered(_hiding(frozen, moves)), matte, unit, config.plates
    )
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
    added_ones = frozen.support.new_ones(len(depth))
    return FrozenGaussians(
        {name: torch.cat([value, added[name].to(value)]) for name, value in frozen.state.items()},
        frozen.sh_degree, torch.cat([frozen.support, added_ones]), torch.cat([frozen.motion, added_ones]),
    )  # fmt: skip


def missing_pixels(
    picture: Tensor, image: FrozenImage, background: FrozenImage, matte: Tensor, unit: float, config: VisibilityConfig
) -> tuple[Tensor, Tensor]:
    """([h, w] in 0..1 share of each pixel that is missing and attached to a surface, [h, w] its inverse depth).

    Args:
        picture: [h, w, 3] plate t*, display-referred.
        image: the frozen scene from plate t*'s camera, scene units.
        background: the frozen scene without movers, from the same camera.
        matte: [h, w] in 0..1, motion matte of plate t*.
        unit: pixels of the plate per pixel at width 640.
        config: tolerances.
    """
    sigma, reach = 2.0 * config.margin * unit, max(1, round(2.0 * config.margin * unit))

    def difference(rendered: FrozenImage) -> Tensor:
        return _sure((picture - rendered.color).abs().amax(-1), config)

    # Where the plate matches the background, nothing is missing: the scene shows a mover too many.
    absent, background_mismatch = (mismatch(picture, render.color, unit, config) for render in (image, background))
    missing = matte * torch.minimum(absent, background_mismatch)
    outline = torch.minimum(difference(image), difference(background))
    # The depth behind the missing object: only surfaces nearer than it can hold the object.
    inverse, near = 1.0 / image.depth.clamp_min(1e-6), blurred(missing, sigma)
    hidden = blurred(missing * inverse, sigma) / near.clamp_min(1e-6)
    nearer = (inverse / hidden.clamp_min(1e-12) - 1.0).clamp_min(0.0) / config.depth_tolerance
    holds = (1.0 - absent) * (1.0 - torch.exp(-nearer.square())) * (near > 1e-6)
    depths = _depths(dilate(missing > 0.5, 2 * reach), missing, holds, inverse, 2.0 * np.pi * sigma**2)
    return torch.minimum(missing, outline) * (depths > 0.0).float(), depths


def mismatch(picture: Tensor, rendered: Tensor, unit: float, config: VisibilityConfig) -> Tensor:
    """[h, w] in 0..1: confidence that a plate's colour does not occur in a render nearby.

    `picture` and `rendered` are [h, w, 3], display-referred. Blur and misplacement within the margin do not count,
    because splats have both.
    """
    margin = config.margin * unit
    return _sure(beyond(blurred(picture, margin), blurred(rendered, margin), max(1, round(2.0 * margin))), config)


def _sure(difference: Tensor, config: VisibilityConfig) -> Tensor:
    return 1.0 - torch.exp(-(difference / config.unexplained).square())


def _hiding(frozen: FrozenGaussians, hidden: Tensor) -> FrozenGaussians:
    """The scene with the Gaussians `hidden`, bool [N], made invisible."""
    opacity = torch.where(hidden, HIDDEN, frozen.state["opacity_logits"])
    return replace(frozen, state={**frozen.state, "opacity_logits": opacity})


def _depths(around: Tensor, missing: Tensor, holds: Tensor, inverse: Tensor, least: float) -> Tensor:
    """[h, w] inverse depth of each connected region of `around` (bool): the median weighted by `holds`.

    It is 0 where a region is attached to nothing or has fewer than `least` missing pixels (`missing`).
    """
    count, labels = cv2.connectedComponents(around.byte().numpy())
    regions = np.asarray(labels, np.int32)
    weights, values, amounts = (layer.numpy() for layer in (holds, inverse, missing))
    deep = np.zeros(count, np.float32)
    for n in range(1, count):
        of = regions == n
        holding = of & (weights > 0.0)
        if holding.any() and amounts[of].sum() >= least:
            # The median: a membrane from adjacent surfaces let one floater bend a hand (docs/decisions.md).
            deep[n] = weighted_median(values[holding], weights[holding])
    return from_numpy(deep[regions])


def weighted_median(values: NDArray[np.float32], weights: NDArray[np.float32]) -> float:
    """The median of values [N] with weights [N]."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])
