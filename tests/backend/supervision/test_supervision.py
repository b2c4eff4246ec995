"""Support bitmaps and the two anchoring rules, against values worked out by hand."""

import math

import numpy as np
import pytest
import torch

from torch_backend.deformation.protocol import Deltas
from torch_backend.gaussians import PARAM_NAMES, Gaussians
from torch_backend.supervision import (
    PaperView,
    SupervisionConfig,
    bin_of,
    bin_times,
    draw_anchored,
    mark_seen,
    nearest_bin,
    nearest_supported,
    paper_loss,
    support_confidence,
    support_loss,
)


def model(support):
    support = torch.tensor(support, dtype=torch.bool)
    count = len(support)
    shapes = {"means": (3,), "quats": (4,), "log_scales": (3,), "opacity_logits": (), "sh0": (1, 3), "shN": (3, 3)}
    m = Gaussians({n: torch.zeros(count, *shapes[n]) for n in PARAM_NAMES}, support.shape[1])
    m.support = support
    m.open[:] = True
    return m


def test_bins_are_the_trained_times_or_256_even_ones():
    assert bin_times(np.array([0.0, 0.25, 1.0])).tolist() == [0.0, 0.25, 1.0]
    assert len(bin_times(np.linspace(0, 1, 1000))) == 256
    assert bin_of(bin_times(np.array([0.0, 0.25, 1.0])), 0.2) == 1
    with pytest.raises(ValueError, match="distinct"):
        bin_times(np.array([0.5, 0.5]))


def test_mark_seen_takes_what_painted():
    m = model([[0, 0], [0, 0]])
    mark_seen(m, 1, torch.tensor([0.01, 3.0]))
    assert m.support.tolist() == [[False, False], [False, True]]


def test_nearest_supported_on_both_sides():
    support = torch.tensor([[1, 0, 0, 1, 0], [0, 0, 0, 0, 1], [0, 0, 0, 0, 0]], dtype=torch.bool)
    left, has_left, right, has_right = nearest_supported(support, torch.tensor([2, 2, 2]))
    assert left.tolist() == [0, 2, 2]
    assert has_left.tolist() == [True, False, False]
    assert right.tolist() == [3, 4, 2]
    assert has_right.tolist() == [True, True, False]


def test_nearest_bin_by_time_not_by_index():
    centres = torch.tensor([0.0, 0.1, 0.9, 1.0])
    best, known = nearest_bin(torch.tensor([[1, 1, 1, 0], [0, 0, 0, 0]], dtype=torch.bool), centres, 0.4)
    assert best[0] == 1
    assert known.tolist() == [True, False]


def test_confidence_is_one_for_the_static_and_decays_for_the_moving():
    centres = torch.linspace(0, 1, 11)
    support = torch.zeros(3, 11, dtype=torch.bool)
    support[:2, 0] = True
    known = support_confidence(support, torch.tensor([False, True, True]), centres, 1.0, decay=0.5)
    assert known.tolist() == pytest.approx([1.0, math.exp(-0.95 / 0.5), 0.0], abs=1e-6)


class Ramp:
    """A field whose mean delta is its time along x: what an anchor should be is then known."""

    def __init__(self):
        self.slope = torch.tensor(1.0, requires_grad=True)

    def __call__(self, means, times):
        count = len(means)
        shift = torch.zeros(count, 3)
        shift[:, 0] = 1.0
        moved = shift * (times.expand(count) * self.slope)[:, None]
        return Deltas(moved, torch.zeros(count, 4), torch.zeros(count, 3), torch.zeros(count), torch.zeros(count, 1, 3))


def anchor(m, field, bins):
    """The support loss of whatever is drawn from all open Gaussians; None if nothing is."""
    config, centres = SupervisionConfig(), torch.linspace(0, 1, bins)
    rows = torch.nonzero(m.open).flatten()
    pairs = draw_anchored(m, rows, config, torch.Generator().manual_seed(0))
    if pairs is None:
        return None
    here = field(m.params["means"].detach()[pairs.rows], centres[pairs.bins])
    return support_loss(m, field, pairs, here, centres, 1.0, config)


def test_drawn_pairs_are_unsupported_and_half_of_them_near_support():
    flags = [[0, 0, 1, 1, 0, 0, 0, 0], [1, 1, 1, 1, 1, 1, 1, 0], [0, 0, 0, 0, 0, 0, 0, 0]]
    m = model(flags)
    pairs = draw_anchored(m, torch.arange(3), SupervisionConfig(), torch.Generator().manual_seed(1))
    assert 200 < len(pairs.rows) <= SupervisionConfig().support_samples
    assert not bool(m.support[pairs.rows, pairs.bins].any())
    assert set(pairs.rows.tolist()) == {0, 1}
    assert set(pairs.bins[pairs.rows == 0].tolist()) == {0, 1, 4, 5, 6, 7}
    assert bool((pairs.weights == 1).all())


def test_support_loss_is_zero_where_time_interpolates_between_anchors():
    """Seen at both ends: a linear motion lies exactly between its anchors."""
    m = model([[1, 0, 0, 0, 1]])
    loss = anchor(m, Ramp(), 5)
    assert float(loss.detach()) == pytest.approx(0.0, abs=1e-6)


def test_support_loss_pulls_an_extrapolation_back():
    m = model([[1, 0, 0, 0, 0]])
    field = Ramp()
    loss = anchor(m, field, 5)
    loss.backward()
    assert float(loss.detach()) > 0
    assert float(field.slope.grad) > 0  # descending it slows the drift
    assert m.params["means"].grad is None  # canonical parameters are not moved


def test_support_loss_needs_open_gaussians_that_were_seen():
    m = model([[0, 0, 0]])
    assert anchor(m, Ramp(), 3) is None
    m = model([[1, 1, 1]])
    assert anchor(m, Ramp(), 3) is None


def view(time, x, inside, gradient, flip=1.0):
    count = len(x)
    quats = torch.zeros(count, 4)
    quats[:, 0] = flip
    means = torch.zeros(count, 3)
    means[:, 0] = torch.tensor(x)
    state = {
        "means": means.requires_grad_(),
        "quats": quats,
        "log_scales": torch.zeros(count, 3),
        "opacity_logits": torch.zeros(count),
        "sh0": torch.zeros(count, 1, 3),
    }
    return PaperView(time, state, torch.tensor(inside), torch.tensor(gradient))


def test_paper_hidden_goes_to_the_past_defective_to_the_future():
    config = SupervisionConfig()
    early = view(0.2, [0.0, 0.0, 0.0], [True, True, True], [1.0, 0.0, 1.0])
    late = view(0.4, [2.0, 3.0, 9.0], [False, True, True], [0.0, 1.0, 1.0], flip=-1.0)
    loss = paper_loss(late, early, 0.5, config)
    phi = math.exp(-5 * 0.2)
    # Squared L2: Gaussian 0 is hidden late (2^2), 1 is defective early (3^2), 2 is well supervised in both.
    assert float(loss.detach()) == pytest.approx(10 * phi * 4 + 10 * phi * 9, rel=1e-5)
    loss.backward()
    assert late.state["means"].grad[0, 0] > 0
    assert early.state["means"].grad[1, 0] < 0
    assert early.state["means"].grad[0].abs().sum() == 0  # the reference is detached
    linear = paper_loss(late, early, 0.7, config)
    assert float(linear.detach()) == pytest.approx(10 * phi * 2 + 10 * phi * 3, rel=1e-5)


def test_paper_needs_a_well_supervised_reference_and_two_times():
    config = SupervisionConfig()
    hidden_both = view(0.2, [0.0], [False], [0.0]), view(0.4, [2.0], [False], [0.0])
    assert paper_loss(*hidden_both, 0.5, config) is None
    same = view(0.2, [0.0], [True], [1.0]), view(0.2, [2.0], [False], [0.0])
    assert paper_loss(*same, 0.5, config) is None
