"""A hand of shards that t*'s camera sees as a hand: it falls apart from aside, a whole one does not."""

import numpy as np
import pytest
import torch

from torch_backend.footage.images import write_png
from torch_backend.freeze.instant_bench import InstantBench, InstantConfig
from torch_backend.freeze.missing_layer import instant_layer
from torch_backend.freeze.torn import mends, torn
from torch_backend.gaussians.model import SH_C0

from .test_missing_layer import T_STAR, arm, frozen_of, hand, together, wall, where, world


def checked(n=T_STAR):
    """A hand of bright and dark squares of six pixels."""
    state = hand(n)
    x, y = ((state["means"] - state["means"].mean(0))[:, :2] / 0.1).floor().unbind(1)
    color = torch.where((x + y) % 2 > 0, 0.9, 0.25)[:, None] * torch.tensor([1.0, 0.7, 0.6])
    return {**state, "sh0": ((color - 0.5) / SH_C0)[:, None]}


def shattered(state, seed=0):
    """The same to a camera at the origin, each Gaussian at a depth of its own, behind it."""
    generator = torch.Generator().manual_seed(seed)
    factor = torch.empty(len(state["means"]), 1).uniform_(1.1, 2.1, generator=generator)
    return {
        **state, "means": state["means"] * factor, "log_scales": state["log_scales"] + factor.log(),
    }  # fmt: skip


def built(folder, own):
    """(world, its frozen scene): wall, arm and the hand `own`, which moves; plates show the hand whole."""
    known = together(wall(), arm(), own)
    motion = torch.arange(len(known["means"])) >= len(known["means"]) - len(own["means"])
    truth = lambda n: together(wall(), arm(), checked(n))  # noqa: E731
    made = world(folder, known, truth, motion=motion.float())
    made.scene.viewmats[T_STAR - 1] = torch.eye(4)  # at the origin, along z
    picture = made.image(truth(T_STAR), T_STAR)
    write_png(folder / f"{T_STAR:06d}.png", (np.clip(picture, 0, 1) * 255 + 0.5).astype(np.uint8))
    return made, frozen_of(known, motion.float())


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    return built(tmp_path_factory.mktemp("shards"), shattered(checked()))


def bench_of(made):
    return InstantBench(made.run, made.scene, T_STAR - 1, InstantConfig(), None)


def test_a_hand_of_shards_has_fallen_apart_and_nothing_else(shards):
    made, frozen = shards
    bench = bench_of(made)
    image = bench.render(frozen)
    inside = where(made, hand(T_STAR)) & ~where(made, arm())
    assert bench.difference(image)[inside].mean() < 0.03, "t*'s own camera sees nothing amiss"
    found = torn(bench, frozen, image)
    assert found.where[inside].mean() > 0.6
    assert found.where[~where(made, hand(T_STAR), T_STAR)].mean() < 0.02


def test_a_whole_hand_has_not(tmp_path):
    made, frozen = built(tmp_path, checked())
    bench = bench_of(made)
    assert not torn(bench, frozen, bench.render(frozen)).where.any()
    assert instant_layer(made.run, made.scene, frozen, T_STAR) is None


def test_a_whole_hand_mends_it_where_it_was_made_anew(shards):
    made, frozen = shards
    bench = bench_of(made)
    found = torn(bench, frozen, bench.render(frozen))
    whole = frozen_of(together(wall(), arm(), checked()), frozen.motion)
    assert mends(bench, whole, found, found.where)
    assert not mends(bench, frozen, found, found.where), "what was before does not mend itself"
    assert not mends(bench, whole, found, np.zeros_like(found.where)), "nothing was made anew"


def test_without_a_camera_from_aside_nothing_is_told(tmp_path):
    made, frozen = built(tmp_path, shattered(checked()))
    made.scene.viewmats[:] = torch.eye(4)
    bench = bench_of(made)
    assert not torn(bench, frozen, bench.render(frozen)).off.any()
