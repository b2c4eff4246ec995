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

from .regions import components, enclosed, grown, larger, opened
from .reproject import blurred, narrowed, resized, widened

_CLIPPED = 0.98
"""Display-referred, from which on a plate may hide anything brighter."""
_COARSE = 8
"""Light is looked at in so many times fewer pixels a side."""
_FLAT = 0.003
"""Variance, display-referred, of colours around up to which light adds rather than multiplies: a wall tells no gain."""
_STEEPEST = 2.0
"""Times by which light multiplies at most."""


@dataclass(frozen=True)
class HeldConfig:
    """When plates show different things. Lengths are in pixels of pictures 640 wide, differences display-referred."""

    apart: float = 0.06
    """Difference of the plates, in the same light, from which on they show different things."""
    smeared: float = 0.02
    """Low-passed difference of the frozen render and the own plate that there must be, too: where these agree nothing
    was held."""
    light: float = 48.0
    """Sigma of what plates may differ by because light falls otherwise."""
    misplaced: float = 2.0
    """By how much depth may misplace plate t*: a difference has to be one from all that it shows within."""
    grain: float = 1.0
    """Sigma under which that is asked: grain is no difference."""
    thin: float = 1.0
    """Half the width below which it is an edge all the same."""
    near: float = 6.0
    """How far around such a spot a plain low-passed difference will do,"""
    low: float = 2.0
    """and the sigma of that."""
    reach: float = 64.0
    """How far from what is let go of it may be, going along it,"""
    gap: float = 4.0
    """and over gaps of twice this: between forearm and fingers a wrist may look like the wall."""
    least: float = 400.0
    """Square pixels that a region has at least,"""
    least_beside: float = 100.0
    """or no farther than such gaps from one that was found, or is denied: a hand and its arm,"""
    rim: float = 3.0
    """and pixels around it in which it is asked whether the plates agree there,"""
    share: float = 0.4
    """in at least this share of them."""
    hole: float = 0.4
    """Share of the pixels around a hole that were found, for what it holds to go with them: the middle of a hand that
    has the colour of the wall."""
    island: float = 2000.0
    """Square pixels up to which a hole in what is let go of goes with it, whatever surrounds it,"""
    unlike: float = 0.045
    """if the frozen render and the own plate differ in it by as much in the mean, low-passed: what an arm and a head
    leave between them is their rims."""
    shift: float = 16.0
    """By how much plate t* is shifted to see whether it shows the region somewhere near: then depth is wrong there."""
    step: float = 2.0
    """Between two such shifts."""
    left: float = 0.85
    """Share of the difference that the best shift has to leave."""
    surely: float = 0.1
    """Mean low-passed difference of the frozen render and the own plate in a region, from which on it is asked whether
    the render bears plate t* out: then nothing else is, for no wrong depth does that,"""
    borne_out: float = 0.45
    """as it does if it differs from that plate by at most this share of it,"""
    least_borne_out: float = 200.0
    """and the region has as many square pixels."""


@dataclass
class BothPlates:
    """A frame's own plate and plate t* carried to its place, [h, w, 3] of decisions."""

    own: Tensor
    """Display-referred; 0 where plate t* does not see the point, or beyond the plate."""
    instant: Tensor
    """The same."""
    seen: Tensor
    """[h, w] in 0..1: how well plate t* sees it."""


@dataclass
class Light:
    """Light that falls otherwise in a frame than in plate t*."""

    gain: Tensor
    """[h, w, 3] by which display-referred colours of plate t* are multiplied, and"""
    offset: Tensor
    """[h, w, 3] that is added."""

    def on(self, colors: Tensor) -> Tensor:
        """[h, w, 3] colours of plate t* as the frame's light has them."""
        return colors * self.gain + self.offset


def held(
    both: BothPlates, render: Tensor, off: Tensor, wrong: Tensor, denied: Tensor, unit: float, config: HeldConfig
) -> Tensor:
    """[h, w] bool: what hangs together with `wrong`, and where the own plate shows another thing than plate t*.

    Args:
        render: [h, w, 3] the frozen render, display-referred.
        off: [h, w] low-passed difference of it and the own plate.
        wrong: [h, w] bool, where the own plate is let go of.
        denied: [h, w] bool, where it is because both others show another thing: a hand whose arm may be left.
        unit: pixels of decisions to one in which the configuration counts.
    """
    both = in_the_same_light(both, wrong, config.light * unit)
    soft = BothPlates(blurred(both.own, config.grain * unit), blurred(both.instant, config.grain * unit), both.seen)
    apart = blurred(both.own - both.instant, config.low * unit).abs().amax(dim=-1)
    elsewhere = _elsewhere(soft, apart, unit, config) & (off > config.smeared)
    gap, reach = round(config.gap * unit), round(config.reach * unit)
    hanging = grown(wrong, elsewhere, reach) & ~wrong
    found = grown(widened(wrong, gap), widened(elsewhere, gap), reach) & elsewhere & ~wrong
    if not bool(found.any()):
        return found
    around = blurred(both.seen, config.low * unit)  # beside what plate t* does not see both are 0, and agree in nothing
    agree = (both.seen > 0.5) & (apart < config.apart * around)
    rim, least, least_beside = max(1, round(config.rim * unit)), config.least * unit**2, config.least_beside * unit**2
    borne_out, out = _borne_out(both, render, hanging, unit, config), torch.zeros_like(found)
    regions = components(enclosed(found & ~borne_out, agree | wrong, rim, config.share, least_beside))
    for region in sorted(regions, key=lambda each: int(each.sum()), reverse=True):
        enough = int(region.sum()) >= least or bool((widened(region, 2 * gap) & (out | denied)).any())
        if enough and left_by_shifts(soft, region, unit, config) > config.left:
            out |= region
    return out | borne_out


def in_the_same_light(both: BothPlates, wrong: Tensor, sigma: float) -> BothPlates:
    """Plate t* with what it differs by smoothly: exposure, vignetting, a sheen. `sigma`: pixels.

    What is let go of (`wrong`, bool [h, w]) or clipped says nothing of it; and what is clipped in one plate may be as
    bright as the other says.
    """
    made = both.instant + light_between(both, wrong, sigma) * both.seen[..., None]
    made = torch.where(both.instant > _CLIPPED, torch.maximum(made, both.own), made)
    made = torch.where(both.own > _CLIPPED, torch.minimum(made, both.own), made)
    return BothPlates(both.own, made, both.seen)


def light_between(both: BothPlates, wrong: Tensor, sigma: float) -> Tensor:
    """[h, w, 3] by how much the own plate is brighter, smoothly; see `in_the_same_light`."""
    h, w = wrong.shape
    counts = _told_of_light(both, wrong)
    light = _smooth(torch.cat([(both.own - both.instant) * counts, counts], dim=-1), sigma)
    return resized(light[..., :3] / light[..., 3:].clamp_min(1e-3), w, h)


def light_on(both: BothPlates, wrong: Tensor, sigma: float) -> Light:
    """The same as a straight line through the colours around: a dark foot on a pale desk loses less than the desk."""
    h, w = wrong.shape
    counts = _told_of_light(both, wrong)
    own, instant = both.own * counts, both.instant * counts
    told = _smooth(torch.cat([own, instant, own * instant, instant * instant, counts], dim=-1), sigma)
    mean = told[..., :12] / told[..., 12:].clamp_min(1e-3)
    own, instant, product, square = (mean[..., at : at + 3] for at in (0, 3, 6, 9))
    gain = (product - own * instant + _FLAT) / (square - instant * instant + _FLAT)
    gain = gain.clamp(1.0 / _STEEPEST, _STEEPEST)
    return Light(resized(gain, w, h), resized(own - gain * instant, w, h))


def _told_of_light(both: BothPlates, wrong: Tensor) -> Tensor:
    """[h, w, 1] 1 where both plates tell what light there is."""
    clipped = torch.maximum(both.own, both.instant).amax(dim=-1) > _CLIPPED
    return ((both.seen > 0.5) & ~wrong & ~clipped).float()[..., None]


def _smooth(told: Tensor, sigma: float) -> Tensor:
    """[h / 8, w / 8, C] under a Gaussian of `sigma` pixels."""
    h, w = told.shape[:2]
    return blurred(resized(told, (w + _COARSE - 1) // _COARSE, (h + _COARSE - 1) // _COARSE), sigma / _COARSE)


def with_holes(wrong: Tensor, found: Tensor, off: Tensor, unit: float, config: HeldConfig) -> tuple[Tensor, Tensor]:
    """(what is let go of, what of it was `found`), bool [h, w] both, with its holes that belong to it.

    Those are the ones that what was found surrounds, and small ones in which render and own plate differ, by `off`
    [h, w].
    """
    surrounded = torch.zeros_like(found)
    if bool(found.any()):
        surrounded = enclosed(~wrong, found, max(1, round(config.rim * unit)), config.hole)
    holes, islands = torch.zeros_like(found), torch.zeros_like(found)
    for region in components(~wrong):
        if bool(torch.cat([region[0], region[-1], region[:, 0], region[:, -1]]).any()):  # all around is no hole
            continue
        if bool((surrounded & region).any()):
            holes |= region
        elif float(region.sum()) <= config.island * unit**2 and float(off[region].mean()) > config.unlike:
            islands |= region
    return wrong | holes | islands, found | holes


def _borne_out(both: BothPlates, render: Tensor, found: Tensor, unit: float, config: HeldConfig) -> Tensor:
    """[h, w] bool: regions of `found` in which the frozen render shows what plate t* does, and the own plate does not.

    A fist before a face of its colour is a shift of that face, too; the splats, which other plates have made, know.
    """
    out, regions = torch.zeros_like(found), components(larger(found, config.least_borne_out * unit**2))
    if not regions:
        return out
    shown = render * both.seen[..., None]
    from_own, from_instant = (
        blurred(shown - plate, config.low * unit).abs().amax(dim=-1) for plate in (both.own, both.instant)
    )
    for region in regions:
        own, instant = float(from_own[region].mean()), float(from_instant[region].mean())
        if own > config.surely and instant < config.borne_out * own:
            out |= region
    return out


def _elsewhere(soft: BothPlates, apart: Tensor, unit: float, config: HeldConfig) -> Tensor:
    """[h, w] bool: the plates show different things, and not one edge at places that are `misplaced` pixels apart."""
    reach = max(1, round(config.misplaced * unit))
    beyond = torch.maximum(_beyond(soft.own, soft.instant, reach), _beyond(soft.instant, soft.own, reach))
    spots = opened(beyond > config.apart, max(1, round(config.thin * unit)))
    return spots | (widened(spots, round(config.near * unit)) & (apart > config.apart))


def left_by_shifts(soft: BothPlates, region: Tensor, unit: float, config: HeldConfig) -> float:
    """What is left of the plates' difference in a region, bool [h, w], if plate t* is shifted as suits it best.

    A thing that is not there is nowhere near; what a wrong depth has carried to the wrong place is.
    """
    (h, w), step = region.shape, max(1, round(config.step * unit))
    reach = step * max(1, round(config.shift * unit / step))
    y, x = (at[:: step * step] for at in region.nonzero().unbind(1))
    own = soft.own[y, x]

    def apart(dy: int, dx: int) -> float:
        """Mean difference where plate t* sees it; infinite if that is less than half of it."""
        down, right = y + dy, x + dx
        at = down.clamp(0, h - 1), right.clamp(0, w - 1)
        sees = (soft.seen[at] > 0.5) & (down == at[0]) & (right == at[1])
        off = (own - soft.instant[at]).abs().amax(-1)[sees]
        return float(off.mean()) if 2 * len(off) > len(y) else torch.inf

    unmoved = apart(0, 0)
    if unmoved == torch.inf:  # not seen: nothing tells it from a wrong depth
        return 0.0
    shifts = range(-reach, reach + 1, step)
    return min(apart(dy, dx) for dy in shifts for dx in shifts) / max(unmoved, 1e-6)


def _beyond(a: Tensor, b: Tensor, reach: int) -> Tensor:
    """[h, w] by how much a picture [h, w, 3] leaves the range of what another shows within `reach` pixels, at most."""
    out = torch.zeros_like(a[..., 0])
    for channel in range(a.shape[-1]):
        here, there = a[..., channel], b[..., channel]
        out = torch.maximum(out, torch.maximum(narrowed(there, reach) - here, here - widened(there, reach)))
    return out
