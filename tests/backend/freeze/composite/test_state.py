"""Posterior of a plate's state: the evidence, and the matte from its log-odds."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from benchmarks.fit_state import NAMES, Case, fit, judged
from tests.backend.freeze.composite.test_compositor import H, W, dilate
from torch_backend.freeze.composite.compositor import Compositor
from torch_backend.freeze.composite.state import StateConfig, StateWeights, evidence, log_odds, rejection
from torch_backend.freeze.frozen import freeze_at, render_frozen
from torch_backend.freeze.views.ignored import ignore_mattes
from torch_backend.freeze.views.source_views import SourceViews
from torch_backend.freeze.views.target_view import target_view

FRAME, T_STAR = 3, 11
"""The board's positions in these two frames do not overlap."""


@pytest.fixture(scope="module")
def found(world):
    """(evidence of plate FRAME against t*, evidence without t*, mask of the plate's board, mask of the board at t*)."""
    output = world.output(FRAME, T_STAR)
    frozen = freeze_at(world.run.model, world.scene.time_of_frame(T_STAR), 1.0)
    image = render_frozen(frozen, output.viewmat, output.K, W, H)
    views: SourceViews = Compositor(world.run, world.scene, world.plates()).source_views
    target = target_view(views, output, frozen, image, W, H)
    seen, instant = (views.seen(frame, target.points) for frame in (FRAME, T_STAR))
    with_instant = evidence(views, target, FRAME, seen, instant, StateConfig())
    without_instant = evidence(views, target, FRAME, seen, None, StateConfig())
    return with_instant, without_instant, world.seen_at(FRAME)[1], world.truth(output)[1]


def test_each_piece_of_evidence_is_large_where_it_should_be(found):
    with_instant, without_instant, board_now, board_at_t_star = found
    still, gone = (
        np.logical_not(dilate(board_now | board_at_t_star, 24)),
        board_now & np.logical_not(dilate(board_at_t_star, 8)),
    )
    assert set(with_instant) == {f.name for f in fields(StateWeights)} - {"bias"}
    for name in ("change", "contradiction", "gain"):
        value = with_instant[name].numpy()
        assert value[gone].mean() > value[still].mean() + 1.0, name
    moved = with_instant["scene_flow"].numpy()
    assert moved[board_at_t_star].mean() > 2.0 and moved[still].max() < 0.1
    assert not without_instant["contradiction"].any(), "plate t* may not be used"
    assert (with_instant["change"] <= without_instant["change"]).all(), "plate t* says how noisy renders are"


def test_odds_are_a_weighted_sum_and_a_still_world_keeps_its_plate_to_the_bit(found):
    with_instant, _, board_now, board_at_t_star = found
    config = StateConfig(smoothing=0.0)
    weights = config.weights
    want = weights.bias + sum(getattr(weights, name) * with_instant[name].double() for name in with_instant)
    torch.testing.assert_close(log_odds(with_instant, config, 1.0).double(), want, rtol=1e-5, atol=1e-5)
    share = rejection(log_odds(with_instant, StateConfig(), W / 640), StateConfig()).numpy()
    assert (share[np.logical_not(dilate(board_now | board_at_t_star, 40))] == 0.0).all()
    assert (share[board_now & np.logical_not(dilate(board_at_t_star, 8))] > 0.99).mean() > 0.95


def test_log_odds_become_a_soft_border():
    odds = torch.tensor([-9.0, -2.0, -1.0, 0.0, 1.0, 2.0, 9.0])
    share = rejection(odds, StateConfig(softness=2.0))
    torch.testing.assert_close(share, torch.tensor([0.0, 0.0, 0.25, 0.5, 0.75, 1.0, 1.0]))


def test_fitting_finds_the_evidence_that_tells_and_leaves_the_rest():
    """One kind of evidence marks where the plate is wrong, the others are noise; where it is wrong, the fill is
    right."""
    torch.manual_seed(0)
    wrong = torch.zeros(2, 32, 40)
    wrong[:, 8:24, 10:30] = 1.0
    truth = torch.full((2, 32, 40, 3), 0.5)
    values = torch.randn(2, 32, 40, len(NAMES)) * 0.3
    values[..., NAMES.index("change")] += 2.0 * wrong
    plate, filled = truth + 0.3 * wrong[..., None], truth + 0.1 * (1.0 - wrong[..., None])
    case = Case("made", values, plate, filled, truth, wrong > 0.5, 1.0)
    weights = fit([case])
    assert weights.change > 3.0 * max(abs(getattr(weights, name)) for name in NAMES if name != "change")
    figures = judged(case, weights)
    assert figures["mixed whole"] > max(figures["plate whole"], figures["fill whole"]) + 5.0
    assert figures["mixed whole"] > judged(case, replace(weights, change=0.0))["mixed whole"] + 5.0


def test_a_shot_without_masks_ignores_nothing(world):
    assert [ignore_mattes(world.shot)(frame) for frame in (FRAME, T_STAR)] == [None, None]
