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

from ..views.decisions import above, all_of, any_of, by_levels, none_of
from ..views.regions import components, enclosed, grown, holes, larger, opened, standing_on
from ..views.reproject import blurred, narrowed, resized, widened

_CLIPPED = 0.98, 0.01
"""Display-referred, from which on a plate may hide anything brighter; and how soft that is."""
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
    """or no farther than such gaps from one that was found: a hand and its arm,"""
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


def held(both: BothPlates, render: Tensor, off: Tensor, wrong: Tensor, unit: float, config: HeldConfig) -> Tensor:
    """[h, w] in 0..1: what hangs together with `wrong`, and where the own plate shows another thing than plate t*.

    Args:
        render: [h, w, 3] the frozen render, display-referred.
        off: [h, w] low-passed difference of it and the own plate.
        wrong: [h, w] in 0..1, where the own plate is let go of.
        unit: pixels of decisions to one in which the configuration counts.
    """
    both = in_the_same_light(both, wrong, config.light * unit)
    soft = BothPlates(blurred(both.own, config.grain * unit), blurred(both.instant, config.grain * unit), both.seen)
    apart = blurred(both.own - both.instant, config.low * unit).abs().amax(dim=-1)
    elsewhere = all_of(_elsewhere(soft, apart, unit, config), above(off, config.smeared))
    gap, reach = round(config.gap * unit), round(config.reach * unit)
    beside = none_of(wrong)
    hanging = all_of(grown(wrong, elsewhere, reach), beside)
    found = all_of(grown(widened(wrong, gap), widened(elsewhere, gap), reach), elsewhere, beside)
    if not bool(found.any()):
        return found
    around = blurred(both.seen, config.low * unit)  # beside what plate t* does not see both are 0, and agree in nothing
    agree = all_of(above(both.seen, 0.5), none_of(above(apart, config.apart * around)))
    rim, least, least_beside = max(1, round(config.rim * unit)), config.least * unit**2, config.least_beside * unit**2
    borne_out = _borne_out(both, render, hanging, unit, config)

    def things(mask: Tensor) -> Tensor:
        """[h, w] in 0..1: how far each region of a bool mask is a thing that plate t* does not show."""
        out = torch.zeros_like(found)
        for region in sorted(components(mask), key=lambda each: int(each.sum()), reverse=True):
            near = all_of(widened(region, 2 * gap), out).amax()
            enough = torch.maximum(above(float(region.sum()), least), near)
            if bool(enough > 0.0):
                left = above(left_by_shifts(soft, region, unit, config), config.left)
                out[region] = torch.minimum(enough, left)
        return out

    candidates = enclosed(all_of(found, none_of(borne_out)), any_of(agree, wrong), rim, config.share, least_beside)
    return any_of(by_levels(candidates, things), borne_out)


def in_the_same_light(both: BothPlates, wrong: Tensor, sigma: float) -> BothPlates:
    """Plate t* with what it differs by smoothly: exposure, vignetting, a sheen. `sigma`: pixels.

    What is let go of (`wrong`, [h, w] in 0..1) or clipped says nothing of it; what is clipped in one plate may be as
    bright as the other says.
    """
    made = both.instant + light_between(both, wrong, sigma) * both.seen[..., None]
    made = torch.lerp(made, torch.maximum(made, both.own), above(both.instant, *_CLIPPED))
    made = torch.lerp(made, torch.minimum(made, both.own), above(both.own, *_CLIPPED))
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
    """[h, w, 1] in 0..1: where both plates tell what light there is."""
    clipped = above(torch.maximum(both.own, both.instant).amax(dim=-1), *_CLIPPED)
    return all_of(above(both.seen, 0.5), none_of(wrong, clipped))[..., None]


def _smooth(told: Tensor, sigma: float) -> Tensor:
    """[h / 8, w / 8, C] under a Gaussian of `sigma` pixels."""
    h, w = told.shape[:2]
    return blurred(resized(told, (w + _COARSE - 1) // _COARSE, (h + _COARSE - 1) // _COARSE), sigma / _COARSE)


def with_holes(wrong: Tensor, found: Tensor, off: Tensor, unit: float, config: HeldConfig) -> tuple[Tensor, Tensor]:
    """(what is let go of, what of it was `found`), [h, w] in 0..1 both, with its holes that belong to it.

    Those are the ones that what was found surrounds, and small ones in which render and own plate differ, by `off`
    [h, w].
    """
    rest = none_of(wrong)
    if not bool(rest.any()):
        return wrong.float(), found.float()
    rim, ground = max(1, round(config.rim * unit)), bool(found.any())

    def of_it(mask: Tensor) -> Tensor:
        """[2, h, w] in 0..1: how far what was found surrounds each hole of a bool mask, and how far each other one is
        small, and nothing to look through."""
        inner, out = holes(mask), torch.zeros(2, *mask.shape, device="cpu")
        if ground:
            out[0] = all_of(standing_on(mask, found, rim, config.hole), inner)
        for region in components(inner):
            small = none_of(above(float(region.sum()), config.island * unit**2))
            rims = all_of(small, above(off[region].mean(), config.unlike))
            out[1][region] = all_of(rims, none_of(out[0][region].amax()))
        return out

    surrounded, islands = by_levels(rest, of_it)
    return wrong + surrounded + islands, any_of(found, surrounded)


def _borne_out(both: BothPlates, render: Tensor, found: Tensor, unit: float, config: HeldConfig) -> Tensor:
    """[h, w] in 0..1: regions of `found` in which the frozen render shows what plate t* does, and the own plate does
    not.

    A fist before a face of its colour is a shift of that face, too; the splats, which other plates have made, know.
    """
    shown = render * both.seen[..., None]
    from_own, from_instant = (
        blurred(shown - plate, config.low * unit).abs().amax(dim=-1) for plate in (both.own, both.instant)
    )

    def known(mask: Tensor) -> Tensor:
        """[h, w] in 0..1: how far the render says so of each region of a bool mask."""
        out = torch.zeros_like(from_own)
        for region in components(mask):
            own, instant = from_own[region].mean(), from_instant[region].mean()
            out[region] = all_of(above(own, config.surely), none_of(above(instant, config.borne_out * own)))
        return out

    return by_levels(larger(found, config.least_borne_out * unit**2), known)


def _elsewhere(soft: BothPlates, apart: Tensor, unit: float, config: HeldConfig) -> Tensor:
    """[h, w] in 0..1: the plates show different things, and not one edge at places that are `misplaced` pixels
    apart."""
    reach = max(1, round(config.misplaced * unit))
    beyond = torch.maximum(_beyond(soft.own, soft.instant, reach), _beyond(soft.instant, soft.own, reach))
    spots = opened(above(beyond, config.apart), max(1, round(config.thin * unit)))
    return any_of(spots, all_of(widened(spots, round(config.near * unit)), above(apart, config.apart)))


def left_by_shifts(soft: BothPlates, region: Tensor, unit: float, config: HeldConfig) -> float:
    """What is left of the plates' difference in a region, bool [h, w], if plate t* is shifted as suits it best.

    A thing that is not there is nowhere near; what a wrong depth has carried to the wrong place is.
    """
    (h, w), step = region.shape, max(1, round(config.step * unit))
    reach = step * max(1, round(config.shift * unit / step))
    grid = torch.zeros_like(region)
    grid[::step, ::step] = True  # the same places, whichever pixels come or go
    y, x = (region & grid if bool((region & grid).any()) else region).nonzero().unbind(1)
    own = soft.own[y, x]

    shifts = torch.arange(-reach, reach + 1, step, device="cpu")
    sees, instant = above(soft.seen, 0.5).flatten(), soft.instant.flatten(0, 1)

    def apart(dy: int, shifts: Tensor) -> Tensor:
        """[S] mean difference where plate t* sees it, for shifts down and to the right; infinite if that is less than
        half of it."""
        down, right = y + dy, x + shifts[:, None]
        at = down.clamp(0, h - 1) * w + right.clamp(0, w - 1)
        counts = sees[at] * ((down >= 0) & (down < h) & (right >= 0) & (right < w))
        told = counts.sum(1)
        off = ((own - instant[at]).abs().amax(-1) * counts).sum(1) / told.clamp_min(1e-6)
        return torch.where(2.0 * told > len(y), off, torch.inf)

    unmoved = float(apart(0, shifts.new_zeros(1)))
    if unmoved == torch.inf:  # not seen: nothing tells it from a wrong depth
        return 0.0
    return min(float(apart(int(dy), shifts).min()) for dy in shifts) / max(unmoved, 1e-6)


def _beyond(a: Tensor, b: Tensor, reach: int) -> Tensor:
    """[h, w] by how much a picture [h, w, 3] leaves the range of what another shows within `reach` pixels, at most."""
    out = torch.zeros_like(a[..., 0])
    for channel in range(a.shape[-1]):
        here, there = a[..., channel], b[..., channel]
        out = torch.maximum(out, torch.maximum(narrowed(there, reach) - here, here - widened(there, reach)))
    return out
