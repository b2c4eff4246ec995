"""Chooses the primary source, the plate that most pixels of a frozen frame come from, and its matte."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from ...torch_types import norm
from ..bands import bands
from ..frozen import SUPPORT_SECONDS, OutputFrame
from ..views.decisions import above, first_least
from ..views.reproject import pair, pixel_centres, project, resized, unproject
from ..views.source_views import SourceViews
from ..views.target_view import TargetView, parallax
from .config import CompositeConfig
from .state import Evidence, evidence, log_odds, rejection
from .warp import snap


@dataclass
class PrimaryMatte:
    """Share of each pixel that comes from the primary plate, and the evidence for it."""

    matte: Tensor
    """[H, W] in 0..1."""
    st: Tensor
    """[H, W, 2] coordinates in the primary plate, as in `CompositeFrame.st`."""
    is_identity: bool
    """True if `st` is the identity, because the frame has a pose of the clip."""
    terms: Evidence = field(default_factory=dict[str, Tensor])
    """The evidence and its log-odds, [h, w] each. Empty if the plate shows t* itself."""


def primary_plate(source_views: SourceViews, output: OutputFrame, target: TargetView, usable: list[int]) -> int:
    """Frame number of the primary plate: the frame's own plate, or else the usable plate nearest in pose.

    The pose distance is the camera's distance divided by the depth, plus the difference in viewing direction. Of equal
    poses (a tripod) the nearest in frame number is chosen.
    """
    if target.is_clip_view and output.frame in usable:
        return output.frame
    usable = sorted(usable, key=lambda frame: abs(frame - output.frame))
    at = torch.tensor([source_views.index[frame] for frame in usable], device="cpu")
    solid = target.depth[target.depth < 1e9]
    depth = float(solid.median()) if len(solid) else 1.0
    travel = norm(source_views.centres[at] - target.centre, 1) / max(depth, 1e-6)
    turned = 1.0 - source_views.scene.viewmats[at][:, 2, :3] @ output.viewmat[2, :3]
    return usable[first_least([float(value) for value in travel + turned], 1e-5)]


def primary_matte(
    source_views: SourceViews,
    config: CompositeConfig,
    output: OutputFrame,
    target: TargetView,
    primary: int,
    usable: list[int],
    size: tuple[int, int],
) -> PrimaryMatte:
    """The primary plate's matte. Also sets four maps of `target`.

    `motion` comes from the mattes of plate t* where it shows the point, and from the model's matte elsewhere. `doubt`
    is 1 where the primary plate is rejected: other plates may be wrong there, too, even if their mattes are still. The
    other two are `moved` and `out_of_view`.
    """
    rows, columns = target.image.alpha.shape
    lead = source_views.seen(primary, target.points)
    is_clip_view = target.is_clip_view
    truth = source_views.seen(target.t, target.points) if target.t in usable else None
    # Where plate t* does not show a point, model and own plate must agree that it moves.
    hidden = torch.minimum(target.motion, lead.moving) if is_clip_view else target.motion
    if truth is not None:
        target.motion = truth.visible * truth.moving + (1.0 - truth.visible) * hidden
    else:  # without plate t* nothing shows the movers of the instant, so that one of them is enough
        target.motion = torch.maximum(target.motion, lead.moving) if is_clip_view else target.motion
    target.moved = target.motion
    target.out_of_view = _out_of_view(
        source_views, target, torch.maximum(target.motion, lead.visible * lead.moving), usable
    )
    st, within = _places(source_views, target, primary, is_clip_view, size)
    if is_clip_view and primary != output.frame:  # its own plate is withheld
        return PrimaryMatte(torch.zeros_like(target.image.alpha), st, is_clip_view)
    free = _free(source_views, target, primary) if is_clip_view else None
    if is_clip_view and primary == output.t_star:  # its own plate shows the instant itself
        if free is not None:
            target.moved = torch.maximum(target.motion, 1.0 - free)
            within = within * resized(free, columns, rows)
        return PrimaryMatte(within, st, is_clip_view)
    of = evidence(source_views, target, primary, lead, truth, config.state)
    odds = log_odds(of, config.state, source_views.unit)
    target.doubt = rejection(odds, config.state)
    matte = 1.0 - target.doubt
    if is_clip_view:
        if free is not None:
            matte = matte * free
        target.moved = torch.maximum(target.motion, 1.0 - matte)
    else:
        error = parallax(source_views, target, primary, target.depth, config.depth_error)
        matte = matte * lead.visible * torch.exp(-error.square())
    return PrimaryMatte(resized(matte, columns, rows) * within, st, is_clip_view, {**of, "log_odds": odds})


def _out_of_view(source_views: SourceViews, target: TargetView, moving: Tensor, usable: list[int]) -> Tensor:
    """[h, w] in 0..1: share of moving surfaces (`moving`) that no plate near t* shows.

    Plates further from t* count less. The support of the Gaussians cannot be used: movers that were never
    opened to motion count as seen at all times.
    """
    seconds = {frame: float(source_views.scene.seconds[source_views.index[frame]]) for frame in usable}
    if not seconds:
        return moving
    moving = moving * above(moving, 0.5)
    at = moving > 0.0
    points = target.points[at]
    known = points.new_zeros(len(points))
    t_star = float(source_views.scene.seconds[source_views.index[target.t]])
    for offset in (0.0, -0.5 * SUPPORT_SECONDS, 0.5 * SUPPORT_SECONDS) if len(points) else ():
        near = min(seconds, key=lambda frame: abs(seconds[frame] - t_star - offset))
        trust = math.exp(-abs(seconds[near] - t_star) / SUPPORT_SECONDS)
        known = torch.maximum(known, trust * source_views.seen(near, points).visible)
    out = torch.zeros_like(moving)
    out[at] = moving[at] * (1.0 - known)
    return out


def _free(source_views: SourceViews, target: TargetView, frame: int) -> Tensor | None:
    """[h, w] in 0..1: 0 on ignored pixels of a frame's own plate, else 1. None: no pixel is ignored."""
    ignored = source_views.view(frame).ignored
    if ignored is None:
        return None
    free = torch.ones_like(target.depth)
    free[_middle(ignored, target.depth)] = 1.0 - ignored[..., 0]
    return free


def _places(
    source_views: SourceViews, target: TargetView, primary: int, is_clip_view: bool, size: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """(ST [H, W, 2] into the primary plate, [H, W] 1 inside the plate and 0 outside).

    ST is the identity if `is_clip_view`, that is, on the clip's own poses.
    """
    (rows, columns), device = target.image.alpha.shape, target.image.alpha.device
    if is_clip_view:
        x = (torch.arange(columns, device=device) + 0.5 - (columns - size[0]) // 2) / size[0]
        y = (torch.arange(rows, device=device) + 0.5 - (rows - size[1]) // 2) / size[1]
        share = torch.stack([x.expand(rows, columns), y[:, None].expand(rows, columns)], dim=-1)
    else:
        size_of_plate = source_views.plates.width, source_views.plates.height
        viewmat, K = (part.to(device) for part in source_views.camera(primary, *size_of_plate))
        plate_size = pair(*size_of_plate, target.points)
        share = torch.empty(rows, columns, 2, device=device)
        for band in bands(rows, columns):
            pixels = pixel_centres(columns, band.stop - band.start, device)
            pixels[..., 1] += band.start
            points = unproject(pixels, target.image.depth[band], target.viewmat, target.K)
            share[band] = project(points, viewmat, K)[0] / plate_size
    within = ((share > 0.0) & (share < 1.0)).all(dim=-1).float()
    share[..., 1] = 1.0 - share[..., 1]
    return snap(share.clamp_(-4.0, 5.0), (source_views.plates.width, source_views.plates.height)), within


def _middle(inner: Tensor, outer: Tensor) -> tuple[slice, slice]:
    """(rows, columns) of a picture [h, w, ...] centred in a larger one."""
    (rows, columns), (h, w) = outer.shape[:2], inner.shape[:2]
    top, left = (rows - h) // 2, (columns - w) // 2
    return slice(top, top + h), slice(left, left + w)
