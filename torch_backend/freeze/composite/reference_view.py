"""What plate t* shows of the surfaces that a frame sees, whatever the splats make of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ...scene import resize_intrinsics
from ...torch_types import from_numpy, norm
from ..views.decisions import above, all_of, any_of, none_of
from ..views.reproject import blurred, inside, look_up, pixel_centres, project, unproject
from ..views.source_views import Sightings
from ..views.target_view import PosedFrame
from ..views.visibility import Sighting
from .config import DetailConfig

_SMALL = 0.75
"""Pixels of decisions to one of 640, up to which a picture is small."""
_FEW = 0.01
"""Share of what lies around a gap that has to be seen for anything to be told of it."""


@dataclass
class InstantView:
    """Plate t* as a frame sees it; [h, w] at the size of decisions."""

    depth: Tensor
    """Along the frame's axis, without what single pixels' depths are off by."""
    points: Tensor
    """[h, w, 3] world points at that depth."""
    sighting: Sighting
    """How plate t* shows them."""
    near: Tensor
    """In 0..1: how far it is believed, by the angle between the two views, and by how much larger the frame sees it."""
    picture: Tensor
    """[h, w, 3] plate t* itself, display-referred, as it was exposed."""
    gain: Tensor
    """[3] by which its colours are multiplied, and"""
    offset: Tensor
    """[3] that is added, to expose them as the frame is."""

    def told(self, places: Tensor) -> Tensor:
        """[..., 3] what it shows at its pixels [..., 2], exposed as the frame is."""
        return look_up(self.picture, places) * self.gain + self.offset

    def shows(self, where: Tensor) -> Tensor:
        """[h, w] in 0..1: how well it shows what is `where`, [h, w] in 0..1, from near enough; 0 elsewhere."""
        return self.sighting.visible * where * (self.near > 0.0)


def instant_view(sightings: Sightings, config: DetailConfig, posed: PosedFrame) -> InstantView:
    """Plate t* for a frame; which has to be one of those that may be used."""
    depth = smooth_depth(config, posed.depth, sightings.unit)
    points = _points(posed, depth)
    angle = _angle(points, sightings.centres[sightings.index[posed.t]], posed.centre)
    sighting = sightings.seen(posed.t, points)
    visible = torch.maximum(sighting.visible, _returns(sightings, config, posed, sighting))
    sighting = replace(sighting, visible=visible)
    view, (h, w) = sightings.view(posed.t), depth.shape
    larger = (sighting.depth / view.K[0, 0]) / (depth / _camera(posed, w, h)[0, 0]).clamp_min(1e-6)
    near = _fading(config.beside, angle) * _fading(config.coarser, larger)
    return InstantView(depth, points, sighting, near, view.picture.float(), *exposed(sightings, posed, posed.t))


def bridged(places: Tensor, seen: Tensor, sigma: float, unsteady: float) -> tuple[Tensor, Tensor]:
    """[h, w, 2] where plate t* shows each pixel, and in 0..1 [h, w] where that can be told.

    In gaps of what it is `seen` to show depth is rough, and would fetch a pixel from anywhere: there it is as around
    them, if all around is displaced alike, to `unsteady` pixels. Where it is not, two surfaces meet.
    """
    h, w = seen.shape
    here, counts = pixel_centres(w, h), seen.float()[..., None]
    moved = (places - here).clamp(-w, w) * counts
    around = blurred(torch.cat([moved, moved.square().sum(-1, keepdim=True), counts], dim=-1), max(1.0, sigma))
    told = around[..., :3] / around[..., 3:].clamp_min(1e-6)
    mean, square = told[..., :2], told[..., 2]
    steady = all_of(none_of(above(square - mean.square().sum(-1), unsteady**2)), above(around[..., 3], _FEW))
    return torch.lerp(here + mean, here + (places - here).clamp(-w, w), counts), any_of(seen, steady)


def continued(places: Tensor, taken: Tensor, reach: int) -> Tensor:
    """[h, w, 2] where plate t* shows each pixel, carried on by `reach` pixels beyond what is `taken`, [h, w] in 0..1.

    A border is soft, and what it fades out into may lie behind: pixels of plate t* from there would be specks. It goes
    on as the nearest pixel that is taken; between two of them in the mean it would be at neither.
    """
    import cv2

    taken = taken > 0.5  # what is less goes on as beside it: no soft pixel is one that others are like
    if not bool(taken.any()):
        return places
    h, w = taken.shape
    away, labels = cv2.distanceTransformWithLabels(
        (~taken).numpy().astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest, told = from_numpy(np.asarray(labels, np.int64)), taken.flatten()
    moved = (places - pixel_centres(w, h)).flatten(0, 1)[told]
    by_label = torch.zeros(int(nearest.max()) + 1, 2, device="cpu")
    by_label[nearest.flatten()[told]] = moved
    on = (from_numpy(np.asarray(away, np.float32)) <= reach) & ~taken
    return torch.where(on[..., None], pixel_centres(w, h) + by_label[nearest], places)


def together(places: Tensor, unit: float) -> Tensor:
    """[h, w, 2] places in plate t*, each displaced as the middle one of those around it: none on its own."""
    h, w = places.shape[:2]
    here = pixel_centres(w, h)
    moved = (places - here).clamp(-1e4, 1e4)
    return here + torch.stack([_median(part, unit) for part in moved.unbind(-1)], dim=-1)


def _returns(sightings: Sightings, config: DetailConfig, posed: PosedFrame, sighting: Sighting) -> Tensor:
    """[h, w] in 0..1: what plate t* has at its places is seen by the frame where these were asked for, or so near that
    nobody sees it. Of an arm that comes towards the camera depth is rough by more than a surface may be, and no pixel
    of it is far from its place."""
    view, (h, w) = sightings.view(posed.t), sighting.depth.shape
    depth = look_up(view.surface[..., 0].clamp_max(1e6), sighting.pixels, "nearest")
    points = unproject(sighting.pixels, depth, view.viewmat, view.K)
    back = project(points, posed.viewmat, _camera(posed, w, h))[0] - pixel_centres(w, h)
    off = norm(back, -1) / sightings.unit
    returns = (2.0 - off / config.returns).clamp(0.0, 1.0) * inside(sighting.pixels, *sightings.size)
    return returns if view.ignored is None else returns * (1.0 - look_up(view.ignored, sighting.pixels)[..., 0])


def _fading(between: tuple[float, float], value: Tensor) -> Tensor:
    """[...] 1 up to the first of two values, 0 from the last on."""
    first, last = between
    return ((last - value) / max(last - first, 1e-6)).clamp(0.0, 1.0)


def _angle(points: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """[...] degrees between the directions from which two places [3] see points [..., 3]."""
    a, b = points - first, points - second
    cosine = (a * b).sum(-1) / (norm(a, -1) * norm(b, -1)).clamp_min(1e-9)
    return torch.rad2deg(torch.arccos(cosine.clamp(-1.0, 1.0)))


def smooth_depth(config: DetailConfig, depth: Tensor, unit: float) -> Tensor:
    """[h, w] a depth [h, w] without what single pixels of it are off by; edges stay. `unit`: pixels to one of 640.

    Of small pictures fewer pixels: an apple of five would be as deep as the wall.
    """
    smooth = depth.clamp_max(1e6)
    for _ in range(config.medians):
        smooth = _median(smooth, unit)
    return smooth


def _median(values: Tensor, unit: float) -> Tensor:
    """[h, w] the median of 5 x 5 pixels around each, of 3 x 3 in small pictures."""
    import cv2

    return from_numpy(np.asarray(cv2.medianBlur(np.ascontiguousarray(values.numpy()), 5 if unit > _SMALL else 3)))


def _points(posed: PosedFrame, depth: Tensor) -> Tensor:
    """[h, w, 3] world points that are seen at a depth [h, w]."""
    h, w = depth.shape
    return unproject(pixel_centres(w, h), depth, posed.viewmat, _camera(posed, w, h))


def _camera(posed: PosedFrame, w: int, h: int) -> Tensor:
    """[3, 3] the frame's camera in pixels of decisions."""
    rows, columns = posed.image.alpha.shape
    return resize_intrinsics(posed.K[None], columns, rows, w, h)[0]


def exposed(sightings: Sightings, posed: PosedFrame, frame: int) -> tuple[Tensor, Tensor]:
    """(gain [3], offset [3]) from the exposure of a plate to that of the frame that is made."""
    exposure = sightings.run.model.exposure
    if not exposure.config.on:
        return torch.ones(3, device="cpu"), torch.zeros(3, device="cpu")
    theirs, ours = sightings.scene.time_of_frame(frame), posed.exposed_at
    (gain, offset), (our_gain, our_offset) = ([part.detach().cpu() for part in exposure.at(t)] for t in (theirs, ours))
    return our_gain / gain, our_offset - offset * our_gain / gain
