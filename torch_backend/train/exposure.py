"""Exposure that drifts along the clip: a gain and an offset per channel and time bin, smooth in time.

A bin is a trained frame; of a clip that has more than 256 of them, some share one (`supervision.bin_times`).

A camera on automatic changes by several percent within a second: what runs of three clips fitted goes up or down by 8
to 9 % within one at most. Left alone, the gate would open for it and the field would learn it as motion; so it
is fitted from the first step on, long before the gate opens.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..torch_types import AutogradContext, applied, once_differentiable


@dataclass
class ExposureConfig:
    """How freely the exposure may follow the clip."""

    on: bool = True
    """Fit it at all."""
    lr: float = 2e-3
    """Learning rate of log-gains and offsets."""
    smooth: float = 0.05
    """Weight of the squared difference between neighbouring frames."""
    small: float = 0.01
    """Weight of the squared values: without need, no correction."""


class _Between(torch.autograd.Function):
    """`torch.lerp` of two rows of values [B, 2, 3]; its own gradient takes 1 less the second share, rounded."""

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
    # Along an axis of three torch goes number by number, which takes a processor several times as long.
    height, width, channels = color.shape
    rows = color.reshape(height, width * channels)
    return torch.addcmul(offset.repeat(width), rows, gain.repeat(width)).view(height, width, channels)


class Exposure:
    """image -> exp(log_gain) * image + offset, per channel, interpolated between the trained frames' times.

    times: [B] ascending normalised times; values: [B, 2, 3] log-gains and offsets of display-referred colour.
    """

    def __init__(self, times: Tensor, config: ExposureConfig) -> None:
        self.times, self.config = times, config
        self.values = torch.nn.Parameter(torch.zeros(len(times), 2, 3, device=times.device))
        self._at = times.cpu().numpy()  # times are looked up on the host: a GPU need not be asked where a frame lies

    def place(self, time: float) -> tuple[int, int, float]:
        """The bins at or before and at or after a normalised time, and the share of the second; held constant beyond
        the ends."""
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
        """Exposes display-referred colour [H, W, 3] as the camera did at `time`; with alpha [H, W], premultiplied."""
        if not self.config.on:
            return color
        gain, offset = self.at(time)
        return _exposed(color, gain, offset) if alpha is None else color * gain + offset * alpha[..., None]

    def apply_at(self, color: Tensor, bins: Tensor, shares: Tensor) -> Tensor:
        """`apply` at a place, to the bit: bins [2] int64, shares [2] float32 of the first and of the second, on the
        device (a recorded step is told other ones each time)."""
        if not self.config.on:
            return color
        log_gain, offset = applied(_Between, self.values, bins, shares)
        return _exposed(color, log_gain.exp(), offset)

    def regularisation(self) -> Tensor:
        """Smooth in time, and no larger than needed."""
        steps = self.values[1:] - self.values[:-1]
        return (
            self.config.smooth * steps.square().sum() / len(self.times)
            + self.config.small * self.values.square().mean()
        )
