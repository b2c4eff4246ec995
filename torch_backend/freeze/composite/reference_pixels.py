"""Plate t*'s own pixels for what moves, where it shows the surface that a frame sees.

What moves is learnt from plate t* alone, so from t*'s camera its splats are right, whatever they look like from a
metre aside: a face has two noses, or lets the wall through. Their depth holds longer than their colours do, and a
residual (plate t* less the model's render of it) cannot know of colours that fail elsewhere. So within some degrees of
t*'s camera its pixels are taken as they are, carried by that depth. Along outlines, where depth is a pixel off and
plate t* shows what is behind, they are taken only where they differ little from the splats, or where a whole region of
the splats has fallen apart. So they are behind what is let go of, where splats show ghosts of it (`ghosts.py`).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ...torch_types import norm
from ..views.decisions import above, all_of, any_of, none_of
from ..views.regions import closed, opened
from ..views.reproject import blurred, look_up, look_up_near, narrowed, pixel_centres, resized, widened
from ..views.source_views import Sightings
from ..views.target_view import PosedFrame
from .config import DetailConfig
from .foreground_change import Light
from .ghosting import ghosts
from .reference_view import InstantView, bridged, continued, instant_view, smooth_depth


@dataclass
class InstantPixels:
    """Plate t* as it fills a frame."""

    where: Tensor
    """[h, w] in 0..1: how much of what it shows stands in place of the splats, at the size of decisions,"""
    haunted: Tensor
    """[h, w] in 0..1: and how much of that in place of a ghost."""
    places: Tensor
    """[h, w, 2] where it shows each, in pixels of the size of decisions."""
    plate: Tensor
    """[H, W, 3] float16, display-referred, as it was exposed."""
    gain: Tensor
    """[3] by which its colours are multiplied, and"""
    offset: Tensor
    """[3] that is added, to expose them as the frame is."""
    light: Light | None
    """Light that falls otherwise, where it is haunted; None: nowhere."""
    together: float
    """Pixels of decisions by which neighbours of one surface are displaced differently at most."""

    def at(self, pixels: Tensor, larger: Tensor) -> Tensor:
        """[P, 3] its colours at the frame's pixels [P, 2] of decisions; it has `larger` [2] times as many pixels."""
        h, w = self.places.shape[:2]
        moved = self.places - pixel_centres(w, h)
        smooth, nearest = look_up(moved, pixels), look_up(moved, pixels, "nearest")
        apart = norm(smooth - nearest, -1) > self.together  # between two surfaces the mean is at neither
        places = pixels + torch.where(apart[:, None], nearest, smooth)
        shown = look_up_near(self.plate, places * larger)
        shown = shown * self.gain + self.offset
        if self.light is None:
            return shown
        return shown * look_up(self.light.gain, pixels) + look_up(self.light.offset, pixels)


@dataclass
class _Surface:
    """What a frame sees of what moves, and plate t* of it; [h, w] at the size of decisions."""

    depth: Tensor
    """Along the frame's axis, without what single pixels' depths are off by."""
    places: Tensor
    """[h, w, 2] where plate t* shows it."""
    moves: Tensor
    """In 0..1: how much of what is seen the model moves."""
    told: Tensor
    """[h, w, 3] what plate t* shows there, exposed as the frame is."""
    shown: Tensor
    """[h, w, 3] what the splats do."""
    counts: Tensor
    """In 0..1: how well plate t* shows what moves, from near enough; 0 elsewhere."""


def instant_pixels(
    sightings: Sightings, config: DetailConfig, posed: PosedFrame, leading: int, usable: list[int]
) -> InstantPixels | None:
    """Plate t* for what it shows from near enough of what moves, and behind what is let go of; None if that is nothing,
    or it is not to be used."""
    h, w = posed.depth.shape
    let_go = above(torch.maximum(posed.motion, posed.doubt), 0.5)
    if posed.t not in usable or not bool(let_go.any()):
        return None
    view = instant_view(sightings, config, posed)
    shown, moves = (resized(of, w, h) for of in (posed.image.color, posed.image.motion))
    # Mattes are wide and depth is worst behind their rims: what the model does not move is none of what moves.
    movers = all_of(let_go, above(moves, config.moves))
    taken, places = _of_movers(sightings, config, posed, view, shown, moves, view.shows(movers))
    behind = ghosts(sightings, config, posed, leading, view, shown, let_go, view.shows(all_of(let_go, none_of(movers))))
    light, haunted = None, torch.zeros_like(view.depth)
    if behind is not None:
        haunted = all_of(widened(behind.where, _feather(config, sightings)), none_of(taken))
        lit, light = haunted[..., None], behind.light
        places = torch.where(lit > 0.5, behind.places, places)
        light = Light(torch.lerp(torch.ones_like(light.gain), light.gain, lit), light.offset * lit)
        taken = any_of(taken, behind.where)
    if not bool(taken.any()):
        return None
    where = blurred(taken, config.feather * sightings.unit) * view.near
    plate, together = sightings.displayed(posed.t), config.unsteady * sightings.unit
    return InstantPixels(where, haunted, places, plate, view.gain, view.offset, light, together)


def _feather(config: DetailConfig, sightings: Sightings) -> int:
    """Pixels of decisions that a border is soft for."""
    return max(1, round(3.0 * config.feather * sightings.unit))


def _of_movers(
    sightings: Sightings,
    config: DetailConfig,
    posed: PosedFrame,
    view: InstantView,
    shown: Tensor,
    moves: Tensor,
    counts: Tensor,
) -> tuple[Tensor, Tensor]:
    """([h, w] in 0..1: what moves and is taken from plate t*, [h, w, 2] where that shows it)."""
    shows = above(counts, 0.5)
    seen = narrowed(closed(shows, round(config.gap * sightings.unit)), round(config.rim * sightings.unit))
    if not bool(seen.any()):
        return seen, view.sighting.pixels
    gap, unsteady = config.gap * sightings.unit, config.unsteady * sightings.unit
    places, steady = bridged(view.sighting.pixels, shows, gap, unsteady)
    surface = _Surface(view.depth, places, moves, view.told(places), shown, counts)
    taken = any_of(_torn(sightings, config, surface), _plain(sightings, config, posed, surface))
    taken = all_of(taken, seen, steady)
    return taken, continued(places, taken, _feather(config, sightings))


def _torn(sightings: Sightings, config: DetailConfig, surface: _Surface) -> Tensor:
    """[h, w] in 0..1: the splats have fallen apart, whole regions of them."""
    counts = surface.counts[..., None]
    off = sightings.difference(surface.told * counts, surface.shown * counts)
    spots = opened(above(off, config.torn), round(config.thin * sightings.unit))
    return sightings.whole(spots, above(off, config.torn_too))


def _plain(sightings: Sightings, config: DetailConfig, posed: PosedFrame, surface: _Surface) -> Tensor:
    """[h, w] in 0..1: what moves is in plain view of plate t*, or looks there as the splats do."""
    rim, jump = max(1, round(config.rim * sightings.unit)), config.outline
    theirs = smooth_depth(config, sightings.view(posed.t).surface[..., 0], sightings.unit)
    theirs = above(look_up(widened(_edges(theirs, jump), rim), surface.places), 0.5)
    outline = any_of(widened(_edges(surface.depth, jump), rim), theirs)
    off = blurred(surface.told - surface.shown, config.fine * sightings.unit).abs().amax(-1)
    plain = any_of(all_of(above(surface.counts, 0.5), none_of(outline)), none_of(above(off, config.same)))
    return opened(all_of(plain, above(surface.moves, config.moves_surely)), 1)


def _edges(depth: Tensor, jump: float) -> Tensor:
    """[h, w] in 0..1: pixels among whose neighbours depth jumps by a share `jump` of itself."""
    depth = depth.clamp_max(1e6)
    least = narrowed(depth, 1)
    return above(widened(depth, 1) - least, jump * least)
