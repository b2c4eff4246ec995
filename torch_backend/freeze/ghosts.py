"""Ghosts: what splats show of a thing that was elsewhere at t*, on what stands still behind it.

A hand that was held before a monitor for a second is in the splats as a smear, which t*'s camera never saw from where
the frame is. The own plate is let go of there, since it shows the hand; other plates add what the model missed of
*them*, and know nothing of the smear either. Plate t* shows the monitor: where splats differ from it, as a region, and
towards what the leading plate shows, they are haunted, and its pixels stand in their place. What shines differs
from plate t* as well, but as much as the leading plate does.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .detail_config import DetailConfig
from .held import BothPlates, light_between
from .instant_view import InstantView, bridged, exposed
from .posed import PosedFrame
from .regions import closed, opened
from .reproject import look_up, narrowed
from .sightings import Sightings


@dataclass
class Ghosts:
    """Where plate t* stands in place of ghosts; [h, w] at the size of decisions."""

    where: Tensor
    """bool."""
    places: Tensor
    """[h, w, 2] where plate t* shows what is behind them, in its pixels."""
    light: Tensor
    """[h, w, 3] to be added to what it shows, display-referred: light falls otherwise on what the frame sees."""


def ghosts(
    sightings: Sightings,
    config: DetailConfig,
    posed: PosedFrame,
    leading: int,
    view: InstantView,
    shown: Tensor,
    let_go: Tensor,
    counts: Tensor,
) -> Ghosts | None:
    """What is haunted of a frame; None if nothing is.

    Args:
        leading: the frame's leading plate.
        view: plate t* as the frame sees it.
        shown: [h, w, 3] what the splats do, display-referred.
        let_go: bool [h, w], where the leading plate is not believed.
        counts: [h, w] in 0..1, how well plate t* shows what stands still there; 0 elsewhere.
    """
    unit = sightings.unit
    gap, rim = config.gap * unit, max(1, round(config.rim * unit))
    clear = narrowed(closed(counts > 0.5, round(gap)), rim)
    if not bool(clear.any()):
        return None
    places, steady = bridged(view.sighting.pixels, counts > 0.5, gap, config.unsteady * unit)
    lead, light = _beside_it(sightings, config, posed, leading, view, let_go)
    counted = counts[..., None]
    told = (view.told(places) + light) * counted
    off, most = (sightings.difference(told, other * counted) for other in (shown, lead))
    some, more = config.ghost_of
    spots = opened((off > config.ghost) & (off < some * most), round(config.thin * unit))
    found = sightings.whole(spots, torch.where(off < more * most, off, 0.0), config.ghost_too) | (posed.held > 0.5)
    where = opened(
        found & clear & steady & ~_behind_rims(sightings, config, posed, places), round(config.sliver * unit)
    )
    return Ghosts(where, places, light) if bool(where.any()) else None


def _beside_it(
    sightings: Sightings, config: DetailConfig, posed: PosedFrame, leading: int, view: InstantView, let_go: Tensor
) -> tuple[Tensor, Tensor]:
    """([h, w, 3] what the leading plate shows, [h, w, 3] by how much that is brighter than plate t*, smoothly).

    Where it is believed the frame is that plate: no seam is to be seen where plate t* begins.
    """
    gain, offset = exposed(sightings, posed, leading)
    sighting = sightings.seen(leading, view.points)
    lead = look_up(sightings.view(leading).picture.float(), sighting.pixels) * gain + offset
    sees = torch.minimum(view.sighting.visible * (view.near > 0.0), sighting.visible)
    told = view.told(view.sighting.pixels)
    both = BothPlates(lead * sees[..., None], told * sees[..., None], sees)
    return lead, light_between(both, let_go, config.held.light * sightings.unit)


def _behind_rims(sightings: Sightings, config: DetailConfig, posed: PosedFrame, places: Tensor) -> Tensor:
    """[h, w] bool: plate t* shows something much nearer beside it: a depth that is a pixel off would fetch that."""
    depth = sightings.view(posed.t).surface[..., 0].clamp_max(1e6)
    nearest = narrowed(depth, max(1, round(config.rim * sightings.unit)))
    return look_up((depth - nearest > config.jump * nearest).float(), places) > 0.5
