"""The plate that gives a frozen frame whole pixels: which one it is, and where nothing that moves is seen in it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ...torch_types import norm
from ..bands import bands
from ..frozen import SUPPORT_SECONDS, OutputFrame
from ..views.decisions import above, first_least
from ..views.reproject import pixel_centres, project, resized, unproject
from ..views.source_views import Sightings
from ..views.target_view import PosedFrame, parallax
from .config import DetailConfig
from .state import evidence, let_go, log_odds
from .warp import snap


def leading_plate(sightings: Sightings, output: OutputFrame, posed: PosedFrame, usable: list[int]) -> int:
    """The frame's own plate, else the nearest in pose of those usable: in travel over depth, and in direction.

    Of poses that are alike, as a tripod's are, the nearest in number.
    """
    if posed.own and output.frame in usable:
        return output.frame
    usable = sorted(usable, key=lambda frame: abs(frame - output.frame))
    at = torch.tensor([sightings.index[frame] for frame in usable], device="cpu")
    solid = posed.depth[posed.depth < 1e9]
    depth = float(solid.median()) if len(solid) else 1.0
    travel = norm(sightings.centres[at] - posed.centre, 1) / max(depth, 1e-6)
    turned = 1.0 - sightings.scene.viewmats[at][:, 2, :3] @ posed.viewmat[2, :3]
    return usable[first_least([float(each) for each in travel + turned], 1e-5)]


def leading_matte(
    sightings: Sightings,
    config: DetailConfig,
    output: OutputFrame,
    posed: PosedFrame,
    leading: int,
    usable: list[int],
    size: tuple[int, int],
) -> tuple[Tensor, Tensor, bool]:
    """(matte [H, W] of the leading plate, its ST [H, W, 2], True if that is the identity).

    Also settles `posed.motion`: by the mattes of plate t* where that sees the point, else by the model's;
    `posed.doubt`: what the leading plate shows wrongly others may, too, though their mattes do not say so;
    `posed.moved` and `posed.unseen`.
    """
    rows, columns = posed.image.alpha.shape
    lead = sightings.seen(leading, posed.points)
    own = posed.own
    truth = sightings.seen(posed.t, posed.points) if posed.t in usable else None
    hidden = torch.minimum(posed.motion, lead.moving) if own else posed.motion
    if truth is not None:
        posed.motion = truth.visible * truth.moving + (1.0 - truth.visible) * hidden
    else:
        posed.motion = torch.maximum(posed.motion, lead.moving) if own else posed.motion
    posed.moved = posed.motion
    posed.unseen = _unseen(sightings, config, posed, torch.maximum(posed.motion, lead.visible * lead.moving), usable)
    st, within = _places(sightings, posed, leading, own, size)
    if own and leading != output.frame:  # its own plate is withheld
        return torch.zeros(rows, columns, device="cpu"), st, own
    free = _free(sightings, posed, leading) if own else None
    if own and leading == output.t_star:  # its own plate shows the instant itself
        if free is not None:
            posed.moved = torch.maximum(posed.motion, 1.0 - free)
            within = within * resized(free, columns, rows)
        return within, st, own
    of = evidence(sightings, posed, leading, lead, truth, config.state)
    posed.doubt = let_go(log_odds(of, config.state, sightings.unit), config.state)
    matte = 1.0 - posed.doubt
    if own:
        if free is not None:
            matte = matte * free
        posed.moved = torch.maximum(posed.motion, 1.0 - matte)
    else:
        error = parallax(sightings, posed, leading, posed.depth, config.depth_error)
        matte = matte * lead.visible * torch.exp(-error.square())
    return resized(matte, columns, rows) * within, st, own


def _unseen(sightings: Sightings, config: DetailConfig, posed: PosedFrame, moving: Tensor, usable: list[int]) -> Tensor:
    """[h, w] in 0..1: how little of what moves (`moving`) plates near t* show; the further from t*, the less they know.

    Gaussians that moved but were never opened are seen all along, so their own support does not say it.
    """
    seconds = {frame: float(sightings.scene.seconds[sightings.index[frame]]) for frame in usable}
    if not seconds:
        return moving
    moving = moving * above(moving, 0.5)
    at = moving > 0.0
    points = posed.points[at]
    known = torch.zeros(len(points), device="cpu")
    t_star = float(sightings.scene.seconds[sightings.index[posed.t]])
    for offset in config.known_at if len(points) else ():
        near = min(seconds, key=lambda frame: abs(seconds[frame] - t_star - offset))
        trust = math.exp(-abs(seconds[near] - t_star) / SUPPORT_SECONDS)
        known = torch.maximum(known, trust * sightings.seen(near, points).visible)
    out = torch.zeros_like(moving)
    out[at] = moving[at] * (1.0 - known)
    return out


def _free(sightings: Sightings, posed: PosedFrame, frame: int) -> Tensor | None:
    """[h, w] in 0..1: what of a frame's own plate is part of the scene; None: all of it."""
    ignored = sightings.view(frame).ignored
    if ignored is None:
        return None
    free = torch.ones_like(posed.depth)
    free[_middle(ignored, posed.depth)] = 1.0 - ignored[..., 0]
    return free


def _places(
    sightings: Sightings, posed: PosedFrame, leading: int, own: bool, size: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """(ST [H, W, 2] into the leading plate, [H, W] 1 within it): the identity on the clip's own poses."""
    rows, columns = posed.image.alpha.shape
    if own:
        x = (torch.arange(columns, device="cpu") + 0.5 - (columns - size[0]) // 2) / size[0]
        y = (torch.arange(rows, device="cpu") + 0.5 - (rows - size[1]) // 2) / size[1]
        share = torch.stack([x.expand(rows, columns), y[:, None].expand(rows, columns)], dim=-1)
    else:
        viewmat, K = sightings.camera(leading, sightings.plates.width, sightings.plates.height)
        whole = torch.tensor([sightings.plates.width, sightings.plates.height], device="cpu")
        share = torch.empty(rows, columns, 2, device="cpu")
        for band in bands(rows, columns):
            pixels = pixel_centres(columns, band.stop - band.start)
            pixels[..., 1] += band.start
            points = unproject(pixels, posed.image.depth[band], posed.viewmat, posed.K)
            share[band] = project(points, viewmat, K)[0] / whole
    within = ((share > 0.0) & (share < 1.0)).all(dim=-1).float()
    share[..., 1] = 1.0 - share[..., 1]
    return snap(share.clamp_(-4.0, 5.0), (sightings.plates.width, sightings.plates.height)), within


def _middle(inner: Tensor, outer: Tensor) -> tuple[slice, slice]:
    """(rows, columns) of a picture [h, w, ...] that lies in the middle of a larger one."""
    (rows, columns), (h, w) = outer.shape[:2], inner.shape[:2]
    top, left = (rows - h) // 2, (columns - w) // 2
    return slice(top, top + h), slice(left, left + w)
