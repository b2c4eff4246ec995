"""The gate opens what has a residual, in pieces, within its share."""

import torch

from torch_backend.deformation import GateConfig, apply_deltas, open_gate, residual_per_gaussian
from torch_backend.deformation.protocol import Deltas
from torch_backend.gaussians import PARAM_NAMES, Gaussians


def model(count=400):
    g = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=g)
    shapes = {"quats": (4,), "log_scales": (3,), "opacity_logits": (), "sh0": (1, 3), "shN": (3, 3)}
    params = {n: means if n == "means" else torch.zeros(count, *shapes[n]) for n in PARAM_NAMES}
    return Gaussians(params, 4)


def test_opens_the_piece_that_moves_and_little_else():
    m = model()
    moves = m.params["means"].detach()[:, 0] > 0.85
    residual = 0.02 + 0.004 * torch.rand(400, generator=torch.Generator().manual_seed(1)) + 0.2 * moves
    opened = open_gate(m, residual, torch.full((400,), 10.0), GateConfig())
    assert opened == int(m.open.sum())
    assert m.open[moves].float().mean() > 0.9
    assert m.open[m.params["means"].detach()[:, 0] < 0.7].float().mean() < 0.03


def test_lone_noise_does_not_open():
    m = model()
    residual = torch.full((400,), 0.02) + 0.002 * torch.rand(400, generator=torch.Generator().manual_seed(2))
    residual[17] = 0.03
    open_gate(m, residual, torch.full((400,), 10.0), GateConfig(threshold=6.0))
    assert not m.open[17]


def test_share_is_a_limit_and_the_largest_go_first():
    m = model()
    residual = torch.linspace(0, 1, 400) ** 8
    open_gate(m, residual, torch.full((400,), 10.0), GateConfig(max_share=0.05, neighbours=0, threshold=0.5))
    assert int(m.open.sum()) == 20
    assert m.open[-20:].all()


def test_unpainted_gaussians_stay_closed():
    m = model()
    open_gate(m, torch.ones(400), torch.zeros(400), GateConfig())
    assert not m.open.any()


def test_residual_is_the_mean_error_of_what_is_painted():
    """Two Gaussians, two pixels: a weight matrix stands for alpha * T."""
    weights = torch.tensor([[1.0, 0.0], [0.5, 0.5]])

    def render(frame):
        error = torch.tensor([0.1, 0.3 * (frame + 1)])
        return error, lambda values: weights @ values, weights.sum(1)

    residual, weight = residual_per_gaussian([0, 1, 2], render, 2)
    # The worst third of three frames is the worst frame.
    torch.testing.assert_close(residual, torch.tensor([0.1, 0.5 * (0.1 + 0.9)]))
    torch.testing.assert_close(weight, torch.tensor([3.0, 3.0]))


def test_closed_gaussians_do_not_move():
    m = model(10)
    rows = torch.tensor([2, 5])
    deltas = Deltas(torch.ones(2, 3), torch.ones(2, 4), torch.ones(2, 3), torch.ones(2), torch.ones(2, 1, 3))
    state = apply_deltas(m, rows, deltas)
    for name in PARAM_NAMES[:-1]:
        moved = (state[name] != m.params[name]).reshape(10, -1).any(1)
        assert torch.nonzero(moved).flatten().tolist() == [2, 5]
    assert state["shN"] is m.params["shN"]
