"""Half a hand that stands at two thirds of its distance: put back to the other half; what is meant to be near stays."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from torch_backend.array_types import connected
from torch_backend.footage.images import write_png
from torch_backend.freeze.adrift import AdriftConfig, adrift
from torch_backend.freeze.frozen import render_frozen
from torch_backend.freeze.missing_layer import instant_layer, join

from .test_missing_layer import ARM, T_STAR, H, W, arm, frozen_of, sheet, skin, together, wall, world

NEAR = ARM / 1.5


def blue(x, y):
    return torch.tensor([0.3, 0.4, 0.9]) + 0.0 * x[:, None]


def hand_at(z, x, color=skin):
    """A hand at depth z that to a camera at the origin, looking along z, is where one at `ARM` would be from x to x."""
    share = z / ARM
    return sheet(tuple(share * v for v in x), (-0.2 * share, 0.2 * share), z, 0.02 * share, color)


def drawn(tmp_path, near, far):
    """(world, frozen, rows of `near`): a wall, what moves `far` and `near`; the plate of t* is what they paint."""
    state = together(wall(), far, near)
    still = len(wall()["means"])
    motion = (torch.arange(len(state["means"])) >= still).float()
    made = world(tmp_path, state, lambda n: state, motion=motion)
    made.scene.viewmats[T_STAR - 1] = torch.eye(4)  # at the origin, along z
    picture = made.image(state, T_STAR)
    write_png(tmp_path / f"{T_STAR:06d}.png", (np.clip(picture, 0, 1) * 255 + 0.5).astype(np.uint8))
    rows = torch.arange(len(state["means"])) >= len(state["means"]) - len(near["means"])
    return made, frozen_of(state, motion), rows


def found(made, frozen):
    pieces = adrift(made.run, made.scene, frozen, T_STAR)
    assert pieces is not None
    return pieces


def seen(made, frozen):
    image = render_frozen(frozen, made.scene.viewmats[T_STAR - 1], made.scene.Ks[0], W, H)
    return image.color.numpy(), image.depth.numpy()


def test_half_a_hand_before_its_other_half_is_put_back_to_it(tmp_path):
    palm = sheet((-0.30, 0.9), (-0.2, 0.2), ARM, 0.02, skin)
    made, frozen, rows = drawn(tmp_path, hand_at(NEAR, (-0.36, -0.06)), palm)
    after = found(made, frozen).put_back
    depths = after.state["means"][rows, 2]
    assert abs(float(depths.median()) / ARM - 1.0) < 0.05 and bool((depths > 0.9 * ARM).all())
    assert bool((after.state["means"][~rows] == frozen.state["means"][~rows]).all())
    before, now = seen(made, frozen), seen(made, after)
    # The same to t*'s camera, but for what is before what at the seam.
    assert np.abs(before[0] - now[0]).mean() < 2e-3
    assert before[1].min() < 1.05 * NEAR and now[1].min() > 0.9 * ARM


def test_plate_t_star_stands_for_it_at_its_place(tmp_path):
    palm = sheet((-0.10, 0.9), (-0.2, 0.2), ARM, 0.02, skin)
    made, frozen, rows = drawn(tmp_path, hand_at(NEAR, (-0.45, -0.10)), palm)
    pieces = found(made, frozen)
    inside = pieces.inverse > 0.0
    assert np.abs(1.0 / pieces.inverse[inside] / ARM - 1.0).max() < 0.05
    assert bool((pieces.without.state["opacity_logits"][rows] < -10.0).float().mean() > 0.9)
    layer = instant_layer(made.run, made.scene, pieces.without, T_STAR, known=pieces.inverse)
    assert layer is not None and layer.stands_for(pieces.inverse > 0.0)
    assert float((layer.state["means"][:, 2] / ARM - 1.0).abs().max()) < 0.05
    color, depth = seen(made, join(pieces.without, layer))
    assert np.abs(color - seen(made, frozen)[0])[inside].mean() < 0.02
    assert np.abs(depth[inside] / ARM - 1.0).mean() < 0.05
    assert not replace(layer, mask=torch.zeros_like(layer.mask)).stands_for(pieces.inverse > 0.0)


def test_its_veil_goes_with_it(tmp_path):
    palm = sheet((-0.30, 0.9), (-0.2, 0.2), ARM, 0.02, skin)
    thin = hand_at(NEAR, (-0.06, 0.06))
    thin["opacity_logits"] = torch.full_like(thin["opacity_logits"], -3.0)
    near = hand_at(NEAR, (-0.36, -0.06))
    made, frozen, _ = drawn(tmp_path, together(near, thin), palm)
    after = found(made, frozen).put_back
    veil = after.state["means"][-len(thin["means"]) :, 2]
    assert float((veil > 0.9 * ARM).float().mean()) > 0.9


def test_what_it_hides_and_what_hangs_in_it_go_with_it(tmp_path):
    """Behind its skin stands more of it that t* does not see; and of what t* sees some is held for still."""
    palm = sheet((-0.30, 0.9), (-0.2, 0.2), ARM, 0.02, skin)
    near, inner = hand_at(NEAR, (-0.36, -0.06)), hand_at(1.1 * NEAR, (-0.30, -0.12))
    near["opacity_logits"] = torch.full_like(near["opacity_logits"], 6.0)
    made, frozen, rows = drawn(tmp_path, together(near, inner), palm)
    first = int(rows.nonzero()[0])
    held = torch.arange(first, first + len(near["means"]), 5)
    frozen.motion[held] = 0.0
    depths = found(made, frozen).put_back.state["means"][:, 2]
    assert bool((depths[held] > 0.9 * ARM).float().mean() > 0.9)
    assert float((depths[first + len(near["means"]) :] > 0.9 * ARM).float().mean()) > 0.9


def test_an_arm_that_reaches_for_the_camera_stays(tmp_path):
    far = arm()
    far["means"][:, 2] = ARM - 1.1 * (0.9 - far["means"][:, 0])  # its end is at 2.1, and joins it all the way
    made, frozen, _ = drawn(tmp_path, hand_at(ARM - 1.1 * 0.8, (-0.1, 0.15)), far)
    assert adrift(made.run, made.scene, frozen, T_STAR) is None


@pytest.mark.parametrize("color", [skin, blue])
def test_a_thing_that_swings_before_the_wall_stays_whatever_moves_elsewhere(tmp_path, color):
    far = sheet((0.6, 1.2), (-0.5, 0.5), ARM, 0.02, skin)
    made, frozen, _ = drawn(tmp_path, hand_at(NEAR, (-0.36, -0.06), color), far)
    assert adrift(made.run, made.scene, frozen, T_STAR) is None


def test_a_thing_of_another_colour_before_a_hand_stays(tmp_path):
    palm = sheet((-0.30, 0.9), (-0.2, 0.2), ARM, 0.02, skin)
    made, frozen, _ = drawn(tmp_path, hand_at(NEAR, (-0.36, -0.06), blue), palm)
    assert adrift(made.run, made.scene, frozen, T_STAR) is None


def test_what_holds_still_stays(tmp_path):
    palm = sheet((-0.30, 0.9), (-0.2, 0.2), ARM, 0.02, skin)
    made, frozen, rows = drawn(tmp_path, hand_at(NEAR, (-0.36, -0.06)), palm)
    frozen.motion[rows] = 0.0
    assert adrift(made.run, made.scene, frozen, T_STAR) is None


def test_large_pieces_are_no_pieces(tmp_path):
    palm = sheet((-0.30, 0.9), (-0.2, 0.2), ARM, 0.02, skin)
    made, frozen, _ = drawn(tmp_path, hand_at(NEAR, (-0.36, -0.06)), palm)
    assert adrift(made.run, made.scene, frozen, T_STAR, config=AdriftConfig(most=0.001)) is None


def test_connected_parts_of_a_picture():
    values = np.array([[0.0, 0.1, 0.9], [0.5, 0.2, 1.0], [0.4, 0.3, 0.6]])
    labels = connected(values, 0.15)
    assert labels.shape == (3, 3) and labels.min() == 0 and labels.max() == 2
    # 0.0 to 0.5 by steps of 0.1 around the corner; 0.9 with 1.0; 0.6 differs from 0.3 and from 1.0.
    assert len({int(labels[place]) for place in [(0, 0), (0, 1), (1, 1), (2, 1), (2, 0), (1, 0)]}) == 1
    assert labels[0, 2] == labels[1, 2] != labels[2, 2]
