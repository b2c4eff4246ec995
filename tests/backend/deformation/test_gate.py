"""The gate closes Gaussians that did not move, keeps moving pieces open, and bakes the mean change into closed ones."""

import math

import torch

from torch_backend.deformation import GateConfig, apply_deltas, change_of, painted, stays_open
from torch_backend.deformation.protocol import Deltas
from torch_backend.gaussians import PARAM_NAMES, Gaussians
from torch_backend.gaussians.model import SH_C0


def model(count=400):
    g = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=g)
    shapes = {"quats": (4,), "log_scales": (3,), "opacity_logits": (), "sh0": (1, 3), "shN": (3, 3)}
    params = {n: means if n == "means" else torch.zeros(count, *shapes[n]) for n in PARAM_NAMES}
    return Gaussians(params, 4)


def moments(count, shift=None, opacity=None, color=None):
    """Deltas at both ends of an oscillation about 0."""
    for sign in (1.0, -1.0):
        yield Deltas(
            torch.zeros(count, 3) if shift is None else sign * shift,
            torch.zeros(count, 4),
            None,
            torch.zeros(count) if opacity is None else sign * opacity,
            torch.zeros(count, 1, 3) if color is None else sign * color,
        )


def test_change_is_measured_in_pixels_colour_and_opacity():
    m, config = model(10), GateConfig()
    shift, opacity, color = torch.zeros(10, 3), torch.zeros(10), torch.zeros(10, 1, 3)
    shift[2, 1] = 0.01
    opacity[5] = 1.0
    color[7, 0, 0] = 0.5
    pixels = torch.full((10,), 100.0)
    change, _ = change_of(m, torch.arange(10), moments(10, shift, opacity, color), pixels, config)
    expected = torch.zeros(10)
    expected[2] = 0.01 * 100.0 / config.pixels
    expected[5] = (1.0 / (1.0 + math.exp(-1.0)) - 0.5) / config.opacity
    expected[7] = 0.5 * SH_C0 / config.color
    torch.testing.assert_close(change, expected)


def test_what_is_only_displaced_does_not_move():
    m = model(10)
    deltas = [Deltas(torch.full((10, 3), 0.2), torch.zeros(10, 4)) for _ in range(3)]
    change, mean = change_of(m, torch.arange(10), deltas, torch.full((10,), 100.0), GateConfig())
    assert float(change.max()) < 1e-3
    torch.testing.assert_close(mean.means, torch.full((10, 3), 0.2))
    assert mean.sh0 is None


def test_times_at_which_nobody_saw_it_say_nothing():
    m, rows = model(10), torch.arange(10)
    places = torch.tensor([0.1, 0.1, 0.7])
    deltas = [Deltas(place.expand(10, 3).clone(), torch.zeros(10, 4)) for place in places]
    seen = torch.tensor([True, True, False])[:, None].repeat(1, 10)
    seen[:, 4], seen[:, 7] = True, False
    change, mean = change_of(m, rows, deltas, torch.full((10,), 100.0), GateConfig(), seen)
    assert float(change[0]) < 1e-3
    torch.testing.assert_close(mean.means[0], torch.full((3,), 0.1))
    for row in (4, 7):  # seen at all times, or at none: both use the mean over all times
        torch.testing.assert_close(mean.means[row], torch.full((3,), 0.3))
        assert float(change[row]) > 100.0


def test_the_piece_that_moves_stays_open_and_little_else():
    m, rows = model(), torch.arange(400)
    moves = m.params["means"].detach()[:, 0] > 0.85
    change = 0.3 * torch.rand(400, generator=torch.Generator().manual_seed(1)) + 3.0 * moves
    stays = stays_open(m, rows, change, GateConfig())
    assert stays[moves].float().mean() > 0.9
    assert stays[m.params["means"].detach()[:, 0] < 0.7].float().mean() < 0.03


def test_small_camera_errors_do_not_open_static_gaussians():
    m, rows = model(), torch.arange(400)
    moves = m.params["means"].detach()[:, 0] > 0.85
    # As measured on a real clip: half of all Gaussians change by more than the threshold, but none moves.
    change = torch.empty(400).log_normal_(0.25, 0.5, generator=torch.Generator().manual_seed(2)) + 6.0 * moves
    stays = stays_open(m, rows, change, GateConfig())
    assert stays[moves].float().mean() > 0.9
    assert stays[m.params["means"].detach()[:, 0] < 0.7].float().mean() < 0.03
    assert stays_open(m, rows, change, GateConfig(noise=0.0)).float().mean() > 0.4, "without, the limit is hit"


def test_a_lone_mover_is_noise():
    m = model()
    change = torch.full((400,), 0.2)
    change[17] = 50.0
    assert not stays_open(m, torch.arange(400), change, GateConfig()).any()


def test_share_is_a_limit_and_what_moves_most_stays():
    m = model()
    # Neighbours in space have similar changes, so smoothing does not alter the order.
    change = 1.5 + m.params["means"].detach()[:, 0]
    stays = stays_open(m, torch.arange(400), change, GateConfig(max_share=0.05, noise=0.0))
    assert int(stays.sum()) == 20
    assert float(m.params["means"].detach()[stays, 0].min()) > 0.8


def test_only_what_was_painted_is_opened():
    m = model(6)
    m.support[2, 1] = True
    assert torch.nonzero(painted(m)).flatten().tolist() == [2]


def test_closed_gaussians_do_not_move():
    m = model(10)
    rows = torch.tensor([2, 5])
    deltas = Deltas(torch.ones(2, 3), torch.ones(2, 4), torch.ones(2, 3), torch.ones(2), torch.ones(2, 1, 3))
    state = apply_deltas(m, rows, deltas)
    for name in PARAM_NAMES[:-1]:
        moved = (state[name] != m.params[name]).reshape(10, -1).any(1)
        assert torch.nonzero(moved).flatten().tolist() == [2, 5]
    assert state["shN"] is m.params["shN"]
