"""Exposure correction: a gain and an offset per channel and time bin, smooth in time.

A bin is a training frame; in clips with more than 256 training frames, several share a bin (`supervision.bin_times`).

The exposure of a camera on automatic changes by several percent within a second: by at most 8 to 9 % in the fits of
three clips. Without a correction, the gate would open for the change and the field would model it as motion. The
correction is therefore fitted from the first step on, long before the gate opens.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..torch_types import AutogradContext, applied, once_differentiable


@dataclass
class ExposureConfig:
    """Settings of the exposure correction."""

    on: bool = True
    """Whether the exposure correction is used."""
    lr: float = 2e-3
    """Learning rate of log-gains and offsets."""
    smooth: float = 0.05
    """Weight of the squared difference between neighbouring frames."""
    small: float = 0.01
    """Weight of the squared values, which keeps corrections small."""


class _Between(torch.autograd.Function):
    """`torch.lerp` of two rows of values [B, 2, 3]. The gradient uses both given weights. `torch.lerp` would compute
    1 - weight in float32, and its gradient would differ from that of `Exposure.apply` by rounding."""

    @staticmethod
    def forward(ctx: AutogradContext, values: Tensor, bins: Tensor, shares: Tensor) -> Tensor:
        left, right = values.index_select(0, bins)
        ctx.save_for_backward(values, bins, shares)
        return torch.lerp(left, right, shares[1])

    @staticmethod
    @once_differentiable
    def backward(ctx: AutogradContext, *grads: Tensor) -> tuple[Tensor, None, None]:
        saved: tuple[Tensor, ...] = ctx.saved_tensors
        values, bins, shares = saved
        return torch.zeros_like(values).index_add_(0, bins, shares[:, None, None] * grads[0]), None, None


def _exposed(color: Tensor, gain: Tensor, offset: Tensor) -> Tensor:
    """color [H, W, 3] * gain [3] + offset [3]."""
    if color.is_cuda:
        return color * gain + offset
    # On the CPU, torch does not vectorise broadcasts over an axis of 3; rows of width * channels are far faster.
    height, width, channels = color.shape
    rows = color.reshape(height, width * channels)
    return torch.addcmul(offset.repeat(width), rows, gain.repeat(width)).view(height, width, channels)


class Exposure:
    """Maps an image to exp(log_gain) * image + offset, per channel, interpolated between the bins' times.

    times: [B] ascending normalised times; values: [B, 2, 3] log-gains and offsets of display-referred colour.
    """

    def __init__(self, times: Tensor, config: ExposureConfig) -> None:
        self.times, self.config = times, config
        self.values = torch.nn.Parameter(torch.zeros(len(times), 2, 3, device=times.device))
        self._at = times.cpu().numpy()  # bins are looked up on the CPU, without synchronising with a GPU

    def place(self, time: float) -> tuple[int, int, float]:
        """(left, right, share): bins around a normalised time, and the weight of `right`. Clamped beyond the ends."""
        right = min(int(np.searchsorted(self._at, np.float32(time))), len(self._at) - 1)
        left = max(right - 1, 0)
        span = float(self._at[right] - self._at[left])
        share = min(max((time - float(self._at[left])) / span, 0.0), 1.0) if span > 0 else 0.0
        return left, right, share

    def at(self, time: float) -> tuple[Tensor, Tensor]:
        """(gain [3], offset [3]) at a normalised time."""
        left, right, share = self.place(time)
        log_gain, offset = torch.lerp(self.values[left], self.values[right], share)
        return log_gain.exp(), offset

    def apply(self, color: Tensor, time: float, alpha: Tensor | None = None) -> Tensor:
        """Applies the exposure at `time` to display-referred colour [H, W, 3]; with alpha [H, W], premultiplied."""
        if not self.config.on:
            return color
        gain, offset = self.at(time)
        # Premultiplied colour: the offset applies only to the covered share of a pixel.
        return _exposed(color, gain, offset) if alpha is None else color * gain + offset * alpha[..., None]

    def apply_at(self, color: Tensor, bins: Tensor, shares: Tensor) -> Tensor:
        """`apply` with bins [2] int64 and their weights [2] float32 as device tensors, so that a recorded step can be
        replayed with other values. The result is bit-identical to that of `apply`."""
        if not self.config.on:
            return color
        log_gain, offset = applied(_Between, self.values, bins, shares)
        return _exposed(color, log_gain.exp(), offset)

    def regularisation(self) -> Tensor:
        """Loss that keeps the corrections smooth in time and small, 0-dim."""
        steps = self.values[1:] - self.values[:-1]
        return (
            self.config.smooth * steps.square().sum() / len(self.times)
            + self.config.small * self.values.square().mean()
        )
