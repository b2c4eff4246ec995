"""Fills a frozen frame where its primary source is not used, with splats and the residuals of other plates."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ...torch_types import norm
from ..views.decisions import above, first_best
from ..views.reproject import blurred, dilate, erode, look_up, look_up_near, pair, project, resized, unproject
from ..views.source_views import SourceViews
from ..views.target_view import TargetView, displacements, parallax
from ..views.visibility import Visibility, visible_by_operators
from .config import CompositeConfig
from .filled import Filled, Fillers, filled
from .warp import MATTE_STEPS

FULL_MATTE = 1.0 - 0.5 / MATTE_STEPS
"""Matte above which rounding gives 1, so that the pixel comes from the primary plate alone."""
_ROUGH = 1
"""Radius, in pixels at decision resolution, of the surroundings that a plate must also show to fill a pixel near a
mover. Depth is rough near movers, so visibility changes from pixel to pixel, and single pixels would stand out."""


@dataclass
class Filling:
    """The P pixels of some rows that are not covered by the primary plate."""

    y: Tensor
    """[P] int64 row, counted from the first of these rows."""
    x: Tensor
    """[P] int64 column."""
    color: Tensor
    """[P, 3] premultiplied, display-referred."""
    share: Tensor
    """[P] in 0..1: share of the pixel that comes from plates."""
    source: Tensor
    """[P] frame number of the plate with the largest weight."""
    most: float = 1.0
    """As in `Fillers`."""


def fillers_of(
    source_views: SourceViews,
    config: CompositeConfig,
    target: TargetView,
    matte: Tensor,
    primary: int,
    usable: list[int],
) -> Fillers | None:
    """The plates that fill the pixels not covered by the primary plate; None if it covers all pixels."""
    if not bool((matte < FULL_MATTE).any()):
        return None
    chosen = _chosen(source_views, config, target, matte, primary, usable)
    moved = displacements(source_views, target, chosen)
    visible = _visible_surroundings(source_views, target, chosen, moved)
    agreed = _agreed(source_views, config, target, chosen, moved)
    residuals = [source_views.residual(frame) for frame in chosen]
    most = max(source_views.scene.display.most, *(source_views.most(frame) for frame in chosen))
    h, w = target.depth.shape
    maps = target.points.new_zeros(h, w, (3 + 5 * len(chosen) + 15) // 16 * 16)
    maps[..., 0], maps[..., 1], maps[..., 2] = target.motion, target.doubt, resized(target.image.motion, w, h)
    for n in range(len(chosen)):
        maps[..., 5 * n + 3 : 5 * n + 6], maps[..., 5 * n + 6], maps[..., 5 * n + 7] = moved[n], visible[n], agreed[n]
    return Fillers(chosen, visible, agreed, residuals, maps, most)


def _visible_surroundings(
    source_views: SourceViews, target: TargetView, chosen: list[int], moved: list[Tensor]
) -> list[Tensor]:
    """[h, w] in 0..1 per plate: visibility of the pixel's surface and its surroundings. Only used near movers."""
    near = dilate(_uneasy(target.motion, target.doubt) > 0.0, 4 * _ROUGH + 1)  # radius of the erosion and blur below
    points, out = target.points[near], list[Tensor]()
    for frame, way in zip(chosen, moved, strict=True):
        visible = torch.ones_like(target.depth)
        visible[near] = source_views.seen(frame, points if frame == target.t else points + way[near]).visible
        out.append(blurred(erode(visible, _ROUGH), float(_ROUGH)))
    return out


def _uneasy(motion: Tensor, doubt: Tensor) -> Tensor:
    """[...] in 0..1: possibility that the edge of a mover is near."""
    return torch.maximum(motion, doubt).clamp(0.0, 1.0)


def _agreed(
    source_views: SourceViews, config: CompositeConfig, target: TargetView, chosen: list[int], moved: list[Tensor]
) -> list[Tensor]:
    """[h, w] in 0..1 per plate: 1 where it and plate t* show the surface alike, or one of them does not show it."""
    h, w = target.depth.shape
    if target.t not in chosen:
        return [torch.ones_like(target.depth) for _ in chosen]
    points = target.points[::2, ::2]  # a quarter of the work: it is low-passed
    truth = source_views.seen(target.t, points)
    instant_color = look_up(source_views.view(target.t).picture.float(), truth.pixels)
    out: list[Tensor] = []
    for frame, way in zip(chosen, moved, strict=True):
        if frame == target.t:
            out.append(torch.ones_like(target.depth))
            continue
        visibility = source_views.seen(frame, points + way[::2, ::2])
        plate_color = look_up(source_views.view(frame).picture.float(), visibility.pixels)
        both = (truth.visible * visibility.visible)[..., None]
        difference = source_views.difference(plate_color * both, instant_color * both)
        out.append(resized(torch.exp(-0.5 * (difference / config.state.noise).square()), w, h))
    return out


def fill(
    source_views: SourceViews, config: CompositeConfig, target: TargetView, fillers: Fillers, matte: Tensor, rows: slice
) -> Filling | None:
    """Fills the pixels of some rows that the primary plate does not cover: splats plus weighted residuals of plates.

    None if the plate covers all pixels of these rows.
    """
    at = (matte[rows] < FULL_MATTE).nonzero()
    if not len(at):
        return None
    make = filled if matte.device.type == "cpu" else filled_by_operators
    found = make(source_views, config, target, fillers, at, rows)
    source = torch.tensor([float(frame) for frame in fillers.chosen], device=matte.device)[found.plate]
    filling = Filling(at[:, 0], at[:, 1], found.color, found.share, source, fillers.most)
    if target.t in fillers.chosen:
        _take_instant(source_views, config, target, filling, found)
    return filling


def filled_by_operators(
    source_views: SourceViews, config: CompositeConfig, target: TargetView, fillers: Fillers, at: Tensor, rows: slice
) -> Filled:
    """`filled` by torch's operators, on any device."""
    (y, x), c = at.unbind(1), source_views.config
    pixels = torch.stack([x + 0.5, (y + rows.start) + 0.5], dim=-1)
    points = unproject(pixels, target.image.depth[rows][y, x], target.viewmat, target.K)
    maps = look_up(fillers.maps, pixels * target.per_pixel)
    motion, doubt, moves = maps[:, :3].unbind(-1)
    plates, (w, h) = source_views.plates, source_views.size
    larger = pair(plates.width / w, plates.height / h, pixels)

    def seen(frame: int, where: Tensor) -> Visibility:
        view = source_views.view(frame)
        return visible_by_operators(
            where, view.viewmat, view.K, view.surface, view.ignored, c.depth_tolerance, float(c.margin)
        )

    weights, places = list[Tensor](), list[Tensor]()
    same_state, untold, instant = torch.zeros_like(motion), torch.ones_like(motion), torch.zeros_like(motion)
    truth = seen(target.t, points) if target.t in fillers.chosen else None
    if truth is not None:  # the better plate t* shows a pixel, the less other times are needed
        untold = 1.0 - _near(source_views, config, target, target.t, truth)
    for n, frame in enumerate(fillers.chosen):
        way, around, agreed = maps[:, 5 * n + 3 : 5 * n + 6], maps[:, 5 * n + 6], maps[:, 5 * n + 7]
        visibility = truth if truth is not None and frame == target.t else seen(frame, points + way)
        if frame == target.t:
            instant = visibility.visible * around * above(moves, 0.5)
        visibility = _doubted(visibility, doubt)
        around = torch.minimum(visibility.visible, around)
        visibility.visible = torch.lerp(visibility.visible, around, _uneasy(motion, doubt))
        unmoved = _unmoved(source_views, config, frame, points, visibility) * agreed
        still = 1.0 - doubt * (1.0 - agreed)
        if frame != target.t:
            same_state = torch.maximum(same_state, unmoved * _near(source_views, config, target, frame, visibility))
        sway = config.sway_trust * unmoved * untold
        weights.append(_weight(source_views, config, target, frame, visibility, motion, sway, still))
        places.append(visibility.pixels * larger)
    believed = torch.stack(weights)
    total, carried = believed.sum(dim=0).clamp_min(1e-6), torch.zeros_like(points)
    for weight, residual, place in zip(believed, fillers.residuals, places, strict=True):
        carried += (weight / total)[:, None] * look_up_near(residual, place)
    share, k = total / (total + config.doubt), fillers.chosen.index(target.t) if truth is not None else 0
    color = target.image.color[rows][y, x] + carried * share[:, None]
    return Filled(color, share, first_best(believed), instant * (1.0 - same_state), places[k], points)


def _take_instant(
    source_views: SourceViews, config: CompositeConfig, target: TargetView, filling: Filling, found: Filled
) -> None:
    """Uses plate t*'s own pixels in a filling where it shows movers from nearly the same side.

    Movers are learnt from plate t* alone, so their splats are only right from that camera. Seen from elsewhere, a
    face may fall apart although its depth is right, and a residual cannot repair that.
    """
    used = found.instant.nonzero()[:, 0]
    weight = found.instant[used] * _facing(source_views, config, target, found.points[used])
    used, weight = used[weight > 0.0], weight[weight > 0.0]
    gain, offset = _exposed(source_views, target, target.t)
    instant_color = look_up_near(source_views.displayed(target.t), found.places[used]) * gain + offset
    filling.color[used] = torch.lerp(filling.color[used], instant_color, weight[:, None])
    filling.share[used] = torch.lerp(filling.share[used], torch.ones_like(weight), weight)
    filling.source[used] = torch.where(weight > 0.5, float(target.t), filling.source[used])


def _facing(source_views: SourceViews, config: CompositeConfig, target: TargetView, points: Tensor) -> Tensor:
    """[...] in 0..1: similarity of the viewing directions of plate t* and the frame at points [..., 3]."""
    theirs = source_views.centres[source_views.index[target.t]]
    a, b = (points - centre.to(points.device) for centre in (theirs, target.centre))
    cosine = (a * b).sum(-1) / (norm(a, dim=-1) * norm(b, dim=-1)).clamp_min(1e-9)
    angle = torch.rad2deg(torch.arccos(cosine.clamp(-1.0, 1.0)))
    return (2.0 - 2.0 * angle / config.max_mover_angle).clamp(0.0, 1.0)


def _exposed(source_views: SourceViews, target: TargetView, frame: int) -> tuple[Tensor, Tensor]:
    """(gain [3], offset [3]) that convert the exposure of a plate to the exposure of the target frame."""
    exposure = source_views.run.model.exposure
    if not exposure.config.on:
        return target.points.new_ones(3), target.points.new_zeros(3)
    theirs, ours = source_views.scene.time_of_frame(frame), target.exposed_at
    (gain, offset), (our_gain, our_offset) = ([part.detach() for part in exposure.at(t)] for t in (theirs, ours))
    return our_gain / gain, our_offset - offset * our_gain / gain


def _doubted(visibility: Visibility, doubt: Tensor) -> Visibility:
    """The visibility with `moving` raised to `doubt` [...] where the model does not explain the plate."""
    return replace(visibility, moving=torch.maximum(visibility.moving, doubt * (1.0 - visibility.explained)))


def _unmoved(
    source_views: SourceViews, config: CompositeConfig, frame: int, points: Tensor, visibility: Visibility
) -> Tensor:
    """[...] in 0..1: similarity of movers in plate `frame` to t*: high if the model explains them and flow is short."""
    view = source_views.view(frame)
    travel = norm(project(points, view.viewmat, view.K)[0] - visibility.pixels, dim=-1)
    trust = torch.exp(-travel / (config.sway * source_views.unit))
    return visibility.explained * trust


def _near(
    source_views: SourceViews, config: CompositeConfig, target: TargetView, frame: int, visibility: Visibility
) -> Tensor:
    """[...] in 0..1: visibility of points in a plate, reduced by the parallax of a depth error."""
    return visibility.visible / (1.0 + parallax(source_views, target, frame, visibility.depth, config.depth_error))


def _weight(
    source_views: SourceViews,
    config: CompositeConfig,
    target: TargetView,
    frame: int,
    visibility: Visibility,
    motion: Tensor,
    sway: Tensor,
    still: Tensor | float = 1.0,
) -> Tensor:
    """[...] weight of a plate at points.

    Args:
        motion: [...] in 0..1, share of the point that moves at t*.
        sway: [...] weight on movers.
        still: largest weight on static surfaces.
    """
    near = _near(source_views, config, target, frame, visibility)
    if frame == target.t:
        return near
    still = still * (1.0 - motion) * (1.0 - visibility.moving)
    return near * (still + (1.0 - still) * sway)


def _chosen(
    source_views: SourceViews,
    config: CompositeConfig,
    target: TargetView,
    matte: Tensor,
    primary: int,
    usable: list[int],
) -> list[int]:
    """Frame numbers of the fill plates: plate t*, the primary plate, and the plates that show most of the rest."""
    h, w = target.depth.shape
    need = 1.0 - resized(matte, w, h)[::4, ::4]
    points, motion, doubt = (of[::4, ::4] for of in (target.points, target.motion, target.doubt))
    k = source_views.frames.index(primary)
    steps = [2**n for n in range(config.sources)]
    around = {k + side * step for step in steps for side in (-1, 1)} | {k}
    reach = {source_views.frames[i] for i in around if 0 <= i < len(source_views.frames)} | {target.t}
    zero = torch.zeros_like(motion)
    gains = {
        frame: need
        * _weight(source_views, config, target, frame, _doubted(source_views.seen(frame, points), doubt), motion, zero)
        for frame in sorted(reach)
        if frame in usable
    }
    first = [frame for frame in (target.t, primary) if frame in gains]
    chosen, have = list(dict.fromkeys(first)), torch.zeros_like(need)
    for frame in chosen:
        have = have + gains[frame]
    while len(chosen) < min(config.sources, len(gains)):
        # Square root: a second plate of the same wall helps less than a first plate of another wall.
        candidates = sorted((frame for frame in gains if frame not in chosen), key=lambda frame: abs(frame - primary))
        benefit = torch.stack([((have + gains[frame]).sqrt() - have.sqrt()).sum() for frame in candidates]).cpu()
        best = int(first_best(benefit))
        if float(benefit[best]) <= 0.0:
            break
        chosen.append(candidates[best])
        have = have + gains[candidates[best]]
    return chosen
