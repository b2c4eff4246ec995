"""Transfer functions of a `footage.display` for tensors. `Display` has the same functions for NumPy arrays."""

from __future__ import annotations

import torch
from torch import Tensor

from ...contract import SHOULDER_FROM, SHOULDER_ROLL
from ...footage.color import LINEAR_KNEE, SRGB_KNEE
from ...footage.display import Display


def to_linear(values: Tensor, display: Display) -> Tensor:
    """Scene-linear light from display values of any shape, like `Display.to_light`."""
    encoded = values
    if display.bends:
        above = (values - SHOULDER_FROM).clamp_min(0.0)
        encoded = values.clamp_max(SHOULDER_FROM) + SHOULDER_ROLL * torch.expm1(above / SHOULDER_ROLL)
    size = encoded.abs()
    curve = ((size.clamp_min(float(SRGB_KNEE)) + 0.055) / 1.055).pow(2.4)
    return torch.where(size <= float(SRGB_KNEE), encoded / 12.92, torch.copysign(curve, encoded))


def to_display(linear: Tensor, display: Display) -> Tensor:
    """Display values from scene-linear light of any shape, like `Display.from_light`."""
    size = linear.abs()
    curve = size.clamp_min(float(LINEAR_KNEE)).pow(1.0 / 2.4) * 1.055 - 0.055
    encoded = torch.where(size <= float(LINEAR_KNEE), linear * 12.92, torch.copysign(curve, linear))
    if not display.bends:
        return encoded
    above = (encoded - SHOULDER_FROM).clamp_min(0.0)
    return encoded.clamp_max(SHOULDER_FROM) + SHOULDER_ROLL * torch.log1p(above / SHOULDER_ROLL)
