"""Compiled feature planes of the HexPlane: products of samples, smoothness penalty, and gradients of both.

The torch path in `hexplane` is the specification, and is used for other devices and types. Planes on an NVIDIA GPU use
`planes_cuda`. On the CPU, torch waits for memory, because the channels of a scattered sample are far apart. Its small
operators also have more overhead than arithmetic. Here, channels are contiguous (`channels_last`), and one pass
computes the product of a level's six samples. One thread computes all gradients of a plane, so that results are
bit-identical for any number of threads.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor

from ..kernel_text import kernel_text
from ..native import INTEGER, POINTER, Snippet
from ..torch_types import AutogradContext, applied, once_differentiable
from . import planes_cuda

LANES = 16
"""On the CPU, the number of features must be a multiple of this."""
_POINTS = 64
"""Points per unit of work."""

_KERNELS = Path(__file__).with_name("kernels")


@functools.lru_cache(maxsize=4)
def _sampler(channels: int) -> Snippet:
    fields = {
        **dict.fromkeys(("planes", "grads", "sizes", "where", "samples", "features", "pulls"), POINTER),
        **dict.fromkeys(("count", "levels"), INTEGER),
    }
    source = kernel_text(_KERNELS / "plane_samples.cpp")
    source = source.replace("@CHANNELS@", str(channels)).replace("@POINTS@", str(_POINTS))
    return Snippet(f"hexplane_samples{channels}", fields, source)


@functools.lru_cache(maxsize=4)
def _penalty(channels: int) -> Snippet:
    fields = {
        **dict.fromkeys(("planes", "grads", "sizes", "rows", "weights", "partial"), POINTER), "count": INTEGER,
    }  # fmt: skip
    source = kernel_text(_KERNELS / "plane_penalty.cpp").replace("@CHANNELS@", str(channels))
    return Snippet(f"hexplane_penalty{channels}", fields, source)


def warm_up(channels: int = 16) -> None:
    """Compiles the kernels, or loads them from the cache. Call it from the main thread."""
    _sampler(channels).warm_up()
    _penalty(channels).warm_up()


def supports(planes: Sequence[Tensor]) -> bool:
    """True if this module supports the planes: float32, channels last, on the CPU a multiple of `LANES` features."""
    if planes[0].is_cuda:
        return planes_cuda.supports(planes)
    return all(
        p.dtype == torch.float32 and p.device.type == "cpu" and p.shape[1] % LANES == 0
        and p.is_contiguous(memory_format=torch.channels_last) for p in planes
    )  # fmt: skip


def _table(tensors: Sequence[Tensor]) -> Tensor:
    return torch.tensor([t.data_ptr() for t in tensors], dtype=torch.int64, device="cpu")


def _sizes(planes: Sequence[Tensor]) -> Tensor:
    return torch.tensor([p.shape[2:] for p in planes], dtype=torch.int64, device="cpu")


class _Sampling(AutogradContext, Protocol):
    threads: int | None
    """Number of threads, also of the backward pass."""


class _Product(torch.autograd.Function):
    """Features of points, with gradients for the planes and the points."""

    @staticmethod
    def forward(ctx: _Sampling, positions: Tensor, threads: int | None, *planes: Tensor) -> Tensor:
        count, channels, levels = len(positions), planes[0].shape[1], len(planes) // 6
        features = torch.empty(count, levels * channels, device="cpu")
        differentiable = any(ctx.needs_input_grad)
        samples = torch.empty(len(planes), count, channels, device="cpu") if differentiable else None
        pointers, sizes = _table(planes), _sizes(planes)
        _sampler(channels).run(
            threads, planes=pointers.data_ptr(), grads=0, sizes=sizes.data_ptr(), where=positions.data_ptr(),
            samples=0 if samples is None else samples.data_ptr(), features=features.data_ptr(), pulls=0, count=count,
            levels=levels,
        )  # fmt: skip
        ctx.save_for_backward(positions, samples, *planes)
        ctx.threads = threads
        return features

    @staticmethod
    @once_differentiable
    def backward(ctx: _Sampling, *grads_in: Tensor) -> tuple[Tensor | None, ...]:
        saved: tuple[Tensor, ...] = ctx.saved_tensors  # read once: under checkpointing, each access recomputes them
        positions, samples, *planes = saved
        out = [torch.empty_like(p) for p in planes]
        grad = grads_in[0].contiguous()
        pulls = torch.empty_like(positions) if ctx.needs_input_grad[0] else None
        pointers, grads, sizes = _table(planes), _table(out), _sizes(planes)
        for stage in (1,) if pulls is None else (1, 2):
            _sampler(planes[0].shape[1]).run(
                ctx.threads, stage, planes=pointers.data_ptr(), grads=grads.data_ptr(), sizes=sizes.data_ptr(),
                where=positions.data_ptr(), samples=samples.data_ptr(), features=grad.data_ptr(),
                pulls=0 if pulls is None else pulls.data_ptr(), count=len(positions), levels=len(planes) // 6,
            )  # fmt: skip
        return pulls, None, *out


def features(positions: Tensor, planes: Sequence[Tensor], threads: int | None = None) -> Tensor:
    """[M, levels * C] products of bilinear samples of each level's six planes, differentiable in both arguments.

    positions: [M, 4] x, y, z and time in [-1, 1]; values outside are clamped, without gradient.
    planes: [1, C, rows, columns] each, six per level, of axes xy, xz, yz, xt, yt, zt (the first axis along a row).
    ValueError unless `supports` accepts the planes.
    """
    if planes[0].is_cuda:
        return planes_cuda.features(positions, planes)
    if not supports(planes):
        raise ValueError("planes should be float32 on the CPU, channels last, with a multiple of 16 features")
    return applied(_Product, positions.float().contiguous(), threads, *planes)


class _Bend(torch.autograd.Function):
    """Value of the penalty. The forward pass also computes its gradient, which the backward pass only scales."""

    @staticmethod
    def forward(ctx: AutogradContext, weights: Tensor, threads: int | None, *planes: Tensor) -> Tensor:
        grads = [torch.empty_like(p) for p in planes] if any(ctx.needs_input_grad) else []
        units = [(n, row) for n, p in enumerate(planes) for row in range(p.shape[2])]
        rows = torch.tensor(units, dtype=torch.int64, device="cpu")
        partial = torch.empty(len(rows), device="cpu")
        pointers, targets, sizes = _table(planes), _table(grads), _sizes(planes)
        _penalty(planes[0].shape[1]).run(
            threads, planes=pointers.data_ptr(), grads=targets.data_ptr() if grads else 0, sizes=sizes.data_ptr(),
            rows=rows.data_ptr(), weights=weights.data_ptr(), partial=partial.data_ptr(), count=len(rows),
        )  # fmt: skip
        ctx.save_for_backward(*grads)
        return partial.double().sum().float()

    @staticmethod
    @once_differentiable
    def backward(ctx: AutogradContext, *grads: Tensor) -> tuple[Tensor | None, ...]:
        saved: tuple[Tensor, ...] = ctx.saved_tensors
        return None, None, *(gradient * grads[0] for gradient in saved)


def penalty(
    planes: Sequence[Tensor], weights: Sequence[tuple[float, float, float]], threads: int | None = None
) -> Tensor:
    """Sum over planes [1, C, H, W] of weighted means: squared second differences along H and W, and |1 - plane|."""
    if planes[0].is_cuda:
        return planes_cuda.penalty(planes, weights)
    if not supports(planes):
        raise ValueError("planes should be float32 on the CPU, channels last, with a multiple of 16 features")
    scaled = planes_cuda.over_counts(planes, weights)
    return applied(_Bend, torch.tensor(scaled, device="cpu"), threads, *planes)
