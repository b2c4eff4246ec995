"""GPU implementation of `planes` by Warp kernels, with few launches and without synchronisation.

The torch path in `hexplane` launches six samplers and their products per level, and as many backward kernels. Here, one
launch samples and multiplies all planes of all levels. A second launch computes the gradients of all planes, and a
third those of the points, if needed. One launch computes the penalty of all planes with its gradient.

Plane gradients are summed by atomics, so their last bits depend on the order of execution, as in the rasteriser. All
other results are deterministic. Any number of features is supported. Tests run the same kernels on Warp's CPU device,
and compare them with float64.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from ..kernel_text import kernel_text
from ..native import func_native, initialised_warp, launch_on
from ..small_tables import small_table
from ..torch_types import AutogradContext, applied, once_differentiable, split

_KERNELS = Path(__file__).with_name("kernels")

refused = ""
"""Why the self-test forbids these kernels (set by `train.device`, for the whole process); empty if they are allowed.
If it is set, `supports` returns False and the torch path is used."""


class Kernels(NamedTuple):
    """Warp kernels for one number of channels."""

    samples: Any
    gradients: Any
    points: Any
    penalty: Any


def source(name: str, channels: int) -> str:
    """Source of the kernel in the file <name>.cu."""
    text = kernel_text(_KERNELS / f"{name}.cu").replace("@CHANNELS@", str(channels))
    return text.replace("@WIDTH@", str(4 if channels % 4 == 0 else 1))


def module_name(channels: int) -> str:
    """Name of the Warp module of the kernels."""
    return f"{__name__}.planes{channels}"


@functools.lru_cache(maxsize=8)
def kernels(channels: int) -> Kernels:
    """Warp kernels. The first launch on a device compiles all of them."""
    initialised_warp()
    module, options = wp.get_module(module_name(channels)), {"enable_backward": False}

    def sampling(name: str) -> Any:
        def sample(
            tables: wp.uint64, wheres: wp.uint64, pulls: wp.uint64, results: wp.uint64, levels: wp.int32,
            tid: wp.int32,
        ): ...  # fmt: skip

        sample.__name__ = sample.__qualname__ = f"{name}_native"
        native = func_native(source(name, channels))(sample)

        def entry(tables: wp.uint64, wheres: wp.uint64, pulls: wp.uint64, results: wp.uint64, levels: wp.int32):
            native(tables, wheres, pulls, results, levels, wp.tid())

        return wp.Kernel(entry, key=name, module=module, options=options)

    def bend(
        tables: wp.uint64, weights: wp.uint64, terms: wp.uint64, grads: wp.uint64, planes: wp.int32, tid: wp.int32
    ): ...

    native = func_native(source("plane_penalty", channels))(bend)

    def penalty_entry(tables: wp.uint64, weights: wp.uint64, terms: wp.uint64, grads: wp.uint64, planes: wp.int32):
        native(tables, weights, terms, grads, planes, wp.tid())

    penalising = wp.Kernel(penalty_entry, key="plane_penalty", module=module, options=options)
    return Kernels(sampling("plane_samples"), sampling("plane_gradients"), sampling("plane_points"), penalising)


def supports(planes: Sequence[Tensor]) -> bool:
    """True if this module supports the planes: float32 on one device (CPU for tests), channels last and aligned."""
    device = planes[0].device
    return not refused and device.type in ("cpu", "cuda") and all(
        p.dtype == torch.float32 and p.device == device and p.data_ptr() % 16 == 0
        and p.is_contiguous(memory_format=torch.channels_last) for p in planes
    )  # fmt: skip


def _table(planes: Sequence[Tensor]) -> Tensor:
    """[planes, 4] int64: address of a plane, H, W, and total number of values of the planes before it."""
    rows: list[tuple[int, ...]] = []
    before = 0
    for plane in planes:
        rows.append((plane.data_ptr(), plane.shape[2], plane.shape[3], before))
        before += plane.numel()
    return small_table(tuple(rows), torch.int64, planes[0].device)  # addresses of planes do not change during a run


def _like(flat: Tensor, planes: Sequence[Tensor]) -> list[Tensor]:
    """Consecutive views of a flat tensor, each with the shape and memory layout of its plane."""
    parts = split(flat, [p.numel() for p in planes])
    shapes = [(1, p.shape[2], p.shape[3], p.shape[1]) for p in planes]
    return [part.view(shape).permute(0, 3, 1, 2) for part, shape in zip(parts, shapes, strict=True)]


class _Product(torch.autograd.Function):
    """Features of points, with gradients for the planes and the points."""

    @staticmethod
    def forward(ctx: AutogradContext, positions: Tensor, *planes: Tensor) -> Tensor:
        channels, levels = planes[0].shape[1], len(planes) // 6
        features = positions.new_empty(len(positions), levels * channels)
        width = 4 if channels % 4 == 0 else 1
        inputs = [_table(planes).data_ptr(), positions.data_ptr(), 0, features.data_ptr(), levels]
        launch_on(kernels(channels).samples, features.numel() // width, inputs, positions.device)
        # Samples are computed again in the backward pass. Six per level would take as much memory as a Gaussian's SH
        # coefficients, and the planes fit the GPU's cache.
        ctx.save_for_backward(positions, *planes)
        return features

    @staticmethod
    @once_differentiable
    def backward(ctx: AutogradContext, *grads: Tensor) -> tuple[Tensor | None, ...]:
        saved: tuple[Tensor, ...] = ctx.saved_tensors
        positions, *planes = saved
        channels, levels, pull = planes[0].shape[1], len(planes) // 6, grads[0].contiguous()
        compiled, table = kernels(channels), _table(planes)
        flat = positions.new_zeros(sum(p.numel() for p in planes))
        inputs = [table.data_ptr(), positions.data_ptr(), pull.data_ptr(), flat.data_ptr(), levels]
        launch_on(compiled.gradients, pull.numel(), inputs, positions.device)
        points = None
        if ctx.needs_input_grad[0]:
            points = torch.empty_like(positions)
            inputs = [table.data_ptr(), positions.data_ptr(), pull.data_ptr(), points.data_ptr(), levels]
            launch_on(compiled.points, len(positions), inputs, positions.device)
        return points, *_like(flat, planes)


def features(positions: Tensor, planes: Sequence[Tensor]) -> Tensor:
    """See `planes.features`, for planes on a GPU. ValueError unless `supports` accepts the planes."""
    if not supports(planes):
        raise ValueError("planes should be float32 on one device, channels last, and aligned to 16 bytes")
    return applied(_Product, positions.float().contiguous(), *planes)


class _Bend(torch.autograd.Function):
    """Value of the penalty. The forward pass also computes its gradient, which the backward pass only scales."""

    @staticmethod
    def forward(ctx: AutogradContext, weights: tuple[tuple[float, ...], ...], *planes: Tensor) -> Tensor:
        terms = planes[0].new_empty(sum(p.numel() for p in planes))
        grads = torch.empty_like(terms) if any(ctx.needs_input_grad) else None
        scales = small_table(weights, torch.float32, terms.device)
        inputs = [
            _table(planes).data_ptr(), scales.data_ptr(), terms.data_ptr(), 0 if grads is None else grads.data_ptr(),
            len(planes),
        ]  # fmt: skip
        launch_on(kernels(planes[0].shape[1]).penalty, terms.numel(), inputs, terms.device)
        ctx.save_for_backward(grads, *planes)
        return terms.sum(dtype=torch.float64).float()

    @staticmethod
    @once_differentiable
    def backward(ctx: AutogradContext, *grads: Tensor) -> tuple[Tensor | None, ...]:
        saved: tuple[Tensor, ...] = ctx.saved_tensors
        flat, *planes = saved
        return None, *_like(flat * grads[0], planes)


def over_counts(
    planes: Sequence[Tensor], weights: Sequence[tuple[float, float, float]]
) -> tuple[tuple[float, float, float], ...]:
    """Weights of `penalty`, each divided by the number of values in its mean."""
    scaled: list[tuple[float, float, float]] = []
    for plane, (down, along, still) in zip(planes, weights, strict=True):
        _, c, h, w = plane.shape
        scaled.append((down / max(1, c * (h - 2) * w), along / max(1, c * h * (w - 2)), still / (c * h * w)))
    return tuple(scaled)


def penalty(planes: Sequence[Tensor], weights: Sequence[tuple[float, float, float]]) -> Tensor:
    """See `planes.penalty`, for planes on a GPU. ValueError unless `supports` accepts the planes."""
    if not supports(planes):
        raise ValueError("planes should be float32 on one device, channels last, and aligned to 16 bytes")
    return applied(_Bend, over_counts(planes, weights), *planes)
