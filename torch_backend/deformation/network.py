"""Compiled CPU implementation of the HexPlane's network (a trunk and two-layer heads) and its gradients.

The torch path in `hexplane` is the specification, and is used for other devices and types. It stores every layer of all
Gaussians before and after activation, some hundred floats each, and reads them in the backward pass. This
implementation sends tiles of a few dozen Gaussians through the whole network, stores only the outputs, and recomputes
the layers in the backward pass. Results are bit-identical for any number of threads.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from ..kernel_text import kernel_text
from ..native import INTEGER, POINTER, Snippet
from ..torch_types import AutogradContext, applied, once_differentiable, split

_TILE = 32
"""Number of Gaussians per tile."""
_UNITS = 64
"""Maximum number of shares of the Gaussians, each with separate gradients."""
_LEAST = 8 * _TILE
"""Least number of Gaussians per share."""
_PAD = 16
"""Maximum number of outputs of a head; fewer are padded with zeros."""
_KERNEL = Path(__file__).with_name("kernels") / "network.cpp"


class Layer(NamedTuple):
    """A linear layer: weight [outputs, inputs], bias [outputs]."""

    weight: Tensor
    bias: Tensor


@functools.lru_cache(maxsize=4)
def _snippet(inputs: int, width: int, heads: int) -> Snippet:
    names = (
        "x", "dx", "trunk", "trunk_t", "trunk_b", "hidden", "hidden_t", "hidden_b", "out", "out_t", "out_b", "sizes",
        "results", "pulls", "partial", "sums",
    )  # fmt: skip
    fields = {**dict.fromkeys(names, POINTER), **dict.fromkeys(("count", "rows", "units"), INTEGER)}
    source = kernel_text(_KERNEL)
    for name, value in {"IN": inputs, "WIDTH": width, "HEADS": heads, "TILE": _TILE}.items():
        source = source.replace(f"@{name}@", str(value))
    return Snippet(f"hexplane_network{inputs}x{width}x{heads}", fields, source)


def warm_up(inputs: int, width: int, heads: int) -> None:
    """Compiles the network, or loads it from the cache. Call it from the main thread."""
    _snippet(inputs, width, heads).warm_up()


def supports(features: Tensor, trunk: Layer, heads: Sequence[tuple[Layer, Layer]]) -> bool:
    """True if this module can run the network: float32 on the CPU, widths that are multiples of 16, and heads with at
    most 16 outputs."""
    return (
        features.device.type == "cpu"
        and all(t.dtype == torch.float32 for t in (features, trunk.weight))
        and all(size % 16 == 0 for size in trunk.weight.shape)
        and all(len(last.bias) <= _PAD for _, last in heads)
    )


class _Packed(NamedTuple):
    """All weights in the kernel's layout, which is documented in `network.cpp`."""

    trunk: Tensor
    trunk_t: Tensor
    trunk_b: Tensor
    hidden: Tensor
    hidden_t: Tensor
    hidden_b: Tensor
    out: Tensor
    out_t: Tensor
    out_b: Tensor
    sizes: Tensor


def _packed(params: Sequence[Tensor]) -> _Packed:
    """Packs `params`: weight and bias of the trunk, then for each head those of the hidden and of the last layer."""
    trunk, trunk_b, *heads = params
    hidden, hidden_b = torch.stack(heads[0::4]), torch.stack(heads[1::4])
    out = torch.zeros(len(hidden), _PAD, trunk.shape[0], device="cpu")
    out_b = torch.zeros(len(hidden), _PAD, device="cpu")
    for head, (weight, bias) in enumerate(zip(heads[2::4], heads[3::4], strict=True)):
        out[head, : len(bias)], out_b[head, : len(bias)] = weight, bias
    sizes = torch.tensor([len(bias) for bias in heads[3::4]], dtype=torch.int64, device="cpu")
    turned = (t.transpose(-1, -2).contiguous() for t in (trunk, hidden, out))
    trunk_t, hidden_t, out_t = turned
    return _Packed(trunk.contiguous(), trunk_t, trunk_b, hidden, hidden_t, hidden_b, out, out_t, out_b, sizes)


def _run(stage: int, threads: int | None, packed: _Packed, **values: Tensor | int) -> None:
    """Runs one stage of the kernel; unused arguments are 0."""
    used: dict[str, Tensor | int] = {
        **dict.fromkeys(("x", "dx", "results", "pulls", "partial", "sums", "count", "rows", "units"), 0),
        **packed._asdict(),
        **values,
    }
    addresses = {name: value.data_ptr() if isinstance(value, Tensor) else value for name, value in used.items()}
    width, inputs = packed.trunk.shape
    _snippet(inputs, width, len(packed.sizes)).run(threads, stage, **addresses)


def _table(tensors: Sequence[Tensor]) -> Tensor:
    return torch.tensor([t.data_ptr() for t in tensors], dtype=torch.int64, device="cpu")


class _Through(AutogradContext, Protocol):
    threads: int | None
    """Number of threads, also of the backward pass."""


class _Network(torch.autograd.Function):
    """Outputs of the heads, with gradients for the features and all weights."""

    @staticmethod
    def forward(ctx: _Through, features: Tensor, threads: int | None, *params: Tensor) -> tuple[Tensor, ...]:
        packed = _packed(params)
        results = [torch.empty(len(features), len(bias), device="cpu") for bias in params[5::4]]
        _run(0, threads, packed, x=features, results=_table(results), count=len(features))
        ctx.save_for_backward(features, *params)
        ctx.threads = threads
        return tuple(results)

    @staticmethod
    @once_differentiable
    def backward(ctx: _Through, *grads: Tensor) -> tuple[Tensor | None, ...]:
        saved: tuple[Tensor, ...] = ctx.saved_tensors
        features, *params = saved
        # Layers are computed again here: storing them would cost some hundred floats per Gaussian, and memory traffic
        # dominates.
        packed, count = _packed(params), len(features)
        pulls = [grad.contiguous() for grad in grads]
        # Shares depend on the number of Gaussians only, so the sums are bit-identical for any number of threads.
        rows = max(_LEAST, -(-count // (_UNITS * _TILE)) * _TILE)
        units = -(-count // rows)
        sizes = _sizes(packed)
        partial, sums = torch.empty(units, sum(sizes), device="cpu"), torch.empty(sum(sizes), device="cpu")
        dx = torch.empty_like(features)
        shared = {"partial": partial, "units": units}
        _run(1, ctx.threads, packed, x=features, dx=dx, pulls=_table(pulls), count=count, rows=rows, **shared)
        _run(2, ctx.threads, packed, sums=sums, **shared)
        found: list[Tensor] = []
        for n, (part, param) in enumerate(zip(split(sums, sizes), params, strict=True)):
            if n >= 2 and n % 4 == 0:  # weights of a last layer are transposed and padded
                part = part.view(-1, _PAD)[:, : len(param)].T
            elif n >= 2 and n % 4 == 1:
                part = part[: len(param)]
            found.append(part.reshape(param.shape))
        return dx, None, *found


def _sizes(packed: _Packed) -> list[int]:
    """Number of values of each gradient in the kernel's sums: weight and bias of the trunk, then four per head."""
    width, inputs = packed.trunk.shape
    return [width * inputs, width, *[width * width, width, width * _PAD, _PAD] * len(packed.sizes)]


def network(
    features: Tensor, trunk: Layer, heads: Sequence[tuple[Layer, Layer]], threads: int | None = None
) -> tuple[Tensor, ...]:
    """Outputs [M, outputs] of each head for features [M, inputs], differentiable in features and weights.

    The trunk's layer and the first layer of each head are followed by SiLU; the last layer is linear. ValueError unless
    `supports` accepts the network.
    """
    if not supports(features, trunk, heads):
        raise ValueError("a network should be float32 on the CPU, its widths multiples of 16, heads of 16 at most")
    params = [*trunk, *(tensor for first, last in heads for tensor in (*first, *last))]
    return applied(_Network, features.contiguous(), threads, *params)
