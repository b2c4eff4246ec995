"""Support bitmaps and the two anchoring rules, compared with hand-computed values."""

import math

import numpy as np
import pytest
import torch

from torch_backend.deformation.protocol import Deltas
from torch_backend.gaussians import PARAM_NAMES, Gaussians
from torch_backend.supervision import (
    PaperView,
    SupervisionConfig,
    anchored_pairs,
    bin_of,
    bin_times,
    draw,
    mark_hidden,
    mark_seen,
    nearest_bin,
    nearest_supported,
    paper_loss,
    still_weight,
    stillness,
    support_confidence,
    support_loss,
    well_supervised,
)

CONFIG = SupervisionConfig()


def drawn(m, rows, config, seed):
    draws = draw(len(rows), m.support.shape[1], config, torch.Generator().manual_seed(seed))
    return anchored_pairs(m, rows, draws, config)


def model(support):
    support = torch.tensor(support, dtype=torch.bool)
    count = len(support)
    shapes = {"means": (3,), "quats": (4,), "log_scales": (3,), "opacity_logits": (), "sh0": (1, 3), "shN": (3, 3)}
    m = Gaussians({n: torch.zeros(count, *shapes[n]) for n in PARAM_NAMES}, support.shape[1])
    m.support = support
    m.hidden[:] = True
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
    mark_seen(m, torch.tensor([1]), torch.tensor([0.01, 3.0]))
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
    """Field whose mean delta equals the time along x, so that anchors are known."""

    def __init__(self):
        self.slope = torch.tensor(1.0, requires_grad=True)

    def __call__(self, means, times, host_params=None):
        count = len(means)
        shift = torch.zeros(count, 3)
        shift[:, 0] = 1.0
        moved = shift * (times.expand(count) * self.slope)[:, None]
        return Deltas(moved, torch.zeros(count, 4), torch.zeros(count, 3))


def anchor(m, field, bins):
    """Support loss of the pairs drawn from all open Gaussians; None without pairs."""
    config, centres = SupervisionConfig(), torch.linspace(0, 1, bins)
    rows = torch.nonzero(m.open).flatten()
    pairs = drawn(m, rows, config, 0)
    if pairs is None:
        return None
    deltas = field(m.params["means"].detach()[pairs.rows], centres[pairs.bins])
    return support_loss(m, field, pairs, deltas, centres, 1.0, config)


def test_drawn_pairs_are_unsupported_and_half_of_them_near_support():
    flags = [[0, 0, 1, 1, 0, 0, 0, 0], [1, 1, 1, 1, 1, 1, 1, 0], [0, 0, 0, 0, 0, 0, 0, 0]]
    m = model(flags)
    pairs = drawn(m, torch.arange(3), SupervisionConfig(), 1)
    assert 200 < len(pairs.rows) <= SupervisionConfig().support_samples
    assert not bool(m.support[pairs.rows, pairs.bins].any())
    assert bool(m.hidden[pairs.rows, pairs.bins].all())
    assert set(pairs.rows.tolist()) == {0, 1}
    assert set(pairs.bins[pairs.rows == 0].tolist()) == {0, 1, 4, 5, 6, 7}
    assert bool((pairs.weights == 1).all())


def test_support_loss_is_zero_where_time_interpolates_between_anchors():
    """A Gaussian is seen at both ends: a linear motion lies exactly between its anchors."""
    m = model([[1, 0, 0, 0, 1]])
    loss = anchor(m, Ramp(), 5)
    assert float(loss.detach()) == pytest.approx(0.0, abs=1e-6)


def test_support_loss_pulls_an_extrapolation_back():
    m = model([[1, 0, 0, 0, 0]])
    field = Ramp()
    loss = anchor(m, field, 5)
    loss.backward()
    assert float(loss.detach()) > 0
    assert float(field.slope.grad) > 0  # gradient descent slows the drift
    assert m.params["means"].grad is None  # canonical parameters do not change


def test_support_loss_needs_open_gaussians_that_were_seen():
    m = model([[0, 0, 0]])
    assert anchor(m, Ramp(), 3) is None
    m = model([[1, 1, 1]])
    assert anchor(m, Ramp(), 3) is None


def shifts(*lengths):
    means = torch.zeros(len(lengths), 3)
    means[:, 0] = torch.tensor(lengths)
    return Deltas(means.requires_grad_(True), torch.zeros(len(lengths), 4))


ERROR = torch.tensor(0.05)


def price(deltas, count=1, progress=1.0, error=ERROR):
    return float(stillness(deltas, count, error, torch.tensor(still_weight(progress, CONFIG)), CONFIG).detach())


def test_stillness_costs_nothing_at_rest_and_less_and_less_beyond():
    assert price(shifts(0.0, 0.0)) == 0.0
    near, far = price(shifts(0.01)) - price(shifts(0.005)), price(shifts(1.005)) - price(shifts(1.0))
    assert 0.0 < far < 0.1 * near


def test_stillness_is_the_sum_over_attributes_of_what_each_moves_by():
    g = torch.Generator().manual_seed(0)
    shapes = {"means": (3,), "quats": (4,), "log_scales": (3,), "opacity_logits": (), "sh0": (1, 3), "shN": (8, 3)}
    drawn = {name: 0.1 * torch.randn(7, *shape, generator=g) for name, shape in shapes.items()}
    config, cost = SupervisionConfig(), torch.zeros(7, dtype=torch.float64)
    for name, value in drawn.items():
        weight = {"means": 5.0, "opacity_logits": 1.0, "sh0": 1.0}.get(name, 0.5)
        knee = config.still_knee * 5.0 / weight
        cost += weight * ((value.double().flatten(1) if value.dim() > 1 else value.double()[:, None]).square().sum(1)
                          + knee**2).sqrt() - weight * knee  # fmt: skip
    want = 0.05 * config.still_weight * config.still_scale * torch.log1p(cost / config.still_scale).sum() / 20
    assert price(Deltas(**drawn), 20) == pytest.approx(float(want), rel=1e-5)


def test_stillness_is_paid_in_photometric_loss_and_does_not_change_it():
    error = torch.tensor(0.05, requires_grad=True)
    deltas = shifts(0.1)
    stillness(deltas, 1, error, torch.tensor(still_weight(1.0, CONFIG)), CONFIG).backward()
    assert error.grad is None
    assert float(deltas.means.grad[0, 0]) > 0.0
    assert price(shifts(0.1), error=0.5 * ERROR) == pytest.approx(0.5 * price(shifts(0.1)))


def test_loss_per_gaussian_is_independent_of_the_open_count():
    many, few = shifts(0.1, 0.0, 0.0, 0.0), shifts(0.1)
    assert price(many, 4) == pytest.approx(price(few, 4))
    for deltas in (many, few):
        stillness(deltas, 4, ERROR, torch.tensor(still_weight(1.0, CONFIG)), CONFIG).backward()
    torch.testing.assert_close(many.means.grad[0], few.means.grad[0])


def test_a_field_may_look_for_motion_before_it_has_to_pay():
    start = SupervisionConfig().start
    prices = [price(shifts(0.5), progress=start + share) for share in (0.0, 0.1, 0.2, 0.6)]
    assert prices[0] == 0.0
    assert prices[1] == pytest.approx(0.5 * prices[2])
    assert prices[2] == prices[3]


def test_visible_gaussians_that_do_not_contribute_are_not_anchored():
    """Its Gaussian moved away: frames show that it is gone, so nothing pulls it back."""
    m = model([[1, 1, 0, 0, 0, 0]] * 2)
    m.hidden[0] = False
    config = SupervisionConfig()

    def rows_drawn(config: SupervisionConfig) -> set[int]:
        pairs = drawn(m, torch.arange(2), config, 1)
        return set() if pairs is None else set(pairs.rows.tolist())

    assert rows_drawn(config) == {1}
    assert rows_drawn(SupervisionConfig(anchor="unsupported")) == {0, 1}
    m.hidden[:] = False
    assert rows_drawn(config) == set()


def test_hidden_is_out_of_the_frame_or_behind_what_is_seen():
    K = torch.tensor([[10.0, 0, 16.0], [0, 10.0, 8.0], [0, 0, 1]])
    viewmat = torch.eye(4)
    viewmat[2, 3] = 1.0  # the camera is one unit behind the origin
    means = torch.tensor([[0.0, 0, 2], [0, 0, 1], [0, 0, 2.9], [9.0, 0, 2], [0, 0, -3], [1.0, 0, 4], [0, 0, 2.2]])
    count = len(means)
    m = model([[0, 0]] * count)
    m.hidden[:] = False
    m.hidden[0, 1] = True
    state = {"means": means, "log_scales": torch.full((count, 3), math.log(0.05))}
    state["log_scales"][6, 1] = math.log(0.5)
    depth = torch.full((16, 32), 3.0)
    depth[8, 18] = 1e10  # a hole in the picture
    mark_hidden(m, torch.arange(count), torch.tensor([1]), state, viewmat, K, depth)
    # On the surface, in front, behind, right of the frame, behind the camera, in the hole, and large and half behind.
    assert m.hidden[:, 1].tolist() == [False, False, True, True, True, False, False]
    assert not bool(m.hidden[:, 0].any())


@pytest.mark.parametrize(("is_gone", "anchored"), [(True, False), (False, True)])
def test_render_distinguishes_vanished_from_occluded(is_gone, anchored):
    """A dot on a wall fades: in plain view, or behind a post in front of it. Only the covered dot is a guess."""
    from torch_backend.raster import rasterize

    wall = torch.stack(torch.meshgrid(torch.linspace(-2, 2, 17), torch.linspace(-1.5, 1.5, 13), indexing="ij"), -1)
    wall = torch.cat([wall.reshape(-1, 2), torch.full((221, 1), 4.0)], dim=1)
    post = torch.tensor([[0.0, 0, 2.0]])
    means = torch.cat([wall, torch.tensor([[0.0, 0, 3.9]]), post])
    quats = torch.zeros(223, 4)
    quats[:, 0] = 1
    logits = torch.full((223,), 5.0)
    logits[221] = -6.0  # the dot has faded
    logits[222] = -9.0 if is_gone else 5.0
    state = {
        "means": means,
        "quats": quats,
        "log_scales": torch.full((223, 3), math.log(0.15)),
        "opacity_logits": logits,
    }
    K = torch.tensor([[30.0, 0, 16.0], [0, 30.0, 12.0], [0, 0, 1]])
    out = rasterize(
        **state, colors=torch.rand(223, 3), viewmats=torch.eye(4)[None], Ks=K[None], width=32, height=24,
        with_depth=True, with_contributions=True,
    )  # fmt: skip
    m = model([[1, 0]] * 223)
    m.hidden[:] = False
    mark_seen(m, torch.tensor([1]), out.weight_sum[0])
    mark_hidden(m, torch.tensor([221]), torch.tensor([1]), state, torch.eye(4), K, out.depth_median[0])
    assert not bool(m.support[221, 1])
    assert bool(m.hidden[221, 1]) == anchored


def test_detectors_match_hand_computed_gradients():
    K = torch.tensor([[10.0, 0, 16.0], [0, 20.0, 8.0], [0, 0, 1]])
    means = torch.tensor([[0.0, 0, 2]] * 4)
    # NDC gradient = pixel gradient * half the image size; pixel gradient = gradient of the mean * depth / focal length.
    pull = torch.tensor([[1.0, -1.0, 0], [-1.0, 1.0, 0], [-1.0, 3.0, 0], [0, 0, 7.0]])
    sums = [1 * 2 / 10 * 16 - 1 * 2 / 20 * 8, -3.2 + 0.8, -3.2 + 2.4, 0.0]
    norm = torch.tensor([0.5, 1e-8, 1e-10, 0.0])
    weight = torch.tensor([0.0, 0.05, 3.0, 0.2])

    def acted(detector, viewmat):
        config = SupervisionConfig(detector=detector)
        place = (means - viewmat[:3, 3]) @ viewmat[:3, :3]
        turned = pull @ viewmat[:3, :3]
        return well_supervised(config, weight, norm, turned, K, viewmat, place, (32, 16)).tolist()

    straight = torch.eye(4)
    assert acted("weight", straight) == [False, False, True, True]
    assert acted("grad_norm", straight) == [True, True, False, False]
    assert acted("grad_signed", straight) == [s > 0 for s in sums] == [True, False, False, False]
    camera = torch.eye(4)
    camera[:3, :3] = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    camera[:3, 3] = torch.tensor([0.3, -0.2, 0.5])
    assert acted("grad_signed", camera) == acted("grad_signed", straight)
    with pytest.raises(ValueError, match="grad_signed"):
        acted("gradient", straight)


def test_signed_sum_matches_the_rasteriser_norm():
    """The mean's gradient across the line of sight is the screen gradient, up to the effect of the Gaussian's shape."""
    from torch_backend.raster import rasterize

    g = torch.Generator().manual_seed(0)
    count = 60
    means = (torch.rand(count, 3, generator=g) - 0.5) * torch.tensor([2.0, 1.4, 1.0]) + torch.tensor([0, 0, 4.0])
    means.requires_grad_()
    quats = torch.randn(count, 4, generator=g)
    K = torch.tensor([[40.0, 0, 24.0], [0, 40.0, 16.0], [0, 0, 1]])
    out = rasterize(
        means, quats, torch.full((count, 3), math.log(0.06)), torch.zeros(count), torch.rand(count, 3, generator=g),
        viewmats=torch.eye(4)[None], Ks=K[None], width=48, height=32,
    )  # fmt: skip
    (out.colors[0] - torch.rand(32, 48, 3, generator=g)).square().mean().backward()
    pixel = means.grad[:, :2] * means.detach()[:, 2:] / 40.0
    norm = out.means2d_grad[0]
    seen = norm > 1e-6
    assert int(seen.sum()) > 40
    assert float(((pixel.norm(dim=1) - norm).abs() / norm)[seen].median()) < 0.05


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
    return PaperView(time, state, torch.tensor(inside), torch.tensor(gradient) > 1e-9)


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
