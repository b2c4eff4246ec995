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
from .reproject import blurred, narrowed, widened

_CLIPPED = 0.98
"""Display-referred, from which on a plate may hide anything brighter."""


@dataclass
class BothPlates:
    """A frame's own plate and plate t* carried to its place, [h, w, 3] of decisions, exposed alike."""

    own: Tensor
    """0 where plate t* does not see the point, or beyond the plate."""
    instant: Tensor
    """The same."""
    seen: Tensor
    """[h, w] in 0..1: how well plate t* sees it."""
    off: Tensor
    """[h, w] their low-passed difference."""


def exposed_alike(own: Tensor, instant: Tensor, gain: Tensor, offset: Tensor) -> Tensor:
    """[h, w, 3] plate t* as the own plate was exposed. What is clipped in one is as bright as the other says."""
    made = instant * gain + offset
    made = torch.where(instant > _CLIPPED, torch.maximum(made, own), made)
    return torch.where(own > _CLIPPED, torch.minimum(made, own), made)


def held(both: BothPlates, off: Tensor, wrong: Tensor, unit: float, config: DetailConfig) -> Tensor:
    """[h, w] bool: `wrong`, and what hangs together with it where the own plate shows another thing than plate t*.

    Args:
        off: [h, w] low-passed difference of the frozen render and the own plate.
        wrong: [h, w] bool, where the own plate is let go of.
        unit: pixels of decisions to one in which the configuration counts.
    """
    found = grown(wrong, _elsewhere(both, unit, config) & (off > config.smeared), round(config.body * unit)) & ~wrong
    if not bool(found.any()):
        return wrong
    agree = (both.seen > 0.5) & (both.off < config.elsewhere)
    return wrong | enclosed(found, agree | wrong, max(1, round(config.held_rim * unit)), config.held_share)


def _elsewhere(both: BothPlates, unit: float, config: DetailConfig) -> Tensor:
    """[h, w] bool: the plates show different things, and not one edge at places that are `misplaced` pixels apart."""
    soft, reach = config.misplaced_soft * unit, max(1, round(config.misplaced * unit))
    own, instant = blurred(both.own, soft), blurred(both.instant, soft)
    beyond = torch.maximum(_beyond(own, instant, reach), _beyond(instant, own, reach))
    spots = opened(beyond > config.elsewhere, max(1, round(config.elsewhere_thin * unit)))
    return spots | (widened(spots, round(config.elsewhere_near * unit)) & (both.off > config.elsewhere))


def _beyond(a: Tensor, b: Tensor, reach: int) -> Tensor:
    """[h, w] by how much a picture [h, w, 3] leaves the range of what another shows within `reach` pixels, at most."""
    out = torch.zeros_like(a[..., 0])
    for channel in range(a.shape[-1]):
        here, there = a[..., channel], b[..., channel]
        out = torch.maximum(out, torch.maximum(narrowed(there, reach) - here, here - widened(there, reach)))
    return out
