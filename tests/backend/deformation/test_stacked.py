"""Heads side by side against the same network layer by layer, in float64."""

import pytest
import torch
from torch.nn import functional as F

from torch_backend.deformation.network import Layer
from torch_backend.deformation.stacked import stacked


def net(width: int, inputs: int, sizes: tuple[int, ...], seed: int = 0):
    g = torch.Generator().manual_seed(seed)

    def layer(rows: int, columns: int) -> Layer:
        weight = torch.randn(rows, columns, generator=g, dtype=torch.float64) / columns**0.5
        return Layer(weight.requires_grad_(), torch.randn(rows, generator=g, dtype=torch.float64).requires_grad_())

    return layer(width, inputs), [(layer(width, width), layer(size, width)) for size in sizes], g


def plain(features, trunk, heads, silu):
    bend = F.silu if silu else F.relu
    hidden = bend(F.linear(features, *trunk))
    return tuple(F.linear(bend(F.linear(hidden, *first)), *last) for first, last in heads)


@pytest.mark.parametrize("silu", [True, False])
@pytest.mark.parametrize("sizes", [(3, 4, 3, 1, 3), (3,), (1, 45, 2)])
@pytest.mark.parametrize("count", [7, 1, 0])
def test_values_and_gradients_are_those_of_one_layer_after_the_other(silu, sizes, count):
    trunk, heads, g = net(8, 5, sizes)
    leaves = [*trunk, *(tensor for first, last in heads for tensor in (*first, *last))]
    features = torch.randn(count, 5, generator=g, dtype=torch.float64).requires_grad_()
    pulls = [torch.randn(count, size, generator=g, dtype=torch.float64) for size in sizes]
    found = {}
    for name, body in (("ours", stacked), ("plain", plain)):
        out = body(features, trunk, heads, silu)
        found[name] = out, torch.autograd.grad(out, [features, *leaves], pulls)
    for ours, theirs in zip(*(found[name][0] for name in ("ours", "plain")), strict=True):
        assert ours.shape == theirs.shape
        torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)
    for ours, theirs in zip(*(found[name][1] for name in ("ours", "plain")), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)


def test_heads_nobody_asked_get_no_gradient_but_zero():
    trunk, heads, _ = net(4, 3, (2, 3))
    out = stacked(torch.ones(6, 3, dtype=torch.float64), trunk, heads, True)
    out[0].sum().backward()
    assert heads[0][1].weight.grad.abs().sum() > 0
    assert not heads[1][1].weight.grad.any() and not heads[1][0].weight.grad.any()


def test_gradients_of_features_are_left_out_where_nobody_wants_them():
    trunk, heads, _ = net(4, 3, (2,))
    features = torch.ones(6, 3, dtype=torch.float64)
    stacked(features, trunk, heads, False)[0].sum().backward()
    assert features.grad is None and trunk.weight.grad is not None
