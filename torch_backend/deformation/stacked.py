"""A trunk and its heads with all heads side by side in one matrix: a handful of torch's operators, and a backward pass
of our own.

What a field moves is little at a time, so on a card a step of it costs what its launches cost the host: seven heads of
two layers each are 15 products ahead and 30 on the way back, one by one. Side by side they are three and six. On the
CPU `network` does the same work in one pass, where it takes the network.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from ..small_tables import small_table
from ..torch_types import AutogradContext, applied, once_differentiable, split
from .network import Layer


@functools.cache
def _places(sizes: tuple[int, ...], width: int) -> tuple[tuple[int, ...]]:
    """Where the last layers' weights, head by head, lie in the matrix [outputs, heads * width] of all of them."""
    starts = itertools.count(0, len(sizes) * width)
    return (
        tuple(
            place
            for head, size in enumerate(sizes)
            for row in itertools.islice(starts, size)
            for place in range(row + head * width, row + (head + 1) * width)
        ),
    )


def _blocks(sizes: tuple[int, ...], width: int, device: torch.device) -> Tensor:
    """`_places` on a device, int64 [places]."""
    return small_table(_places(sizes, width), torch.int64, device)[0]


class _Ctx(AutogradContext, Protocol):
    silu: bool
    sizes: tuple[int, ...]
    """Outputs of each head."""


def _bent(values: Tensor, silu: bool) -> Tensor:
    return torch.nn.functional.silu(values) if silu else torch.relu(values)


def _through(pull: Tensor, before: Tensor, silu: bool) -> Tensor:
    """The gradient before a layer bends, in the place of that behind."""
    if silu:
        return torch.ops.aten.silu_backward.grad_input(pull, before, grad_input=pull)
    return torch.ops.aten.threshold_backward.grad_input(pull, before, 0.0, grad_input=pull)


class _Stacked(torch.autograd.Function):
    """All heads' outputs [M, O] side by side. Parameters: the trunk's weight and bias, then of each head four."""

    @staticmethod
    def forward(ctx: _Ctx, features: Tensor, silu: bool, *params: Tensor) -> Tensor:
        trunk, trunk_b, *rest = params
        width, heads, lasts = len(trunk), len(rest) // 4, rest[2::4]
        sizes = tuple(len(last) for last in lasts)
        first, biases = torch.cat(rest[0::4]), torch.cat([*rest[1::4], *rest[3::4]])
        first_b, last_b = biases[: heads * width], biases[heads * width :]
        last = trunk.new_zeros(sum(sizes) * heads * width)
        last[_blocks(sizes, width, trunk.device)] = torch.cat([weight.reshape(-1) for weight in lasts])
        last = last.view(sum(sizes), heads * width)
        straight = torch.addmm(trunk_b, features, trunk.T)
        wide = torch.addmm(first_b, _bent(straight, silu), first.T)
        ctx.save_for_backward(features, straight, wide, trunk, first, last)
        ctx.silu, ctx.sizes = silu, sizes
        return torch.addmm(last_b, _bent(wide, silu), last.T)

    @staticmethod
    @once_differentiable
    def backward(ctx: _Ctx, *grads: Tensor) -> tuple[Tensor | None, ...]:
        saved: tuple[Tensor, ...] = ctx.saved_tensors
        features, straight, wide, trunk, first, last = saved
        pull, sizes, silu, width = grads[0], ctx.sizes, ctx.silu, len(trunk)
        # Bent once more rather than kept: a launch each, and half of the memory.
        of_last = (pull.T @ _bent(wide, silu)).view(-1)[_blocks(sizes, width, trunk.device)]
        of_wide = _through(pull @ last, wide, silu)
        of_first = split(of_wide.T @ _bent(straight, silu), width)
        first_b, last_b = split(of_wide.sum(0), width), split(pull.sum(0), sizes)
        of_straight = _through(of_wide @ first, straight, silu)
        last_w = split(of_last.view(-1, width), sizes)
        of_heads = [part for head in zip(of_first, first_b, last_w, last_b, strict=True) for part in head]
        of_features = of_straight @ trunk if ctx.needs_input_grad[0] else None
        return of_features, None, of_straight.T @ features, of_straight.sum(0), *of_heads


def stacked(features: Tensor, trunk: Layer, heads: Sequence[tuple[Layer, Layer]], silu: bool) -> tuple[Tensor, ...]:
    """What each head says of features [M, inputs]: [M, its outputs], differentiable in everything.

    The trunk's layer bends by SiLU, or ReLU, and so does the first of each head, which has as many outputs as the
    trunk; the last does not.
    """
    params = [*trunk, *(tensor for first, last in heads for tensor in (*first, *last))]
    out: Tensor = applied(_Stacked, features, silu, *params)
    return split(out, [len(last.bias) for _, last in heads], 1)
