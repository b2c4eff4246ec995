"""Which pixels of a plate show another state of the scene than the instant t*.

Every pixel has a posterior probability. Its log-odds are a weighted sum of evidence (logistic regression): motion
mattes, the model's scene flow, and differences between the plate, the frozen render and plate t*, in units of noise.
The weights are fitted on synthetic scenes with truth by `python -m benchmarks.fit_state`, to two things: the squared
error that the plate's pixel costs against what would fill it, and whether the plate differs from the truth at all. No
weight is set by eye.

Related: Granados et al. 2012, "Background Inpainting for Videos with Dynamic Objects and a Free-moving Camera", also
choose between plates by an expected error.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import torch
from torch import Tensor

from ...torch_types import norm
from ..views.reproject import beyond, blurred, look_up, project, resized
from ..views.source_views import MARGIN, SourceViews
from ..views.target_view import TargetView, displacements
from ..views.visibility import Visibility


@dataclass(frozen=True)
class StateWeights:
    """Weight of each piece of evidence in the log-odds that a plate shows another state; see `evidence` for units."""

    bias: float = -6.39
    """Log-odds where no evidence says anything."""
    plate_matte: float = 4.3
    """Weight of the plate's own motion matte."""
    scene_flow: float = 5.05
    """Weight of how far the model moves the surface from t* to the plate."""
    change: float = 1.82
    """Weight of the difference between the plate and the frozen render."""
    gain: float = 2.26
    """Weight of how much better the model explains the plate at its own time than the frozen render does."""
    contradiction: float = 1.73
    """Weight of the difference between the plate and all that plate t*, carried to it, shows nearby."""


@dataclass(frozen=True)
class StateConfig:
    """How evidence is scaled, and how log-odds become a matte."""

    noise: float = 0.01
    """Standard deviation of a low-passed difference between two plates of one surface, display-referred. That between a
    plate and a render is larger by what the model leaves unexplained of plate t*."""
    travel: float = 0.5
    """Scene flow in pixels of 640 at which its evidence is log(2): below it flow is mostly the field's noise."""
    smoothing: float = 8.0
    """Sigma of the low-pass of the log-odds, in pixels of 640: states belong to surfaces. On tuning scenes 4 and 8
    are equally good, 1 and 2 are worse."""
    softness: float = 2.0
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
    """Evidence that plate `frame` shows another state than t*, at the resolution of decisions.

    Args:
        seen: how the plate sees the target view's points.
        instant: how plate t* sees them; None if it may not be used.
    """
    h, w = target.depth.shape
    view, unit = source_views.view(frame), source_views.unit
    render = resized(target.image.color, w, h)
    inside = (seen.depth > 0.0).float()
    plate = torch.lerp(render, look_up(view.picture.float(), seen.pixels), inside[..., None])
    change = source_views.difference(plate, render)
    misfit = look_up(view.missed.float()[..., None], seen.pixels)[..., 0] * inside
    contradiction, noise = torch.zeros_like(change), torch.full_like(change, config.noise)
    if instant is not None:
        noise += _unexplained(source_views, target.t, instant, config.smoothing * unit)
        carried = look_up(source_views.view(target.t).picture.float(), instant.pixels)
        ours, theirs = (blurred(each * instant.visible[..., None], unit) for each in (plate, carried))
        reach = max(1, round(MARGIN * unit))  # pixels by which an error of depth may misplace plate t*
        contradiction = torch.maximum(beyond(ours, theirs, reach), beyond(theirs, ours, reach))
    gain = change - misfit
    return {
        "plate_matte": seen.moving,
        "scene_flow": torch.log1p(_travel(source_views, target, frame) / config.travel),
        "change": torch.log1p(change / noise),
        "gain": gain.sign() * torch.log1p(2.0 * gain.abs() / noise),
        "contradiction": torch.log1p(contradiction / config.noise),
    }


def log_odds(of: Evidence, config: StateConfig, unit: float) -> Tensor:
    """[h, w] log-odds that a plate shows another state. `unit`: pixels of decisions to one of 640."""
    weights = {f.name: float(getattr(config.weights, f.name)) for f in fields(StateWeights)}
    total = sum((weights[name] * value for name, value in of.items()), torch.tensor(weights["bias"], device="cpu"))
    return blurred(total, config.smoothing * unit)


def let_go(odds: Tensor, config: StateConfig) -> Tensor:
    """[h, w] in 0..1: the share of each pixel that the plate does not give, of log-odds [h, w]."""
    return (0.5 + 0.5 * odds / config.softness).clamp(0.0, 1.0)


def _unexplained(source_views: SourceViews, t_star: int, instant: Visibility, sigma: float) -> Tensor:
    """[h, w] what the model leaves unexplained of plate t* around each pixel, display-referred: how noisy it is.

    Where plate t* sees nothing it is the mean of what it sees.
    """
    missed = look_up(source_views.view(t_star).missed.float()[..., None], instant.pixels)[..., 0] * instant.visible
    seen, least = blurred(instant.visible, sigma), 1e-3
    mean = missed.sum() / instant.visible.sum().clamp_min(1.0)
    return (blurred(missed, sigma) + least * mean) / (seen + least)


def _travel(source_views: SourceViews, target: TargetView, frame: int) -> Tensor:
    """[h, w] pixels of 640 by which the model moves what is seen from t* to a plate, as that plate sees it."""
    h, w = target.depth.shape
    size = (w + 1) // 2, (h + 1) // 2  # a quarter of the work: Gaussians of what moves are larger than its pixels
    moved, points = displacements(source_views, target, [frame], size)[0], target.points[::2, ::2]
    view = source_views.view(frame)
    ends = project(points + moved, view.viewmat, view.K)[0]
    travel = norm(ends - project(points, view.viewmat, view.K)[0], -1) / source_views.unit
    return resized(travel, w, h)
