"""Mean SSIM of float32 images on a GPU, alone or in the photometric loss, with its gradient.

A Warp kernel computes it in four passes without synchronising with the host. Mathematics and notation are those of
`ssim`: separable blurs of x - 0.5, y - 0.5, x^2 + y^2 and x y, cut at the border and renormalised per axis. Pass 0
blurs along the columns. Pass 1 blurs along the rows and computes the score and the gradient's fields. Passes 2 and 3
blur these fields along columns and rows, and pass 3 assembles the gradient. Each thread computes one value of one
pixel. The result is base + share * SSIM + plain * |x - y|, so that the loss of `train.losses` is one call without
further torch operators. The same kernel runs on Warp's CPU device, where tests compare it with float64.
"""

import functools
from pathlib import Path
from typing import Any

import torch
import warp as wp
from torch import Tensor

from ..kernel_text import kernel_text
from ..native import func_native, initialised_warp, launch_on
from ..torch_types import AutogradContext, applied, once_differentiable
from .ssim import WINDOW, window_taps

_SOURCE = Path(__file__).with_name("kernels") / "ssim.cu"


@functools.lru_cache(maxsize=1)
def kernel() -> Any:
    """The Warp kernel of all passes. Warp compiles it at the first launch on a device."""
    initialised_warp()
    taps = ", ".join(f"{tap:.9g}f" for tap in window_taps())
    source = kernel_text(_SOURCE).replace("@HALF@", str(WINDOW // 2)).replace("@TAPS@", taps)

    def ssim_pass(
        images: wp.uint64, targets: wp.uint64, ignoreds: wp.uint64, blurreds: wp.uint64, backs: wp.uint64,
        scores: wp.uint64, base: wp.float32, share: wp.float32, plain: wp.float32,
        height: wp.int32, width: wp.int32, channels: wp.int32, stage: wp.int32, tid: wp.int32,
    ): ...  # fmt: skip

    native = func_native(source)(ssim_pass)

    def entry(
        images: wp.uint64, targets: wp.uint64, ignoreds: wp.uint64, blurreds: wp.uint64, backs: wp.uint64,
        scores: wp.uint64, base: wp.float32, share: wp.float32, plain: wp.float32,
        height: wp.int32, width: wp.int32, channels: wp.int32, stage: wp.int32,
    ):  # fmt: skip
        native(
            images, targets, ignoreds, blurreds, backs, scores, base, share, plain, height, width, channels, stage,
            wp.tid(),
        )  # fmt: skip

    return wp.Kernel(entry, key="ssim_pass", module=wp.get_module(__name__), options={"enable_backward": False})


class _Ssim(torch.autograd.Function):
    """Autograd function. The gradient is linear in the incoming gradient, so it is computed with the value."""

    @staticmethod
    def forward(
        ctx: AutogradContext, image: Tensor, target: Tensor, ignored: Tensor | None, mix: tuple[float, float, float]
    ) -> Tensor:
        """Mean of base + share * SSIM + plain * |x - y|; `mix` is (base, share, plain)."""
        image, target = image.contiguous(), target.contiguous()
        ignored = None if ignored is None else ignored.contiguous().view(torch.uint8)
        height, width, channels = image.shape
        differentiable = ctx.needs_input_grad[0]
        blurred, score = image.new_empty(4, *image.shape), torch.empty_like(image)
        back = image.new_empty(3, *image.shape) if differentiable else None
        for stage in range(4 if differentiable else 2):
            inputs = [
                image.data_ptr(), target.data_ptr(), 0 if ignored is None else ignored.data_ptr(), blurred.data_ptr(),
                0 if back is None else back.data_ptr(), score.data_ptr(), *mix, height, width, channels, stage,
            ]  # fmt: skip
            launch_on(kernel(), image.numel(), inputs, image.device)
        ctx.save_for_backward(None if back is None else back[0])
        return score.mean(dtype=torch.float64).float()

    @staticmethod
    @once_differentiable
    def backward(ctx: AutogradContext, *grads: Tensor) -> tuple[Tensor, None, None, None]:
        gradient: Tensor = ctx.saved_tensors[0]
        return grads[0] * gradient, None, None, None


def supports(image: Tensor, target: Tensor) -> bool:
    """True if `ssim` supports these tensors: float32, dense, on one CPU or CUDA device, no gradient for the target."""
    return not target.requires_grad and image.device == target.device and all(
        t.dtype == torch.float32 and t.device.type in ("cpu", "cuda") and t.layout == torch.strided
        for t in (image, target)
    )  # fmt: skip


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Mean structural similarity (0-dim) of two float32 images [H, W, C] on one device; differentiable in the first.

    Raises ValueError if the shapes differ, a side is smaller than the window, or `supports` returns False.
    """
    _check(image, target)
    return applied(_Ssim, image, target, None, (0.0, 1.0, 0.0))


def photometric(image: Tensor, target: Tensor, dssim: float, ignored: Tensor | None = None) -> Tensor:
    """`train.losses.photometric` of two float32 images [H, W, C] on one device; ignored: bool [H, W] on that device.

    Raises ValueError if the shapes differ, a side is smaller than the window, or `supports` returns False.
    """
    _check(image, target)
    if ignored is not None and (ignored.shape != image.shape[:2] or ignored.dtype != torch.bool):
        raise ValueError(f"ignored should be bool {[*image.shape[:2]]}, got {ignored.dtype} {[*ignored.shape]}")
    return applied(_Ssim, image, target, ignored, (dssim, -dssim, 1.0 - dssim))


def _check(image: Tensor, target: Tensor) -> None:
    if image.ndim != 3 or image.shape != target.shape or min(image.shape[:2]) < WINDOW or image.shape[2] < 1:
        raise ValueError(
            f"SSIM needs two [H, W, C] images of one shape and at least {WINDOW} px, "
            f"got {tuple(image.shape)} and {tuple(target.shape)}"
        )
    if not supports(image, target):
        raise ValueError(
            f"SSIM here takes float32 images of one device and a target without gradient, got "
            f"{image.dtype} on {image.device} and {target.dtype} on {target.device}"
        )
