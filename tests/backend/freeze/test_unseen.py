"""A thing on a thread, which t*'s camera does not see, and a model that has lost it: it is made of another plate."""

import math

import numpy as np
import pytest
import torch

from torch_backend.freeze.frozen import SUPPORT_SECONDS
from torch_backend.freeze.unseen import with_unseen
from torch_backend.solve.motion import MOVING

from .test_missing_layer import T_STAR, sheet, skin, stops_when_asked, together, wall, where, world

FAR = 2.5
AWAY = 4.0


def thing(n, x=-3.1):
    """A square of skin that goes up and down, `x` to the side: by -3.1 frames 1 to 4 alone see it."""
    state = sheet((-0.16, 0.16), (-0.16, 0.16), AWAY, 0.02, skin)
    return {**state, "means": state["means"] + torch.tensor([x, 0.25 * math.sin(1.1 * n), 0.0])}


def built(folder, known, x=-3.1, motion=None):
    """(world, its motion mattes): a wall and the thing, and a model that has what is `known`."""
    made = world(
        folder, known, lambda n: together(wall(half=7.0), thing(n, x)), far=FAR,
        motion=torch.zeros(len(known["means"])) if motion is None else motion,
    )  # fmt: skip

    def mattes(n):
        return np.where(where(made, thing(n, x), n), MOVING, 0).astype(np.uint8)

    return made, mattes


@pytest.fixture(scope="module")
def lost(tmp_path_factory):
    return built(tmp_path_factory.mktemp("lost"), wall(half=7.0))


def added(made, mattes):
    """(whole scene, rows that were added)."""
    whole = with_unseen(made.run, made.scene, made.frozen, T_STAR, mattes)
    return whole, slice(len(made.frozen.support), len(whole.support))


def test_it_stands_where_the_plate_nearest_to_t_star_had_it_in_all_frames(lost):
    made, mattes = lost
    whole, rows = added(made, mattes)
    assert rows.stop > rows.start
    at = whole.state["means"][rows].median(0).values
    seen = [n for n in range(1, T_STAR) if where(made, thing(n), n).any()]
    nearest = min(seen, key=lambda n: float((at[:2] - thing(n)["means"].mean(0)[:2] * at[2] / AWAY).norm()))
    assert nearest in (3, 4), "the last that sees it whole"
    truth = together(wall(half=7.0), thing(nearest))
    target, before, after = (made.image(state, nearest) for state in (truth, made.frozen.state, whole.state))
    inside = where(made, thing(nearest), nearest)
    assert np.abs(after - target)[inside].mean() < 0.1 * np.abs(before - target)[inside].mean()
    away = float(made.scene.seconds[T_STAR - 1] - made.scene.seconds[nearest - 1])
    assert np.allclose(whole.support[rows].numpy(), math.exp(-away / SUPPORT_SECONDS), atol=1e-4)
    assert bool((whole.motion[rows] == 1.0).all())


def test_what_t_star_sees_stays_as_it_is(lost):
    made, mattes = lost
    whole, _ = added(made, mattes)
    assert np.abs(made.image(whole.state, T_STAR) - made.image(made.frozen.state, T_STAR)).max() < 1e-4


def test_only_one_is_added_though_other_plates_have_it_elsewhere(lost):
    made, mattes = lost
    whole, rows = added(made, mattes)
    means = whole.state["means"][rows]
    y = means[:, 1] * AWAY / means[:, 2]  # as high as it looks
    assert float(y.max() - y.min()) < 0.45


def test_two_things_in_one_plate_are_both_there(tmp_path):
    two = lambda n: together(thing(n), lifted(thing(n), 1.1))  # noqa: E731
    lifted = lambda state, up: {**state, "means": state["means"] + torch.tensor([0.0, up, 0.0])}  # noqa: E731
    made = world(tmp_path, wall(half=7.0), lambda n: together(wall(half=7.0), two(n)), far=FAR)
    whole, rows = added(made, lambda n: np.where(where(made, two(n), n), MOVING, 0).astype(np.uint8))
    means = whole.state["means"][rows]
    y = (means[:, 1] * AWAY / means[:, 2]).sort().values
    assert float(y[-1] - y[0]) > 1.2, "the one and the other"
    assert float((y[1:] - y[:-1]).max()) > 0.5, "and nothing between them"


def test_where_plate_t_star_has_its_say_nothing_is_added(tmp_path):
    made, mattes = built(tmp_path, wall(half=7.0), x=0.0)
    whole, rows = added(made, mattes)
    assert rows.stop == rows.start and whole.support is made.frozen.support


def test_what_the_run_has_elsewhere_is_not_there_twice(tmp_path):
    known = together(wall(half=7.0), thing(2))
    made, mattes = built(
        tmp_path, known, motion=(torch.arange(len(known["means"])) >= len(wall(half=7.0)["means"])).float()
    )
    _, rows = added(made, mattes)
    assert rows.stop == rows.start


def test_it_can_be_cancelled_before_any_plate(lost):
    made, mattes = lost
    assert stops_when_asked(lambda check: with_unseen(made.run, made.scene, made.frozen, T_STAR, mattes, check=check))


def test_without_mattes_nothing_is_added(lost):
    made, _ = lost
    assert with_unseen(made.run, made.scene, made.frozen, T_STAR, lambda n: None) is made.frozen
