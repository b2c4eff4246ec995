"""Plate t*'s own pixels for what moves, where it shows the surface that a frame sees.

What moves is learnt from plate t* alone, so from t*'s camera its splats are right, whatever they look like from a
metre aside: a face has two noses, or lets the wall through. Their depth holds longer than their colours do, and a
residual (plate t* less the model's render of it) cannot know of colours that fail elsewhere. So within some degrees of
t*'s camera its pixels are taken as they are, carried by that depth. Along outlines, where depth is a pixel off and
plate t* shows what is behind, they are taken only where they differ little from the splats, or where a whole region of
the splats has fallen apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..scene import resize_intrinsics
from ..torch_types import from_numpy, norm
from .bands import look_up_near
from .detail_config import DetailConfig
from .posed import PosedFrame
from .regions import closed, opened
from .reproject import blurred, look_up, narrowed, pixel_centres, resized, unproject, widened
from .sightings import Sightings

_FEW = 0.01
"""Share of what lies around a gap that has to be seen for anything to be told of it."""


@dataclass
class InstantPixels:
    """Plate t* as it fills a frame."""

    where: Tensor
    """[h, w] in 0..1: how much of what it shows stands in place of the splats, at the size of decisions."""
    places: Tensor
    """[h, w, 2] where it shows each, in pixels of the size of decisions."""
    plate: Tensor
    """[H, W, 3] float16, display-referred, as it was exposed."""
    gain: Tensor
    """[3] by which its colours are multiplied, and"""
    offset: Tensor
    """[3] that is added, to expose them as the frame is."""

    def at(self, pixels: Tensor, larger: Tensor) -> Tensor:
        """[P, 3] its colours at the frame's pixels [P, 2] of decisions; it has `larger` [2] times as many pixels."""
        shown = look_up_near(self.plate, look_up(self.places, pixels) * larger, "bicubic")
        return shown * self.gain + self.offset


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
    sightings: Sightings, config: DetailConfig, posed: PosedFrame, usable: list[int]
) -> InstantPixels | None:
    """Plate t* for what moves and it shows from near enough; None if that is nothing, or it is not to be used."""
    h, w = posed.depth.shape
    moves = resized(posed.image.motion, w, h)
    # Mattes are wide and depth is worst behind their rims: what the model does not move is none of this.
    movers = (torch.maximum(posed.motion, posed.doubt) > 0.5) & (moves > config.moves)
    if posed.t not in usable or not bool(movers.any()):
        return None
    depth = _smooth_depth(config, posed)
    points = _points(posed, depth)
    truth = sightings.seen(posed.t, points)
    near = _nearness(config, _angle(points, sightings.centres[sightings.index[posed.t]], posed.centre))
    counts = truth.visible * movers * (near > 0.0)
    seen = narrowed(closed(counts > 0.5, round(config.gap * sightings.unit)), round(config.rim * sightings.unit))
    if not bool(seen.any()):
        return None
    places, steady = _bridged(truth.pixels, counts > 0.5, config.gap * sightings.unit, config.unsteady * sightings.unit)
    seen &= steady
    gain, offset = _exposure(sightings, posed)
    told = look_up(sightings.view(posed.t).picture.float(), places) * gain + offset
    surface = _Surface(depth, places, moves, told, resized(posed.image.color, w, h), counts)
    taken = (_torn(sightings, config, surface) | _plain(sightings, config, posed, surface)) & seen
    if not bool(taken.any()):
        return None
    where = blurred(taken.float(), config.feather * sightings.unit) * near
    return InstantPixels(where, places, sightings.displayed(posed.t), gain, offset)


def _bridged(places: Tensor, seen: Tensor, sigma: float, unsteady: float) -> tuple[Tensor, Tensor]:
    """[h, w, 2] where plate t* shows each pixel, and bool [h, w] where that can be told.

    In gaps of what it is `seen` to show depth is rough, and would fetch a pixel from anywhere: there it is as around
    them, if all around is displaced alike, to `unsteady` pixels. Where it is not, two surfaces meet.
    """
    h, w = seen.shape
    here, counts = pixel_centres(w, h), seen.float()[..., None]
    moved = (places - here).clamp(-w, w) * counts
    around = blurred(torch.cat([moved, moved.square().sum(-1, keepdim=True), counts], dim=-1), max(1.0, sigma))
    told = around[..., :3] / around[..., 3:].clamp_min(1e-6)
    mean, square = told[..., :2], told[..., 2]
    steady = (square - mean.square().sum(-1) < unsteady**2) & (around[..., 3] > _FEW)
    return torch.where(counts > 0.0, places, here + mean), seen | steady


def _torn(sightings: Sightings, config: DetailConfig, surface: _Surface) -> Tensor:
    """[h, w] bool: the splats have fallen apart, whole regions of them."""
    counts = surface.counts[..., None]
    off = sightings.difference(surface.told * counts, surface.shown * counts)
    return sightings.whole(opened(off > config.torn, round(config.thin * sightings.unit)), off, config.torn_too)


def _plain(sightings: Sightings, config: DetailConfig, posed: PosedFrame, surface: _Surface) -> Tensor:
    """[h, w] bool: what moves is in plain view of plate t*, or looks there as the splats do."""
    rim, jump = max(1, round(config.rim * sightings.unit)), config.jump
    theirs = widened(_edges(sightings.view(posed.t).surface[..., 0], jump), rim).float()
    outline = widened(_edges(surface.depth, jump), rim) | (look_up(theirs, surface.places) > 0.5)
    off = blurred(surface.told - surface.shown, config.fine * sightings.unit).abs().amax(-1)
    plain = ((surface.counts > 0.5) & ~outline) | (off < config.same)
    return opened(plain & (surface.moves > config.moves_surely), 1)


def _edges(depth: Tensor, jump: float) -> Tensor:
    """[h, w] bool: pixels among whose neighbours depth jumps by a share `jump` of itself."""
    depth = depth.clamp_max(1e6)
    least = narrowed(depth, 1)
    return widened(depth, 1) - least > jump * least


def _nearness(config: DetailConfig, beside: Tensor) -> Tensor:
    """[...] in 0..1: how far plate t* is believed about what it sees from so many degrees aside."""
    first, last = config.beside
    return ((last - beside) / max(last - first, 1e-6)).clamp(0.0, 1.0)


def _angle(points: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """[...] degrees between the directions from which two places [3] see points [..., 3]."""
    a, b = points - first, points - second
    cosine = (a * b).sum(-1) / (norm(a, -1) * norm(b, -1)).clamp_min(1e-9)
    return torch.rad2deg(torch.arccos(cosine.clamp(-1.0, 1.0)))


def _smooth_depth(config: DetailConfig, posed: PosedFrame) -> Tensor:
    """[h, w] depth of what is seen, without what single pixels' depths are off by; edges stay."""
    import cv2

    depth = posed.depth.clamp_max(1e6).numpy()
    for _ in range(config.medians):
        depth = np.asarray(cv2.medianBlur(depth, 5))
    return from_numpy(depth)


def _points(posed: PosedFrame, depth: Tensor) -> Tensor:
    """[h, w, 3] world points that are seen at a depth [h, w]."""
    h, w = depth.shape
    rows, columns = posed.image.alpha.shape
    K = resize_intrinsics(posed.K[None], columns, rows, w, h)[0]
    return unproject(pixel_centres(w, h), depth, posed.viewmat, K)


def _exposure(sightings: Sightings, posed: PosedFrame) -> tuple[Tensor, Tensor]:
    """(gain [3], offset [3]) from the exposure of plate t* to the frame's."""
    exposure = sightings.run.model.exposure
    if not exposure.config.on:
        return torch.ones(3, device="cpu"), torch.zeros(3, device="cpu")
    theirs, ours = sightings.scene.time_of_frame(posed.t), posed.exposed_at
    (gain, offset), (our_gain, our_offset) = ([part.detach().cpu() for part in exposure.at(t)] for t in (theirs, ours))
    return our_gain / gain, our_offset - offset * our_gain / gain
