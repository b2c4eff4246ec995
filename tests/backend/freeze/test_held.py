"""What is held where it was not at t*, told from two plates alone: a region, and neither an edge nor light."""

from dataclasses import replace

import pytest
import torch

from torch_backend.freeze.detail_config import DetailConfig
from torch_backend.freeze.held import BothPlates, exposed_alike, held
from torch_backend.freeze.reproject import blurred

H, W = 160, 240
CONFIG = DetailConfig()


def wall():
    """Stripes of strong contrast with fine grain: plain paper would show no edge in a wrong place."""
    g = torch.Generator().manual_seed(0)
    picture = 0.45 + 0.3 * ((torch.arange(W) // 40) % 2)[None, :, None].float().expand(H, W, 3)
    return blurred(picture + 0.01 * torch.randn(H, W, 3, generator=g), 0.7)


def arm():
    """bool [H, W]: let go of already, and [H, W] what hangs together with that."""
    sleeve, hand = torch.zeros(H, W, dtype=torch.bool), torch.zeros(H, W, dtype=torch.bool)
    sleeve[90:130, 56:84] = True
    hand[70:110, 84:116] = True
    return sleeve, hand


def plates(own, instant, seen=None):
    seen = torch.ones(H, W) if seen is None else seen
    own, instant = own * seen[..., None], instant * seen[..., None]
    return BothPlates(own, instant, seen, blurred(own - instant, 2.0).abs().amax(-1))


def found(both, wrong, off=0.03, config=CONFIG):
    return held(both, torch.full((H, W), off), wrong, 1.0, config) & ~wrong


def with_hand(picture, hand, by=0.1):
    return torch.where(hand[..., None], picture + by * torch.tensor([1.0, 0.8, 0.6]), picture)


def test_a_hand_of_the_walls_colour_goes_with_the_arm_and_nothing_else_does():
    """Plate t* lies a pixel and a half beside its place, so its stripes' edges differ by more than the hand does."""
    sleeve, hand = arm()
    instant = torch.lerp(wall().roll(1, 1), wall().roll(2, 1), 0.5)
    got = found(plates(with_hand(wall(), hand), instant), sleeve)
    assert got[hand].float().mean() > 0.85
    far = torch.ones(H, W, dtype=torch.bool)
    far[60:120, 74:126] = far[:, :4] = False
    assert not got[far].any()
    assert float((plates(wall(), instant).off > CONFIG.elsewhere).float().mean()) > 0.02, "else edges are no trap"
    assert not found(plates(wall(), instant), sleeve).any()


def test_what_touches_nothing_that_was_let_go_of_stays():
    _, hand = arm()
    nothing = torch.zeros(H, W, dtype=torch.bool)
    assert not found(plates(with_hand(wall(), hand), wall()), nothing).any()


def test_where_the_render_is_its_own_plate_light_differs_and_nothing_was_held():
    sleeve, hand = arm()
    assert not found(plates(with_hand(wall(), hand), wall()), sleeve, off=0.01).any()


@pytest.mark.parametrize("hidden", [False, True])
def test_a_difference_that_does_not_end_is_none_of_a_thing(hidden):
    """All to the right of the sleeve is lighter; or what lies around the hand plate t* does not see."""
    sleeve, hand = arm()
    seen = torch.ones(H, W)
    if hidden:
        ring = torch.ones(H, W, dtype=torch.bool)
        ring[74:106, 56:112] = False
        seen[ring] = 0.0
    else:
        hand[:, 84:] = True
    both = plates(with_hand(wall(), hand), wall(), seen)
    assert not found(both, sleeve).any()
    assert found(both, sleeve, config=replace(CONFIG, held_share=0.0)).any(), "else something else says no"


def test_what_is_clipped_in_a_plate_may_be_as_bright_as_the_other_says():
    own, instant = torch.tensor([[[0.5, 0.85, 1.0]]]), torch.tensor([[[0.5, 1.0, 0.9]]])
    made = exposed_alike(own, instant, torch.full((3,), 0.8), torch.zeros(3))
    torch.testing.assert_close(made, torch.tensor([[[0.4, 0.85, 0.72]]]))
    brighter = exposed_alike(own, instant, torch.full((3,), 1.5), torch.zeros(3))
    torch.testing.assert_close(brighter, torch.tensor([[[0.75, 1.5, 1.0]]]))
