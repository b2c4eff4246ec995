"""Mean SSIM of float32 images on the CPU, alone or in the photometric loss, with its gradient.

C++ compiled by Warp computes it in two passes over rows, with the mathematics of `train.losses`: Wang et al. 2004,
11 x 11 Gaussian window, sigma 1.5, data_range 1, cut at the border and renormalised per axis. The renormalised blur of
an axis is B = diag(r) S, where S is the symmetric blur of zero-padded rows and r the reciprocal weight sum inside the
image. Hence B^T = S diag(r): the backward blur is the plain blur of values multiplied by r.

The fields are computed from x - 0.5 and y - 0.5, which leaves variances unchanged and reduces float32 cancellation.
"""

import ctypes
import functools
import threading
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..kernel_text import kernel_text
from ..native import Launch, build, default_threads, run_workers
from ..torch_types import AutogradContext, applied, once_differentiable

WINDOW, SIGMA = 11, 1.5
_HALF = WINDOW // 2
_LANES = 16
# Rows per unit of work, so that each loaded row serves several output rows.
_ROWS = 4
# Four, not five: SSIM depends on the variances only through var x + var y.
_FIELDS_FORWARD, _FIELDS_BACKWARD = 4, 3
_FIELDS: list[tuple[str, type, str]] = [
    *[(n, ctypes.c_uint64, "const float*") for n in ("image", "target", "inverse_x", "inverse_y")],
    *[(n, ctypes.c_uint64, "float*") for n in ("gradient", "row_score", "blurred", "scratch")],
    *[
        (n, ctypes.c_int64, "long long")
        for n in (
            "height",
            "length",
            "channels",
            "padded",
            "margin",
            "pitch",
            "scratch_stride",
            "want_gradient",
            "counter",
        )
    ],
    *[(n, ctypes.c_float, "float") for n in ("share", "plain")],
]
"""`length` = width * channels is the number of floats of a row. `padded` is `length` rounded up to full vectors, and
`pitch` is `padded` plus `margin` zeros on either side. `blurred` [3, height, padded] holds the gradient's fields
between the passes, `scratch` a worker's rows. The kernel sums up share * SSIM + plain * |x - y|."""

_SOURCE = Path(__file__).with_name("kernels") / "ssim.cpp"


class _Block(ctypes.Structure):
    """The parameter block of a launch."""

    _fields_ = [(name, kind) for name, kind, _ in _FIELDS]


def window_taps() -> list[float]:
    """[WINDOW] weights of the Gaussian window, normalised to sum 1."""
    weights = torch.exp(-0.5 * (torch.arange(-_HALF, _HALF + 1, dtype=torch.float64) / SIGMA).square())
    return [float(weight) for weight in weights / weights.sum()]


def _source() -> str:
    fields = " ".join(f"{text} {name};" for name, _, text in _FIELDS)
    taps = ", ".join(f"{tap:.9g}f" for tap in window_taps())
    body = kernel_text(_SOURCE).replace("@ROWS@", str(_ROWS)).replace("@HALF@", str(_HALF)).replace("@TAPS@", taps)
    return f"struct Block {{ {fields} }};\nBlock& P = *(Block*)block;\n{body}"


_lock = threading.Lock()


@functools.lru_cache(maxsize=1)
def _build() -> Launch:
    return build("ssim_passes", _source())


def _compile() -> Launch:
    """The kernel, compiled once even if several threads call at the same time."""
    with _lock:
        return _build()


def warm_up() -> None:
    """Compile, or load from the cache. Call it from the main thread before the first `ssim` of a worker thread."""
    _compile()


@functools.lru_cache(maxsize=16)
def _inverse(size: int, repeat: int, total: int) -> Tensor:
    """[total] reciprocal weight sums of `size` positions, each repeated `repeat` times, padded with zeros."""
    inside = torch.nn.functional.conv1d(
        torch.ones(1, 1, size, dtype=torch.float64),
        torch.tensor(window_taps(), dtype=torch.float64)[None, None],
        padding=_HALF,
    )
    out = torch.zeros(total)
    out[: size * repeat] = (1.0 / inside[0, 0]).repeat_interleave(repeat)
    return out


class _Local(threading.local):
    """Buffers of the calling thread, reused for images of the same size. Margins of `scratch` stay zero."""

    key: tuple[int, ...] = ()
    scratch: Tensor
    blurred: Tensor


_local = _Local()


def _run(
    image: Tensor, target: Tensor, mix: tuple[float, float], want_gradient: bool, threads: int
) -> tuple[Tensor, Tensor | None]:
    """Mean of share * SSIM + plain * |x - y| (0-dim) of contiguous float32 [H, W, C], and its gradient for `image`.

    `mix` is (share, plain).
    """
    launch = _compile()
    height, width, channels = image.shape
    length = width * channels
    padded, margin = -(-length // _LANES) * _LANES, -(-_HALF * channels // _LANES) * _LANES
    pitch = padded + 2 * margin
    stride = (_FIELDS_FORWARD * _ROWS + _FIELDS_BACKWARD) * pitch
    key = (height, width, channels, threads)
    if _local.key != key:
        _local.scratch = torch.zeros(threads * stride)
        _local.blurred = torch.empty(_FIELDS_BACKWARD * height * padded)
        _local.key = key
    inverse_x, inverse_y = _inverse(width, channels, padded), _inverse(height, 1, height + _ROWS)
    gradient, scores = torch.empty_like(image) if want_gradient else None, torch.empty(height)
    block: Any = _Block(
        image=image.data_ptr(),
        target=target.data_ptr(),
        inverse_x=inverse_x.data_ptr(),
        inverse_y=inverse_y.data_ptr(),
        gradient=0 if gradient is None else gradient.data_ptr(),
        row_score=scores.data_ptr(),
        blurred=_local.blurred.data_ptr(),
        scratch=_local.scratch.data_ptr(),
        height=height,
        length=length,
        channels=channels,
        padded=padded,
        margin=margin,
        pitch=pitch,
        scratch_stride=stride,
        want_gradient=int(want_gradient),
        share=mix[0],
        plain=mix[1],
    )
    run_workers(launch, block, 0, threads)
    if want_gradient:
        run_workers(launch, block, 1, threads)
    return (scores.double().sum() / (height * length)).float(), gradient


class _Ssim(torch.autograd.Function):
    """Autograd function; only the first image gets a gradient."""

    @staticmethod
    def forward(
        ctx: AutogradContext, image: Tensor, target: Tensor, ignored: Tensor | None, mix: tuple[float, float],
        threads: int,
    ) -> Tensor:  # fmt: skip
        image, target = image.contiguous(), target.contiguous()
        if ignored is not None:
            target = torch.where(ignored[..., None], image, target)
        # The gradient is linear in the incoming one, so it is computed together with the value.
        value, gradient = _run(image, target, mix, ctx.needs_input_grad[0], threads)
        if ignored is not None and gradient is not None:
            gradient.masked_fill_(ignored[..., None], 0.0)  # windows of their neighbours cover ignored pixels
        ctx.save_for_backward(gradient)
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx: AutogradContext, *grads: Tensor) -> tuple[Tensor, None, None, None, None]:
        gradient: Tensor = ctx.saved_tensors[0]
        return grads[0] * gradient, None, None, None, None


def supports(image: Tensor, target: Tensor) -> bool:
    """True if `ssim` supports these tensors: float32, dense, on the CPU, and no gradient for the target."""
    return not target.requires_grad and all(
        t.dtype == torch.float32 and t.device.type == "cpu" and t.layout == torch.strided for t in (image, target)
    )


def ssim(image: Tensor, target: Tensor, threads: int | None = None) -> Tensor:
    """Mean structural similarity (0-dim) of two float32 CPU images [H, W, C]; differentiable in the first.

    `threads` is the number of workers (default: all cores); the result is bitwise the same for any number.

    Raises ValueError if the shapes differ, a side is smaller than the window, or `supports` returns False.

    Source: Wang et al. 2004, "Image quality assessment", with the window and borders described in this module.
    """
    return applied(_Ssim, image, target, None, (1.0, 0.0), _checked(image, target, threads))


def photometric(
    image: Tensor, target: Tensor, dssim: float, ignored: Tensor | None = None, threads: int | None = None
) -> Tensor:
    """`train.losses.photometric` of two float32 CPU images [H, W, C] by the kernel of `ssim`; ignored: bool [H, W].

    Raises ValueError as `ssim`.
    """
    workers = _checked(image, target, threads)
    return dssim + applied(_Ssim, image, target, ignored, (-dssim, 1.0 - dssim), workers)


def _checked(image: Tensor, target: Tensor, threads: int | None) -> int:
    """Number of workers. Raises ValueError for images that cannot be compared."""
    if image.ndim != 3 or image.shape != target.shape or min(image.shape[:2]) < WINDOW or image.shape[2] < 1:
        raise ValueError(
            f"SSIM needs two [H, W, C] images of one shape and at least {WINDOW} px, "
            f"got {tuple(image.shape)} and {tuple(target.shape)}"
        )
    if not supports(image, target):
        raise ValueError(
            f"SSIM here takes float32 CPU images and a target without gradient, got {image.dtype} on "
            f"{image.device} and {target.dtype} on {target.device}"
        )
    workers = default_threads() if threads is None else threads
    if workers < 1:
        raise ValueError(f"threads must be at least 1, got {threads}")
    return workers
