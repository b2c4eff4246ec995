"""The compiled network, compared with torch's operators and autograd in float64."""

import pytest
import torch
from torch.nn import functional as F

from torch_backend.deformation import HexPlane, HexPlaneConfig, network
from torch_backend.deformation.network import Layer

SIZES = (3, 4, 3, 1, 3)


def layers(inputs=32, width=64, sizes=SIZES, dtype=torch.float32):
    """A trunk and heads as leaf tensors, with equal values in every dtype."""
    g = torch.Generator().manual_seed(0)

    def drawn(*shape):
        return (torch.randn(*shape, generator=g) / shape[-1] ** 0.5).to(dtype).requires_grad_()

    heads = [(Layer(drawn(width, width), drawn(width)), Layer(drawn(n, width), drawn(n))) for n in sizes]
    return Layer(drawn(width, inputs), drawn(width)), heads


def leaves(trunk, heads):
    return [*trunk, *(tensor for first, last in heads for tensor in (*first, *last))]


def by_torch(x, trunk, heads):
    hidden = F.silu(F.linear(x, *trunk))
    return tuple(F.linear(F.silu(F.linear(hidden, *first)), *last) for first, last in heads)


def pulled(results, pulls):
    torch.stack([(value * pull).sum() for value, pull in zip(results, pulls, strict=True)]).sum().backward()


def relative_error(got, want):
    return float((got.double() - want).norm() / want.norm())


# Rows: one, a tile and one, and several chunks of gradient sums. Trunks: of one level, of three, and wide. Heads: with
# one output, and with sixteen.
@pytest.mark.parametrize(
    ("count", "inputs", "width", "sizes"),
    [(1, 32, 64, SIZES), (33, 32, 64, SIZES), (3001, 32, 64, SIZES), (301, 16, 32, (16,)), (301, 48, 128, (1, 9))],
)
def test_values_and_gradients_match_float64(count, inputs, width, sizes):
    g = torch.Generator().manual_seed(1)
    x = torch.randn(count, inputs, generator=g)
    ours, exact = layers(inputs, width, sizes), layers(inputs, width, sizes, torch.float64)
    at, exactly_at = x.clone().requires_grad_(), x.double().requires_grad_()
    got, want = network.network(at, *ours), by_torch(exactly_at, *exact)
    pulls = [torch.randn(value.shape, generator=g) for value in got]
    pulled(got, pulls)
    pulled(want, [pull.double() for pull in pulls])
    assert [value.shape for value in got] == [(count, size) for size in sizes]
    assert max(relative_error(a.detach(), b.detach()) for a, b in zip(got, want, strict=True)) < 1e-5
    pairs = zip([at, *leaves(*ours)], [exactly_at, *leaves(*exact)], strict=True)
    assert max(relative_error(a.grad, b.grad) for a, b in pairs) < 1e-5


def test_far_out_it_bends_as_silu_does():
    """Where exp overflows, SiLU is 0 or the identity, with slope 0 or 1."""
    eye = Layer(torch.eye(16), torch.zeros(16))
    x = torch.tensor([-1e4, -200.0, -90.0, 90.0, 200.0, 1e4]).repeat_interleave(16).view(6, 16).requires_grad_()
    (value,) = network.network(x, eye, [(eye, eye)])
    value.sum().backward()
    want = F.silu(F.silu(x.detach().double()))
    torch.testing.assert_close(value.detach().double(), want, rtol=1e-6, atol=1e-30)
    torch.testing.assert_close(x.grad[:, 0], torch.tensor([0.0, 0, 0, 1, 1, 1]), rtol=1e-6, atol=1e-30)


def test_what_is_not_a_number_stays_with_its_row():
    x = torch.randn(40, 32, generator=torch.Generator().manual_seed(2))
    x[7] = float("nan")
    for value in network.network(x, *layers()):
        bad = ~torch.isfinite(value.detach()).all(1)
        assert torch.nonzero(bad).flatten().tolist() == [7]


def test_any_number_of_threads_gives_the_same_bits():
    x = torch.randn(5003, 32, generator=torch.Generator().manual_seed(3))
    results = []
    for threads in (1, 2, 3, 8):
        linear_layers, at = layers(), x.clone().requires_grad_()
        value = network.network(at, *linear_layers, threads)
        torch.stack([part.square().sum() for part in value]).sum().backward()
        results.append(
            torch.cat([t.detach().flatten() for t in (*value, at.grad, *(p.grad for p in leaves(*linear_layers)))])
        )
    assert all(torch.equal(results[0], repeated) for repeated in results[1:])


def test_no_rows_at_all():
    linear_layers, x = layers(), torch.zeros(0, 32, requires_grad=True)
    value = network.network(x, *linear_layers)
    torch.stack([part.sum() for part in value]).sum().backward()
    assert [part.shape for part in value] == [(0, n) for n in SIZES]
    assert all(float(p.grad.abs().max()) == 0.0 for p in leaves(*linear_layers))


def test_field_uses_the_kernel_and_other_networks_use_torch(monkeypatch):
    calls = []
    whole = network.network
    monkeypatch.setattr(network, "network", lambda *args: calls.append(args) or whole(*args))
    box = torch.tensor([[-1.0, -1, -1], [1, 1, 1]])
    means, times = torch.rand(5, 3), torch.tensor([0.5])
    for config in (
        HexPlaneConfig(time_nodes=4, width=24),
        HexPlaneConfig(time_nodes=4, features=5),
        HexPlaneConfig(time_nodes=4, silu=False),
        HexPlaneConfig(time_nodes=4, published=True),
    ):
        field = HexPlane(config, box, torch.Generator().manual_seed(0), harmonics=8)
        field(means, times)
        assert len(calls) == 0
    usual = HexPlane(HexPlaneConfig(time_nodes=4), box, torch.Generator().manual_seed(0))
    usual(means, times)
    assert len(calls) == 1
    usual.double()(means.double(), times.double())
    assert len(calls) == 1
    trunk, heads = layers(24)
    with pytest.raises(ValueError, match="16"):
        network.network(torch.zeros(1, 24), trunk, heads)
