"""What is held where it was not at t*, told from two plates alone: a region, and neither an edge nor light."""

from dataclasses import replace

import torch

from torch_backend.freeze.composite.foreground_change import (
    BothPlates,
    HeldConfig,
    held,
    in_the_same_light,
    light_on,
    with_holes,
)
from torch_backend.freeze.views.reproject import blurred

H, W = 160, 240
CONFIG = HeldConfig()


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
    return BothPlates(own * seen[..., None], instant * seen[..., None], seen)


def found(both, wrong, off=0.03, config=CONFIG, render=None, denied=None):
    """With splats that hold a smear, half of either plate, unless a `render` is given."""
    render = torch.lerp(both.own, both.instant, 0.5) if render is None else render
    denied = torch.zeros_like(wrong) if denied is None else denied
    return surely(held(both, render, torch.full((H, W), off), wrong, denied, 1.0, config))


def surely(mask):
    """bool [H, W] of a mask in which nothing is half decided."""
    assert ((mask == 0.0) | (mask == 1.0)).float().mean() > 0.99
    return mask > 0.5


def filled(wrong, of_it, off, unit=1.0):
    return tuple(surely(mask) for mask in with_holes(wrong, of_it, off, unit, CONFIG))


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
    apart = blurred(wall() - instant, CONFIG.low).abs().amax(-1)
    assert float((apart > CONFIG.apart).float().mean()) > 0.02, "else edges are no trap"
    assert not found(plates(wall(), instant), sleeve).any()


def test_what_touches_nothing_that_was_let_go_of_stays():
    _, hand = arm()
    nothing = torch.zeros(H, W, dtype=torch.bool)
    assert not found(plates(with_hand(wall(), hand), wall()), nothing).any()


def test_a_hand_beyond_a_wrist_that_looks_like_the_wall_goes_with_its_arm():
    """The same hand a few pixels from the sleeve, and farther."""
    sleeve, hand = arm()
    beyond, elsewhere = hand.roll(5, 1), hand.roll(24, 1)
    assert found(plates(with_hand(wall(), beyond), wall()), sleeve)[beyond].float().mean() > 0.7
    assert not found(plates(with_hand(wall(), beyond), wall()), sleeve, config=replace(CONFIG, gap=0.0)).any()
    assert not found(plates(with_hand(wall(), elsewhere), wall()), sleeve).any()


def test_a_small_piece_goes_with_what_is_denied():
    """A forearm of less than a hand's size: its fist was let go of because plate t* and the splats deny it."""
    fist, forearm = torch.zeros(H, W, dtype=torch.bool), torch.zeros(H, W, dtype=torch.bool)
    fist[70:90, 60:84] = True
    forearm[90:104, 62:78] = True
    assert CONFIG.least_beside < int(forearm.sum()) < CONFIG.least
    both = plates(with_hand(wall(), fist | forearm), wall())
    assert not found(both, fist).any()
    assert found(both, fist, denied=fist)[forearm].float().mean() > 0.6


def test_where_the_render_is_its_own_plate_light_differs_and_nothing_was_held():
    sleeve, hand = arm()
    assert not found(plates(with_hand(wall(), hand), wall()), sleeve, off=0.01).any()


def test_a_thing_of_which_plate_t_star_does_not_see_the_rim_may_be_a_wrong_depth():
    sleeve, hand = arm()
    seen = torch.ones(H, W)
    rim = torch.zeros(H, W, dtype=torch.bool)
    rim[62:118, 84:124] = True
    seen[rim & ~hand] = 0.0
    both = plates(with_hand(wall(), hand), wall(), seen)
    assert not found(both, sleeve).any()
    assert found(both, sleeve, config=replace(CONFIG, share=0.0)).any(), "else something else says no"


def test_light_that_falls_otherwise_is_no_thing():
    """The own plate is a stop brighter to the right, and bluer: the hand is found, and nothing else is."""
    sleeve, hand = arm()
    ramp = torch.linspace(0.0, 0.2, W)[None, :, None] * torch.tensor([0.6, 0.8, 1.0])
    bright = plates(with_hand(wall(), hand) + ramp, wall())
    assert float((bright.own - bright.instant).abs().amax(-1)[:, W // 2 :].min()) > CONFIG.apart
    got = found(bright, sleeve)
    assert got[hand].float().mean() > 0.7
    far = torch.ones(H, W, dtype=torch.bool)
    far[60:130, 70:130] = False
    assert not got[far].any()


def test_what_is_clipped_in_a_plate_may_be_as_bright_as_the_other_says():
    own, instant = torch.full((64, 64, 3), 0.5), torch.full((64, 64, 3), 0.5)
    own[8:16, 8:16], instant[8:16, 8:16] = 0.9, 1.0
    own[40:48, 40:48], instant[40:48, 40:48] = 1.0, 0.9
    seen = torch.ones(64, 64)
    made = in_the_same_light(BothPlates(own, instant, seen), seen > 1.0, 48.0)
    torch.testing.assert_close(made.instant[8:16, 8:16], instant[8:16, 8:16])
    darker = in_the_same_light(BothPlates(own - 0.2 * (own < 1.0), instant, seen), seen > 1.0, 48.0)
    assert abs(float(darker.instant[30, 30, 0]) - 0.3) < 1e-3
    assert float(darker.instant[10, 10, 0]) < 0.85, "0.7 is darker than white in that light"
    assert float(made.instant[44, 44, 0]) == float(instant[44, 44, 0])


def test_what_plate_t_star_shows_close_by_is_carried_to_the_wrong_place_and_no_other_thing():
    """A patch of the own plate stands eleven pixels to the side in plate t*: depth is wrong in it."""
    sleeve, hand = arm()
    grain = blurred(torch.rand(H, W, 3, generator=torch.Generator().manual_seed(1)), 2.0) * 2.0 - 0.5
    own = torch.where(hand[..., None], grain, wall())
    moved = torch.where(hand[..., None], grain.roll(11, 1), wall())
    assert not found(plates(own, moved), sleeve).any()
    assert found(plates(own, moved), sleeve, config=replace(CONFIG, left=0.0)).any(), "else something else says no"
    assert found(plates(own, wall()), sleeve)[hand].float().mean() > 0.5


def test_the_middle_of_a_hand_that_has_the_walls_colour_goes_with_its_rim():
    """A window that an arm surrounds is let go of only if it is what was found that surrounds it."""
    _, hand = arm()
    palm, window = torch.zeros_like(hand), torch.zeros_like(hand)
    palm[80:96, 94:106] = True
    window[20:40, 20:40] = True
    rim, wrong = hand & ~palm, torch.zeros_like(hand)
    wrong[10:50, 10:50] = True
    wrong &= ~window
    agree = torch.zeros(H, W)
    let_go, of_it = filled(wrong | rim, rim, agree)
    assert torch.equal(of_it, hand) and torch.equal(let_go, wrong | hand)
    nothing = torch.zeros_like(rim)
    let_go, of_it = filled(wrong, nothing, agree)
    assert torch.equal(let_go, wrong) and not of_it.any()


def test_what_is_left_between_an_arm_and_a_head_goes_if_it_is_their_rims():
    """Two windows in what is let go of, and all around it: render and own plate differ in one of them."""
    wrong, off = torch.zeros(H, W, dtype=torch.bool), torch.zeros(H, W)
    wrong[10:110, 10:110] = True
    first, second = torch.zeros_like(wrong), torch.zeros_like(wrong)
    first[20:50, 20:50] = second[60:90, 20:50] = True
    off[20:50, 20:26], off[120:, :] = 0.3, 0.3
    let_go, of_it = filled(wrong & ~first & ~second, torch.zeros_like(wrong), off)
    assert torch.equal(let_go, wrong & ~second) and not of_it.any()
    wide = filled(wrong & ~first & ~second, torch.zeros_like(wrong), off, 0.5)[0]
    assert torch.equal(wide, wrong & ~first & ~second), "at half the size a window of 900 pixels is one to look through"


def test_a_fist_of_the_faces_colour_is_no_shift_of_the_face_if_the_render_shows_what_is_behind():
    """Eleven pixels beside it plate t* has a face like the fist: a shift explains it, the splats know better."""
    sleeve, hand = arm()
    skin = wall() + torch.tensor([0.25, 0.15, 0.1])
    face = hand.roll(11, 1)
    own, instant = torch.where(hand[..., None], skin, wall()), torch.where((face & ~hand)[..., None], skin, wall())
    instant[face & hand] = own[face & hand]
    both = plates(own, instant)
    unseen = found(both, sleeve, off=0.2)
    assert not unseen.any(), "else nothing but the render could say so"
    fist = hand & ~face
    assert found(both, sleeve, off=0.2, render=instant)[fist].float().mean() > 0.8
    assert not found(both, sleeve, off=0.2, render=own)[fist].any(), "what the splats have as well is there"


def test_in_a_dimmer_light_what_is_dark_stays_dark_and_no_blacker_than_black():
    """A foot of 0.05 on a desk of 0.8 that is 0.6 in the frame's light: by the desk's loss it would be -0.15."""
    at = torch.arange(160) // 20
    dark = (at[:, None] + at) % 2 == 0
    instant = torch.where(dark[..., None], 0.05, 0.8).expand(160, 160, 3)
    wrong = torch.zeros(160, 160, dtype=torch.bool)
    wrong[60:100, 60:100] = True
    both = BothPlates(torch.where(wrong[..., None], 0.9, 0.75 * instant), instant, torch.ones(160, 160))
    made = light_on(both, wrong, 48.0).on(instant)
    assert (made - 0.75 * instant).abs().max() < 0.01


def test_of_a_plain_wall_light_is_added():
    instant, wrong = torch.full((160, 160, 3), 0.5), torch.zeros(160, 160, dtype=torch.bool)
    light = light_on(BothPlates(instant + 0.1, instant, torch.ones(160, 160)), wrong, 48.0)
    assert (light.gain - 1.0).abs().max() < 1e-3 and (light.offset - 0.1).abs().max() < 1e-3
