"""What is held for a while where it was not at t*: a hand before a wall of its own colour.

Flow calls it still, and the splats know it as a smear, which differs little from its own plate and from plate t*. So
the two plates themselves are compared, of which the second is carried to its place by the splats' depth. They differ
along edges, which are a pixel or two apart, and by light, which falls otherwise; a thing that is not there at t* is a
region that differs from all that plate t* shows near it, and around which the plates agree.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .detail_config import DetailConfig
from .regions import enclosed, grown, opened
from .reproject import blurred, narrowed, resized, widened

_CLIPPED = 0.98
"""Display-referred, from which on a plate may hide anything brighter."""
_COARSE = 8
"""Light is looked at in so many times fewer pixels a side."""


@dataclass
class BothPlates:
    """A frame's own plate and plate t* carried to its place, [h, w, 3] of decisions."""

    own: Tensor
    """Display-referred; 0 where plate t* does not see the point, or beyond the plate."""
    instant: Tensor
    """The same."""
    seen: Tensor
    """[h, w] in 0..1: how well plate t* sees it."""


def held(both: BothPlates, off: Tensor, wrong: Tensor, unit: float, config: DetailConfig) -> Tensor:
    """[h, w] bool: `wrong`, and what hangs together with it where the own plate shows another thing than plate t*.

    Args:
        off: [h, w] low-passed difference of the frozen render and the own plate.
        wrong: [h, w] bool, where the own plate is let go of.
        unit: pixels of decisions to one in which the configuration counts.
    """
    both = in_the_same_light(both, wrong, config.light * unit)
    apart = blurred(both.own - both.instant, config.misplaced * unit).abs().amax(dim=-1)
    elsewhere = _elsewhere(both, apart, unit, config) & (off > config.smeared)
    found = grown(wrong, elsewhere, round(config.body * unit)) & ~wrong
    if not bool(found.any()):
        return wrong
    agree = (both.seen > 0.5) & (apart < config.elsewhere)
    rim, least = max(1, round(config.held_rim * unit)), config.held_least * unit**2
    return wrong | enclosed(found, agree | wrong, rim, config.held_share, least)


def in_the_same_light(both: BothPlates, wrong: Tensor, sigma: float) -> BothPlates:
    """Plate t* with what it differs by smoothly: exposure, vignetting, a sheen. `sigma`: pixels.

    What is let go of (`wrong`, bool [h, w]) or clipped says nothing of it; and what is clipped in one plate may be as
    bright as the other says.
    """
    h, w = wrong.shape
    clipped = torch.maximum(both.own, both.instant).amax(dim=-1) > _CLIPPED
    counts = ((both.seen > 0.5) & ~wrong & ~clipped).float()[..., None]
    size = (w + _COARSE - 1) // _COARSE, (h + _COARSE - 1) // _COARSE
    told = torch.cat([(both.own - both.instant) * counts, counts], dim=-1)
    light = blurred(resized(told, *size), sigma / _COARSE)
    light = resized(light[..., :3] / light[..., 3:].clamp_min(1e-3), w, h)
    made = both.instant + light * both.seen[..., None]
    made = torch.where(both.instant > _CLIPPED, torch.maximum(made, both.own), made)
    made = torch.where(both.own > _CLIPPED, torch.minimum(made, both.own), made)
    return BothPlates(both.own, made, both.seen)


def _elsewhere(both: BothPlates, apart: Tensor, unit: float, config: DetailConfig) -> Tensor:
    """[h, w] bool: the plates show different things, and not one edge at places that are `misplaced` pixels apart."""
    soft, reach = config.misplaced_soft * unit, max(1, round(config.misplaced * unit))
    own, instant = blurred(both.own, soft), blurred(both.instant, soft)
    beyond = torch.maximum(_beyond(own, instant, reach), _beyond(instant, own, reach))
    spots = opened(beyond > config.elsewhere, max(1, round(config.elsewhere_thin * unit)))
    return spots | (widened(spots, round(config.elsewhere_near * unit)) & (apart > config.elsewhere))


def _beyond(a: Tensor, b: Tensor, reach: int) -> Tensor:
    """[h, w] by how much a picture [h, w, 3] leaves the range of what another shows within `reach` pixels, at most."""
    out = torch.zeros_like(a[..., 0])
    for channel in range(a.shape[-1]):
        here, there = a[..., channel], b[..., channel]
        out = torch.maximum(out, torch.maximum(narrowed(there, reach) - here, here - widened(there, reach)))
    return out
