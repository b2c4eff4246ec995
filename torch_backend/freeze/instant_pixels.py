"""Where the splats of what moves fall apart seen from elsewhere, and plate t* has its pixels.

What moves is learnt from plate t* alone, so from t*'s camera its splats are right, whatever they look like from a
metre aside: a face lets the wall through. Their depth holds longer than their colours do. Where plate t* shows the
same surface, and the splats show another thing, its pixels are taken as they are.
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
from .reproject import blurred, look_up, narrowed, pixel_centres, resized, unproject
from .sightings import Sightings


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


def instant_pixels(
    sightings: Sightings, config: DetailConfig, posed: PosedFrame, usable: list[int]
) -> InstantPixels | None:
    """Plate t* for what moves and the splats show otherwise; None if it is not needed, or not to be used."""
    h, w = posed.depth.shape
    # Mattes are wide and depth is worst behind their rims: what the model does not move is none of this.
    moves = (torch.maximum(posed.motion, posed.doubt) > 0.5) & (resized(posed.image.motion, w, h) > config.moves)
    if posed.t not in usable or not bool(moves.any()):
        return None
    points = _smooth_points(config, posed)
    truth = sightings.seen(posed.t, points)
    gain, offset = _exposure(sightings, posed)
    told = look_up(sightings.view(posed.t).picture.float(), truth.pixels) * gain + offset
    beside = _angle(points, sightings.centres[sightings.index[posed.t]], posed.centre)
    counts = truth.visible * moves * (beside < config.beside)
    off = sightings.difference(told * counts[..., None], resized(posed.image.color, w, h) * counts[..., None])
    spots = opened(off > config.torn, round(config.thin * sightings.unit))
    # Along outlines depth is a pixel off, and that plate shows what is behind: there the splats are the better guess.
    seen = narrowed(closed(counts > 0.5, round(config.gap * sightings.unit)), round(config.rim * sightings.unit))
    torn = sightings.whole(spots, off, config.torn_too) & seen
    if not bool(torn.any()):
        return None
    where = blurred(torn.float(), config.feather * sightings.unit)
    return InstantPixels(where, truth.pixels, sightings.displayed(posed.t), gain, offset)


def _angle(points: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """[...] degrees between the directions from which two places [3] see points [..., 3]."""
    a, b = points - first, points - second
    cosine = (a * b).sum(-1) / (norm(a, -1) * norm(b, -1)).clamp_min(1e-9)
    return torch.rad2deg(torch.arccos(cosine.clamp(-1.0, 1.0)))


def _smooth_points(config: DetailConfig, posed: PosedFrame) -> Tensor:
    """[h, w, 3] world points that are seen, without what single pixels' depths are off by; edges stay."""
    import cv2

    h, w = posed.depth.shape
    depth = posed.depth.clamp_max(1e6).numpy()
    for _ in range(config.medians):
        depth = np.asarray(cv2.medianBlur(depth, 5))
    rows, columns = posed.image.alpha.shape
    K = resize_intrinsics(posed.K[None], columns, rows, w, h)[0]
    return unproject(pixel_centres(w, h), from_numpy(depth), posed.viewmat, K)


def _exposure(sightings: Sightings, posed: PosedFrame) -> tuple[Tensor, Tensor]:
    """(gain [3], offset [3]) from the exposure of plate t* to the frame's."""
    exposure = sightings.run.model.exposure
    if not exposure.config.on:
        return torch.ones(3, device="cpu"), torch.zeros(3, device="cpu")
    theirs, ours = sightings.scene.time_of_frame(posed.t), posed.exposed_at
    (gain, offset), (our_gain, our_offset) = ([part.detach().cpu() for part in exposure.at(t)] for t in (theirs, ours))
    return our_gain / gain, our_offset - offset * our_gain / gain
