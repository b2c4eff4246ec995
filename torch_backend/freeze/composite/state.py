"""Log-odds that a pixel of a plate shows another state of the scene than the instant t*.

They are a weighted sum of evidence (logistic regression): motion mattes, the model's scene flow, and differences
between the plate, the frozen render and plate t*, in units of noise. A low-pass and a ramp make a matte of them.
`python -m benchmarks.fit_state` fits all weights on synthetic scenes with ground truth. Its objective has two terms:
the squared error of the plate's pixel compared with that of the fill, and whether the plate differs from ground truth.
The bias is then chosen by the PSNR of smoothed, mixed frames, so the log-odds are not calibrated probabilities.

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
    """Log-odds where all evidence is 0."""
    plate_matte: float = 4.3
    """Weight of the plate's own motion matte."""
    scene_flow: float = 5.05
    """Weight of the model's scene flow from t* to the plate."""
    change: float = 1.82
    """Weight of the difference between the plate and the frozen render."""
    gain: float = 2.26
    """Weight of the frozen render's error minus the model's error at the plate's own time."""
    contradiction: float = 1.73
    """Weight of the difference between the plate and the range of colours that reprojected plate t* shows nearby."""


@dataclass(frozen=True)
class StateConfig:
    """Scaling of the evidence, and mapping of log-odds to a matte."""

    noise: float = 0.01
    """Standard deviation of the low-passed difference between two plates of one surface, display-referred. For a plate
    and a render, the model's residual in plate t* is added."""
    travel: float = 0.5
    """Scene flow, in pixels at width 640, at which its evidence is log(2). Smaller flow is mostly noise of the
    deformation field."""
    smoothing: float = 8.0
    """Sigma of the low-pass of the log-odds, in pixels at width 640, because states belong to whole surfaces. On tuning
    scenes 4 and 8 are equally good, 1 and 2 are worse."""
    softness: float = 2.0
    """Absolute log-odds up to which a pixel is mixed; beyond that it comes entirely from one source."""
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
    """Evidence that plate `frame` shows another state than t*, at decision resolution.

    Args:
        seen: visibility of the target view's points in the plate.
        instant: visibility of the target view's points in plate t*; None if plate t* must not be used.
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
        ours, theirs = (blurred(colors * instant.visible[..., None], unit) for colors in (plate, carried))
        reach = max(1, round(MARGIN * unit))  # pixels by which a depth error may misplace plate t*
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
    """[h, w] log-odds that a plate shows another state than t*. `unit`: as `SourceViews.unit`."""
    weights = {f.name: float(getattr(config.weights, f.name)) for f in fields(StateWeights)}
    bias = torch.full_like(of["change"], weights["bias"])
    total = sum((weights[name] * value for name, value in of.items()), bias)
    return blurred(total, config.smoothing * unit)


def rejection(odds: Tensor, config: StateConfig) -> Tensor:
    """[h, w] in 0..1: share of each pixel that is not taken from the plate, given log-odds [h, w]."""
    return (0.5 + 0.5 * odds / config.softness).clamp(0.0, 1.0)


def _unexplained(source_views: SourceViews, t_star: int, instant: Visibility, sigma: float) -> Tensor:
    """[h, w] local mean of the model's residual in plate t*, display-referred, as a measure of noise.

    Where plate t* does not show the surface, this is the mean over the visible pixels.
    """
    missed = look_up(source_views.view(t_star).missed.float()[..., None], instant.pixels)[..., 0] * instant.visible
    seen, least = blurred(instant.visible, sigma), 1e-3
    mean = missed.sum() / instant.visible.sum().clamp_min(1.0)
    return (blurred(missed, sigma) + least * mean) / (seen + least)


def _travel(source_views: SourceViews, target: TargetView, frame: int) -> Tensor:
    """[h, w] scene flow of the target's points from t* to a plate, in that plate's image, in pixels at width 640."""
    h, w = target.depth.shape
    size = (w + 1) // 2, (h + 1) // 2  # a quarter of the work: moving Gaussians are larger than these pixels
    moved, points = displacements(source_views, target, [frame], size)[0], target.points[::2, ::2]
    view = source_views.view(frame)
    ends = project(points + moved, view.viewmat, view.K)[0]
    travel = norm(ends - project(points, view.viewmat, view.K)[0], -1) / source_views.unit
    return resized(travel, w, h)
