"""The sRGB transfer of `footage.color` on tensors: there on the host for files, here where the pictures are."""

from __future__ import annotations

import torch
from torch import Tensor

from ..footage.color import LINEAR_KNEE, SRGB_KNEE


def to_linear(encoded: Tensor) -> Tensor:
    """Extended display-referred sRGB to scene-linear, any shape: `footage.color.srgb_to_linear`."""
    size = encoded.abs()
    curve = ((size.clamp_min(float(SRGB_KNEE)) + 0.055) / 1.055).pow(2.4)
    return torch.where(size <= float(SRGB_KNEE), encoded / 12.92, torch.copysign(curve, encoded))


def to_display(linear: Tensor) -> Tensor:
    """Scene-linear to extended display-referred sRGB, any shape: `footage.color.linear_to_srgb`."""
    size = linear.abs()
    curve = size.clamp_min(float(LINEAR_KNEE)).pow(1.0 / 2.4) * 1.055 - 0.055
    return torch.where(size <= float(LINEAR_KNEE), linear * 12.92, torch.copysign(curve, linear))
