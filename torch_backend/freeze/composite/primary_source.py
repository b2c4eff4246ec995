"""The plate that gives a frozen frame whole pixels: which one it is, and where nothing that moves is seen in it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ...torch_types import norm
from ..bands import bands
from ..frozen import SUPPORT_SECONDS, OutputFrame
from ..views.decisions import above, all_of, any_of, first_least
from ..views.regions import closed, opened
from ..views.reproject import blurred, look_up, pixel_centres, project, resized, unproject, widened
from ..views.source_views import Sightings
from ..views.target_view import PosedFrame, displacements, parallax
from ..views.visibility import Sighting
from .config import DetailConfig
from .foreground_change import BothPlates, held, with_holes
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
    `posed.moved`, `posed.unseen` and `posed.held`.
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
    wrong = above(torch.maximum(posed.motion, lead.moving), 0.5)
    if own:
        wrong, found = _let_go(sightings, config, posed, leading, wrong, truth)
        posed.held = widened(found, round(config.margin * sightings.unit))
    posed.doubt = widened(wrong, round(config.margin * sightings.unit))
    let_go = blurred(posed.doubt, config.feather * sightings.unit)
    matte = 1.0 - let_go
    if own:
        if free is not None:
            matte, let_go = matte * free, torch.maximum(let_go, 1.0 - free)
        posed.moved = torch.maximum(posed.motion, let_go)
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


def _let_go(
    sightings: Sightings, config: DetailConfig, posed: PosedFrame, frame: int, moving: Tensor, truth: Sighting | None
) -> tuple[Tensor, Tensor]:
    """([h, w] in 0..1: where the frame's own plate shows another instant than t*, [h, w] in 0..1: what of it `held`
    found).

    Args:
        moving: [h, w] in 0..1, by the mattes.
        truth: how plate t* sees what is seen; None if it may not be used.
    """
    render = resized(posed.image.color, moving.shape[1], moving.shape[0])
    off, gained = _off(sightings, posed, frame, render)
    wrong = any_of(moving, _swayed(sightings, config, _travel(sightings, posed, frame), gained))
    found = torch.zeros_like(wrong)
    if truth is not None:
        both = _both_plates(sightings, posed, frame, truth)
        found = held(both, render, off, wrong, sightings.unit, config.held)
    wrong = closed(any_of(wrong, found), round(config.gap * sightings.unit))
    return with_holes(wrong, found, off, sightings.unit, config.held)


def _off(sightings: Sightings, posed: PosedFrame, frame: int, render: Tensor) -> tuple[Tensor, Tensor]:
    """([h, w] low-passed difference of the frozen `render` [h, w, 3] and its own plate, [h, w] by how much that is more
    than the difference of the model at the plate's own time); 0 beyond the plate."""
    h, w = posed.depth.shape
    view = sightings.view(frame)
    inside = _middle(view.missed, posed.depth)
    off, gained = torch.zeros(h, w, device="cpu"), torch.zeros(h, w, device="cpu")
    off[inside] = sightings.difference(view.picture.float(), render[inside])
    gained[inside] = off[inside] - view.missed.float()
    return off, gained


def _both_plates(sightings: Sightings, posed: PosedFrame, frame: int, truth: Sighting) -> BothPlates:
    """The frame's own plate, and plate t*, which sees what is seen as `truth` says."""
    h, w = posed.depth.shape
    picture = sightings.view(frame).picture.float()
    inside = _middle(picture, posed.depth)
    seen = truth.visible[inside][..., None]
    own, instant = torch.zeros(h, w, 3, device="cpu"), torch.zeros(h, w, 3, device="cpu")
    own[inside] = picture * seen
    instant[inside] = look_up(sightings.view(posed.t).picture.float(), truth.pixels[inside]) * seen
    return BothPlates(own, instant, truth.visible)


def _swayed(sightings: Sightings, config: DetailConfig, travel: Tensor, gained: Tensor) -> Tensor:
    """[h, w] in 0..1: the model moves what is seen from t* to its own plate (`travel`), and the plate bears it out.

    That is, the render of t* differs from the plate by more than the render of the plate's own time does (`gained`,
    as `_off`). A textureless shirt that the model lets drift is no evidence; flow at small sizes misses sways
    that are.
    """
    out = all_of(above(gained, config.borne_out), above(travel, config.travel))
    # Outlines are errors of depth; what moves is a region.
    return opened(out, round(config.thin * sightings.unit))


def _travel(sightings: Sightings, posed: PosedFrame, frame: int) -> Tensor:
    """[h, w] pixels of 640 by which the model moves what is seen from t* to a plate, as that plate sees it."""
    h, w = posed.depth.shape
    size = (w + 1) // 2, (h + 1) // 2  # a quarter of the work: Gaussians of what moves are larger than its pixels
    moved, points = displacements(sightings, posed, [frame], size)[0], posed.points[::2, ::2]
    view = sightings.view(frame)
    ends = project(points + moved, view.viewmat, view.K)[0]
    travel = norm(ends - project(points, view.viewmat, view.K)[0], -1) / sightings.unit
    return resized(travel, w, h)


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
