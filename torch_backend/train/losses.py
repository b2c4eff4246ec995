"""Photometric losses on display-referred images in [0, 1]. Renders are not clamped before."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from ..raster import ssim as compiled_ssim
from ..raster import ssim_cuda
from ..torch_types import AutogradContext, applied

_C1, _C2 = 0.01**2, 0.03**2
"""Constants of SSIM for data_range = 1."""
_WINDOW, _SIGMA = compiled_ssim.WINDOW, compiled_ssim.SIGMA


def photometric(image: Tensor, target: Tensor, dssim: float, ignored: Tensor | None = None) -> Tensor:
    """(1 - dssim) * L1 + dssim * (1 - SSIM) of [H, W, 3] images (3DGS: dssim 0.2).

    At pixels `ignored`, bool [H, W], the detached image replaces image and target, so they have no loss or gradient.
    """
    structured = dssim > 0 and min(image.shape[:2]) >= _WINDOW
    if structured and compiled_ssim.supports(image, target):
        return compiled_ssim.photometric(image, target, dssim, ignored)
    if structured and image.is_cuda and ssim_cuda.supports(image, target):
        return ssim_cuda.photometric(image, target, dssim, ignored)
    if ignored is not None:
        detached = image.detach()
        image, target = (torch.where(ignored[..., None], detached, values) for values in (image, target))
    loss = (image - target).abs().mean()
    if structured:
        loss = (1.0 - dssim) * loss + dssim * (1.0 - ssim(image, target))
    return loss


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Mean structural similarity of [H, W, C] images, data_range 1, Gaussian window 11 x 11 with sigma 1.5.

    ValueError if a side is smaller than the window. At borders, the window is normalised over pixels inside the image.
    Differentiable in `image`. float32 uses compiled code on the CPU (`raster.ssim`) and on an NVIDIA GPU
    (`raster.ssim_cuda`). Other types, for instance float64, use torch operators.
    """
    if image.shape != target.shape or min(image.shape[:2]) < _WINDOW:
        raise ValueError(f"SSIM needs two images of one shape and at least {_WINDOW} px, got {tuple(image.shape)}")
    if compiled_ssim.supports(image, target):
        return compiled_ssim.ssim(image, target)
    if image.is_cuda and ssim_cuda.supports(image, target):
        return ssim_cuda.ssim(image, target)
    return applied(_TorchSsim, image, target)


def psnr(image: Tensor, target: Tensor, ignored: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB of images in [0, 1] without pixels `ignored`; `image` is clamped first.

    NaN if all pixels are ignored.
    """
    squares = (image.clamp(0.0, 1.0).double() - target.double()).square()
    error = squares.mean() if ignored is None else squares[~ignored].mean()
    return float(-10.0 * torch.log10(error.clamp_min(1e-12)))  # identical images: 120 dB, not infinity


@functools.lru_cache(maxsize=8)
def _band(size: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """[size, size] matrix that blurs along an axis; rows sum to 1."""
    offset = torch.arange(size, dtype=torch.float64, device="cpu")
    distance = offset[:, None] - offset[None, :]
    weights = torch.exp(-0.5 * (distance / _SIGMA).square()) * (distance.abs() <= _WINDOW // 2)
    return (weights / weights.sum(1, keepdim=True)).to(device, dtype)


def _blur(x: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """rows @ x @ columns^T for x [C, H, W]."""
    # At these sizes, two dense products on the CPU are faster than torch's depthwise 11-tap convolution.
    return torch.matmul(torch.matmul(rows, x), columns.T)


class _TorchSsim(torch.autograd.Function):
    """Mean SSIM with a hand-written gradient for the first image: 5 blurs forward, 3 backward."""

    @staticmethod
    def forward(ctx: AutogradContext, image: Tensor, target: Tensor) -> Tensor:
        x = image.permute(2, 0, 1).contiguous()
        y = target.permute(2, 0, 1).contiguous()
        rows, columns = (_band(size, x.dtype, x.device) for size in x.shape[1:])
        mx, my, xx, yy, xy = _blur(torch.cat([x, y, x * x, y * y, x * y]), rows, columns).view(5, *x.shape)
        a1, a2 = 2 * mx * my + _C1, 2 * (xy - mx * my) + _C2
        b1, b2 = mx * mx + my * my + _C1, (xx - mx * mx) + (yy - my * my) + _C2
        score = (a1 * a2) / (b1 * b2)
        ctx.save_for_backward(x, y, mx, my, a1, a2, b1, b2, score)
        return score.mean()

    @staticmethod
    def backward(ctx: AutogradContext, *grads: Tensor) -> tuple[Tensor, None]:
        saved: tuple[Tensor, ...] = ctx.saved_tensors
        x, y, mx, my, a1, a2, b1, b2, score = saved
        rows, columns = (_band(size, x.dtype, x.device) for size in x.shape[1:])
        inverse = 1.0 / (b1 * b2)
        d_xy = 2 * a1 * inverse
        d_xx = -score / b2
        # The mean of x enters the score directly, through the variance of x and through the covariance.
        d_mx = 2 * my * (a2 - a1) * inverse - 2 * mx * score * (1.0 / b1 - 1.0 / b2)
        back = _blur(torch.cat([d_mx, d_xx, d_xy]), rows.T, columns.T).view(3, *x.shape)
        pull = back[0] + 2 * x * back[1] + y * back[2]
        return (grads[0] / score.numel()) * pull.permute(1, 2, 0), None
