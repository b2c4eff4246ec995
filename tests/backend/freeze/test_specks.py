"""Specks before what moves: put back to it, the same to t*'s camera, or taken out; what is solid, or still, stays."""

import numpy as np
import torch

from torch_backend.freeze.specks import SpecksConfig, without_specks

from .test_adrift import drawn, hand_at, seen
from .test_missing_layer import ARM, T_STAR, sheet, skin

NEAR = ARM / 1.4


def faint(sheet_of, logit=-3.0):
    """A hand that hardly shows."""
    return {**sheet_of, "opacity_logits": torch.full_like(sheet_of["opacity_logits"], logit)}


def assert_taken_out(after, frozen, rows):
    assert float(torch.sigmoid(after.state["opacity_logits"][rows]).max()) < 1e-5
    assert torch.equal(after.state["means"][~rows], frozen.state["means"][~rows])
    assert torch.equal(after.state["opacity_logits"][~rows], frozen.state["opacity_logits"][~rows])


def palm():
    return sheet((-0.40, 0.9), (-0.2, 0.2), ARM, 0.02, skin)


def test_specks_go_to_the_solid_part_behind_them(tmp_path):
    made, frozen, rows = drawn(tmp_path, faint(hand_at(NEAR, (-0.36, -0.06))), palm())
    after = without_specks(made.run, made.scene, frozen, T_STAR)
    depths = after.state["means"][rows, 2]
    assert float((depths / ARM - 1.0).abs().max()) < 0.02
    # As large to camera t*, and at the same pixels.
    growth = (after.state["log_scales"] - frozen.state["log_scales"])[rows].exp()
    assert torch.allclose(growth, torch.full_like(growth, ARM / NEAR), rtol=0.02)
    aside = after.state["means"][rows, :2] / depths[:, None] - frozen.state["means"][rows, :2] / NEAR
    assert float(aside.abs().max()) < 1e-4
    assert bool((after.state["means"][~rows] == frozen.state["means"][~rows]).all())
    assert np.abs(seen(made, frozen)[0] - seen(made, after)[0]).mean() < 2e-3


def test_specks_beside_a_hand_go_to_the_hand(tmp_path):
    """Before the wall, where nothing that moves is behind them, but a hand is near."""
    made, frozen, rows = drawn(tmp_path, faint(hand_at(NEAR, (-0.42, -0.40))), palm())
    after = without_specks(made.run, made.scene, frozen, T_STAR)
    assert float((after.state["means"][rows, 2] / ARM - 1.0).abs().max()) < 0.02


def test_specks_far_before_it_are_taken_out(tmp_path):
    made, frozen, rows = drawn(tmp_path, faint(hand_at(ARM / 1.6, (-0.36, -0.06))), palm())
    after = without_specks(made.run, made.scene, frozen, T_STAR)
    assert_taken_out(after, frozen, rows)


def test_specks_that_would_come_near_another_camera_are_taken_out(tmp_path):
    made, frozen, rows = drawn(tmp_path, faint(hand_at(NEAR, (-0.36, -0.06))), palm())
    made.scene.viewmats[0] = torch.eye(4)
    made.scene.viewmats[0, 2, 3] = -0.8 * ARM
    assert_taken_out(without_specks(made.run, made.scene, frozen, T_STAR), frozen, rows)


def test_large_ones_stay(tmp_path):
    near = faint(hand_at(NEAR, (-0.36, -0.06)))
    near["log_scales"] = near["log_scales"] + 3.0
    made, frozen, _ = drawn(tmp_path, near, palm())
    assert without_specks(made.run, made.scene, frozen, T_STAR) is frozen


def test_a_solid_hand_stays_where_it_is(tmp_path):
    made, frozen, _ = drawn(tmp_path, hand_at(NEAR, (-0.36, -0.06)), palm())
    after = without_specks(made.run, made.scene, frozen, T_STAR)
    assert all(torch.equal(after.state[name], value) for name, value in frozen.state.items())


def test_what_hardly_stands_before_it_stays(tmp_path):
    near = ARM / (0.98 * SpecksConfig().near)
    made, frozen, _ = drawn(tmp_path, faint(hand_at(near, (-0.36, -0.06))), palm())
    after = without_specks(made.run, made.scene, frozen, T_STAR)
    assert torch.equal(after.state["means"], frozen.state["means"])


def test_faint_things_that_hold_still_or_have_nothing_near_stay(tmp_path):
    made, frozen, rows = drawn(tmp_path, faint(hand_at(NEAR, (-0.36, -0.06))), palm())
    frozen.motion[rows] = 0.0
    assert torch.equal(without_specks(made.run, made.scene, frozen, T_STAR).state["means"], frozen.state["means"])
    away = tmp_path / "away"
    away.mkdir()
    made, frozen, _ = drawn(away, faint(hand_at(NEAR, (-0.9, -0.7))), palm())
    assert torch.equal(without_specks(made.run, made.scene, frozen, T_STAR).state["means"], frozen.state["means"])


def test_a_scene_in_which_nothing_moves_is_handed_back(tmp_path):
    made, frozen, _ = drawn(tmp_path, faint(hand_at(NEAR, (-0.36, -0.06))), palm())
    frozen.motion[:] = 0.0
    assert without_specks(made.run, made.scene, frozen, T_STAR) is frozen
