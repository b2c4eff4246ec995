"""Which pixels of a plate show another state of the scene than the instant t*.

Every pixel has a posterior probability. Its log-odds are a weighted sum of evidence (logistic regression): the plate's
motion matte, the model's scene flow, how far plate, frozen render and the model's render of the plate differ in units
of noise, and how well the plate correlates with plate t*. `python -m benchmarks.fit_state` fits the weights to
synthetic scenes with truth and to painted pixels of a real clip. One of them is more than evidence: `plate_matte` also
holds that a pixel which moves while it is looked at costs more than one that only differs from t*.

Related: Granados et al. 2012, "Background Inpainting for Videos with Dynamic Objects and a Free-moving Camera", also
choose between plates by an expected error.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import torch
from torch import Tensor

from ...torch_types import norm
from ..views.reproject import blurred, look_up, project, resized
from ..views.source_views import SourceViews
from ..views.target_view import TargetView, displacements
from ..views.visibility import Visibility


@dataclass(frozen=True)
class StateWeights:
    """Weight of each piece of evidence in the log-odds that a plate shows another state; see `evidence` for units."""

    bias: float = -3.0
    """Log-odds where no evidence says anything."""
    plate_matte: float = 3.4
    """Weight of the plate's own motion matte: 0.6 by the fit, the rest is the cost of keeping what moves. Flow left on
    `sitting` at t* 30: 3 px with 0.6, 1.1 px with 2.5, 0.1 px with 4.0; 3.2 and 4.0 are alike in its worst frames."""
    scene_flow: float = 1.79
    """Weight of how far the model moves the surface from t* to the plate."""
    change: float = 1.64
    """Weight of the difference between the plate and the frozen render, less what the render misses of plate t* there:
    what the model shows wrongly at all times is no change."""
    model_change: float = 0.5
    """Weight of the difference between the model's render of the plate at its own time and the frozen render."""
    agreement: float = -0.67
    """Weight of what the plate tells of plate t*, carried to it: texture that both show alike."""


@dataclass(frozen=True)
class StateConfig:
    """How evidence is scaled, and how log-odds become a matte."""

    noise: float = 0.02
    """Standard deviation of a low-passed difference between two renders or plates of one surface, display-referred."""
    travel: float = 0.5
    """Scene flow in pixels of 640 at which its evidence is log(2): below it flow is mostly the field's noise."""
    window: float = 5.0
    """Sigma in pixels of 640 of the window in which a plate and plate t* are correlated."""
    smoothing: float = 8.0
    """Sigma of the low-pass of the log-odds, in pixels of 640: states belong to surfaces."""
    softness: float = 1.0
    """Log-odds on either side of even odds between which a pixel is mixed; beyond them it is wholly one source."""
    weights: StateWeights = field(default_factory=StateWeights)
    """The fitted weights."""


Evidence = dict[str, Tensor]
"""Name of a field of `StateWeights` -> [h, w] float32, no unit."""


def evidence(
    source_views: SourceViews,
    target: TargetView,
    frame: int,
    seen: Visibility,
    instant: Visibility | None,
    config: StateConfig,
) -> Evidence:
    """What speaks for another state in plate `frame`, at the pixels of the target view's size of decisions.

    Args:
        seen: how the plate sees the target view's points.
        instant: how plate t* sees them; None if it may not be used.
    """
    h, w = target.depth.shape
    view, unit = source_views.view(frame), source_views.unit
    render = resized(target.image.color, w, h).clamp(0.0, 1.0)  # beyond white a highlight's value says nothing
    inside = (seen.depth > 0.0).float()[..., None]
    plate, own = (torch.lerp(render, _shown(of, seen.pixels), inside) for of in (view.picture, view.render))
    missed, agreement = torch.zeros_like(render), torch.zeros_like(target.depth)
    if instant is not None:
        of_t = source_views.view(target.t)
        carried, its_render = (_shown(of, instant.pixels) for of in (of_t.picture, of_t.render))
        missed = instant.visible[..., None] * (carried - its_render)
        agreement = instant.visible * shared(plate.mean(-1), carried.mean(-1), config.window * unit, config.noise)
    return {
        "plate_matte": seen.moving,
        "scene_flow": torch.log1p(_travel(source_views, target, frame) / config.travel),
        "change": torch.log1p(source_views.difference(plate - missed, render) / config.noise),
        "model_change": torch.log1p(source_views.difference(own, render) / config.noise),
        "agreement": agreement,
    }


def log_odds(of: Evidence, config: StateConfig, unit: float) -> Tensor:
    """[h, w] log-odds that a plate shows another state. `unit`: pixels of decisions to one of 640."""
    weights = {f.name: float(getattr(config.weights, f.name)) for f in fields(StateWeights)}
    total = sum((weights[name] * value for name, value in of.items()), torch.tensor(weights["bias"], device="cpu"))
    return blurred(total, config.smoothing * unit)


def let_go(odds: Tensor, config: StateConfig) -> Tensor:
    """[h, w] in 0..1: the share of each pixel that the plate does not give, of log-odds [h, w]."""
    return (0.5 + 0.5 * odds / config.softness).clamp(0.0, 1.0)


def _shown(picture: Tensor, pixels: Tensor) -> Tensor:
    """[h, w, 3] what a display shows of a picture at pixels [h, w, 2] of it."""
    return look_up(picture.float().clamp(0.0, 1.0), pixels)


def shared(a: Tensor, b: Tensor, sigma: float, noise: float) -> Tensor:
    """[h, w] twice the mutual information in nats per pixel of two grey pictures [h, w], jointly Gaussian in a window.

    It is -log(1 - correlation^2): 0 where one says nothing of the other, whatever the exposure. `noise`: standard
    deviation of either. Pictures that contradict each other (a negative correlation) share nothing.
    """
    mean_a, mean_b, aa, bb, ab = (blurred(each, sigma) for each in (a, b, a * a, b * b, a * b))
    of_a, of_b = (aa - mean_a.square()).clamp_min(0.0) + noise**2, (bb - mean_b.square()).clamp_min(0.0) + noise**2
    correlation = (ab - mean_a * mean_b) / (of_a * of_b).sqrt()
    return -torch.log1p(-correlation.clamp(0.0, 1.0).square())


def _travel(source_views: SourceViews, target: TargetView, frame: int) -> Tensor:
    """[h, w] pixels of 640 by which the model moves what is seen from t* to a plate, as that plate sees it."""
    h, w = target.depth.shape
    size = (w + 1) // 2, (h + 1) // 2  # a quarter of the work: Gaussians of what moves are larger than its pixels
    moved, points = displacements(source_views, target, [frame], size)[0], target.points[::2, ::2]
    view = source_views.view(frame)
    ends = project(points + moved, view.viewmat, view.K)[0]
    travel = norm(ends - project(points, view.viewmat, view.K)[0], -1) / source_views.unit
    return resized(travel, w, h)
