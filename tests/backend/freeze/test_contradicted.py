"""A hand that a run painted onto the wall behind it: other plates see the wall there, so it is put where it belongs."""

import math

import cv2
import numpy as np
import pytest
import torch

from torch_backend.freeze.contradicted import ContradictedConfig, contradicted
from torch_backend.freeze.frozen import FrozenGaussians, freeze_at
from torch_backend.freeze.instant_bench import InstantBench, InstantConfig
from torch_backend.freeze.missing_layer import join

from .test_missing_layer import ARM, FRAMES, T_STAR, WALL, arm, hand, scene_at, together, wall, where, world

DRIFT = (0.06, 0.05)


def painted(state, scene):
    """A state as camera t* sees it, on the wall."""
    centre = -scene.viewmats[T_STAR - 1, :3, :3].T @ scene.viewmats[T_STAR - 1, :3, 3]
    factor = 0.99 * WALL / ARM
    means = centre + factor * (state["means"] - centre)
    return {**state, "means": means, "log_scales": state["log_scales"] + math.log(factor)}


def mattes(made, of=hand):
    """Motion mattes [H, W] of what `of(n)` is, wider by 2 pixels."""

    def motion(frame):
        seen = where(made, of(frame, drift=DRIFT), frame).astype(np.uint8)
        return cv2.dilate(255 * seen, np.ones((5, 5), np.uint8))

    return motion


def bench_of(made, motion):
    bench = InstantBench(made.run, made.scene, T_STAR - 1, InstantConfig(), motion)
    return bench, bench.render(made.frozen)


@pytest.fixture(scope="module")
def on_the_wall(tmp_path_factory):
    folder = tmp_path_factory.mktemp("painted")
    known = together(wall(), arm(), painted(hand(T_STAR, drift=DRIFT), scene_at(folder)))
    return world(folder, known, lambda n: together(wall(), arm(), hand(n, drift=DRIFT)))


def test_other_plates_contradict_the_hand_and_nothing_else(on_the_wall):
    bench, image = bench_of(on_the_wall, mattes(on_the_wall))
    assert bench.difference(image).max() < InstantConfig().seed, "to camera t* it looks right"
    against = contradicted(bench, image)
    truth = where(on_the_wall, hand(T_STAR, drift=DRIFT)) & ~where(on_the_wall, arm())
    assert (against & truth).sum() > 0.7 * truth.sum()
    around = cv2.dilate(truth.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert against[~around].mean() < 0.002


def test_it_is_put_where_its_arm_is(on_the_wall):
    layer = on_the_wall.layer(mattes(on_the_wall))
    assert layer is not None
    truth = where(on_the_wall, hand(T_STAR, drift=DRIFT)) & ~where(on_the_wall, arm())
    found = layer.mask.numpy() > 0.5
    assert (found & truth).sum() / (found | truth).sum() > 0.7
    assert abs(float(layer.state["means"][:, 2].median()) / ARM - 1) < 0.1
    # From elsewhere the hand is beside its smear, in place.
    bare = FrozenGaussians(together(wall(), arm()), 0, torch.ones(1), torch.zeros(1))
    for n in (1, 4, 10, FRAMES):
        truth = on_the_wall.image(together(wall(), arm(), hand(T_STAR, drift=DRIFT)), n)
        there = np.abs(truth - on_the_wall.image(bare.state, n)).max(-1) > 0.1
        before, after = (
            np.square(on_the_wall.image(state, n) - truth)[there].mean()
            for state in (on_the_wall.frozen.state, join(on_the_wall.frozen, layer).state)
        )
        assert after < 0.4 * before, f"frame {n}: {before:.4f} {after:.4f}"


def test_a_hand_that_is_merely_missing_is_judged_by_its_difference(tmp_path):
    """Other plates contradict the wall in its place, too."""
    static = together(wall(), arm())
    made = world(tmp_path, static, lambda n: together(static, hand(n, drift=DRIFT)))
    usual, layer = made.layer(), made.layer(mattes(made))
    assert usual is not None and layer is not None
    assert torch.equal(usual.mask, layer.mask)


def test_without_mattes_nothing_is_said_to_be_painted(on_the_wall):
    assert on_the_wall.layer() is None


def test_a_matte_that_is_wrong_about_a_wall_changes_nothing(tmp_path):
    static = together(wall(), arm())
    made = world(tmp_path, static, lambda n: static)
    assert made.layer(lambda frame: np.full((144, 192), 255 * (frame == T_STAR), np.uint8)) is None


def test_where_too_few_plates_see_a_place_none_speaks_against_it(on_the_wall):
    bench, image = bench_of(on_the_wall, mattes(on_the_wall))
    assert not contradicted(bench, image, ContradictedConfig(least=FRAMES)).any()
    everywhere = bench_of(on_the_wall, lambda frame: np.full((144, 192), 255, np.uint8))
    assert not contradicted(*everywhere).any(), "nor where all of them say that something moves"


def test_another_exposure_is_no_other_thing(tmp_path):
    """Plates that darken by half over the clip, which the run knows."""
    static, gains = together(wall(), arm()), np.linspace(0.0, -0.8, FRAMES)
    made = world(tmp_path, static, lambda n: static, drawn=lambda picture, n: picture * math.exp(gains[n - 1]))
    everything_rests = lambda frame: np.zeros((144, 192), np.uint8)  # noqa: E731
    config = ContradictedConfig(differs=0.04)
    assert contradicted(*bench_of(made, everything_rests), config).mean() > 0.2, "for a run that does not"
    made.run.model.exposure.values.data[:, 0] = torch.from_numpy(gains).float()[:, None]
    made.frozen = freeze_at(made.run.model, float(made.scene.times[T_STAR - 1]), 1.0)
    assert contradicted(*bench_of(made, everything_rests), config).mean() < 0.01
