"""Ghosts: what splats show of a thing that was elsewhere at t*, on what stands still behind it.

A hand that was held before a monitor for a second is in the splats as a smear, which t*'s camera never saw from where
the frame is. The own plate is let go of there, since it shows the hand; other plates add what the model missed of
*them*, and know nothing of the smear either. Plate t* shows the monitor: where splats differ from it, as a region, and
towards what the leading plate shows, they are haunted, and its pixels stand in their place. What shines differs
from plate t* as well, but as much as the leading plate does. Light falls otherwise in the two plates, which is made
good as around it: where the leading plate is believed the frame is that plate, and no seam may show.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..views.decisions import above, all_of, any_of, by_levels, none_of
from ..views.regions import closed, components, opened
from ..views.reproject import blurred, look_up, narrowed
from ..views.source_views import Sightings
from ..views.target_view import PosedFrame
from ..views.visibility import Sighting
from .config import DetailConfig
from .foreground_change import BothPlates, Light, left_by_shifts, light_on
from .reference_view import InstantView, bridged, continued, exposed, together


@dataclass
class Ghosts:
    """Where plate t* stands in place of ghosts; [h, w] at the size of decisions."""

    where: Tensor
    """In 0..1."""
    places: Tensor
    """[h, w, 2] where plate t* shows what is behind them, in its pixels."""
    light: Light
    """Light falls otherwise on what the frame sees than on what it shows."""


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
        let_go: [h, w] in 0..1, where the leading plate is not believed.
        counts: [h, w] in 0..1, how well plate t* shows what stands still there; 0 elsewhere.
    """
    unit = sightings.unit
    gap, rim = config.gap * unit, max(1, round(config.rim * unit))
    clear = narrowed(closed(above(counts, 0.5), round(gap)), rim)
    if not bool(clear.any()):
        return None
    told = view.told(view.sighting.pixels)
    both, sighting = _both(sightings, posed, leading, view, told)
    alike = replace(both, seen=torch.minimum(both.seen, sighting.visible))
    light = light_on(alike, let_go, config.held.light * unit)
    counted = counts[..., None]
    instant = light.on(told) * counted
    off, most = (sightings.difference(instant, other * counted) for other in (shown, both.own))
    some, more = config.ghost_of
    spots = opened(all_of(above(off, config.ghost), none_of(above(off, some * most))), round(config.thin * unit))
    beside = all_of(above(off, config.ghost_too), none_of(above(off, more * most)))
    found = any_of(sightings.whole(spots, beside), above(posed.held, 0.5))
    if not bool(all_of(found, clear).any()):
        return None
    places, steady = bridged(view.sighting.pixels, above(counts, 0.5), gap, config.unsteady * unit)
    found = all_of(closed(found, round(gap)), clear)
    plain = all_of(found, steady, none_of(_behind_rims(sightings, config, posed, places)))
    # Depth is a ghost's there, too: what that and its rims cut out goes on as beside them.
    found = all_of(found, closed(plain, round(gap)))
    places = together(continued(places, plain, round(gap) + rim), unit)
    known = torch.maximum(sighting.moving, posed.held)
    where = _passed(config, both, light, known, opened(found, round(config.sliver * unit)), unit)
    return Ghosts(where, places, light) if bool(where.any()) else None


def _both(
    sightings: Sightings, posed: PosedFrame, leading: int, view: InstantView, told: Tensor
) -> tuple[BothPlates, Sighting]:
    """(the leading plate and plate t*, which tells `told`, and how the first shows what the frame sees)."""
    gain, offset = exposed(sightings, posed, leading)
    sighting = sightings.seen(leading, view.points)
    lead = look_up(sightings.view(leading).picture.float(), sighting.pixels) * gain + offset
    sees = view.sighting.visible * (view.near > 0.0)
    return BothPlates(lead, told * sees[..., None], sees), sighting


def _passed(config: DetailConfig, both: BothPlates, light: Light, known: Tensor, where: Tensor, unit: float) -> Tensor:
    """[h, w] in 0..1: the regions of `where` in which the leading plate shows something that was elsewhere at t*.

    That is `known`, [h, w] in 0..1, by mattes or by what is held, or plate t* shows its like nowhere near.
    """
    grain = config.held.grain * unit
    lit = light.on(both.instant) * (both.seen > 0.0)[..., None]
    own, instant = blurred(both.own, grain), blurred(lit, grain)
    soft = BothPlates(own, instant, both.seen)

    def passed(mask: Tensor) -> Tensor:
        """[h, w] in 0..1: how far each region of a bool mask shows such a thing."""
        out = torch.zeros_like(where)
        for region in components(mask):
            told = above(known[region].mean(), 0.5)
            if bool(told < 1.0):
                told = any_of(told, above(left_by_shifts(soft, region, unit, config.held), config.held.left))
            out[region] = told
        return out

    return by_levels(where, passed)


def _behind_rims(sightings: Sightings, config: DetailConfig, posed: PosedFrame, places: Tensor) -> Tensor:
    """[h, w] in 0..1: plate t* shows something much nearer beside it: a depth that is a pixel off would fetch that."""
    depth = sightings.view(posed.t).surface[..., 0].clamp_max(1e6)
    nearest = narrowed(depth, max(1, round(config.rim * sightings.unit)))
    return above(look_up(above(depth - nearest, config.jump * nearest), places), 0.5)
