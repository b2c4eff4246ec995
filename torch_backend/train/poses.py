"""Pose refinement: a small rigid correction per training frame, optimised while the model is static, then frozen.

A corrected camera is viewmat @ exp(correction). The mean correction is subtracted after every step (the gauge).
Frames that are not trained on get corrections interpolated in time.

Corrections are used in training only. Takes are rendered from the solve's cameras or from the user's, which are the
cameras in Blender; renders from refined cameras would not align with other objects of the Blender scene.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..torch_types import from_numpy, matrix_exp, unflatten


@dataclass
class PosesConfig:
    """Settings of pose refinement. Shares are of the run's length."""

    on: bool = False
    """Whether cameras are refined. Off by default; docs/decisions.md has its effect on test clips."""
    start: float = 0.1
    """Share of the run at which refinement begins. Before, the geometry is too coarse to align a camera to."""
    until: float = 1.0 / 3.0
    """Share at which corrections are frozen, so that cameras do not follow moving objects."""
    lr: float = 2e-4
    """Learning rate, in radians for rotations and in scene units for translations."""
    small: float = 1.0
    """Weight of the mean squared correction. It keeps cameras that the images do not constrain close to the solve."""


class Poses:
    """Corrections of I training frames; `times` [I] normalised, ascending. The first and last may be corrected too."""

    def __init__(self, times: list[float], config: PosesConfig, device: torch.device) -> None:
        self.config, self._times = config, np.asarray(times)
        self.values = torch.nn.Parameter(torch.zeros(len(times), 6, device=device))
        """[I, 6]: rotation vector in radians about the scene's origin, and translation in scene units."""
        self._gauge = _Gauge(self._times, set(), device)

    def at(self, times: np.ndarray, excluded: set[int] | None = None) -> Tensor:
        """Corrections [T, 6] at normalised times [T], interpolated between training frames not in `excluded`."""
        keep = [n for n in range(len(self._times)) if n not in (excluded or ())]
        known = self.values.detach().cpu().numpy()[keep]
        columns = [np.interp(times, self._times[keep], known[:, n]) for n in range(6)]
        return from_numpy(np.stack(columns, axis=1)).to(self.values)

    @torch.no_grad()
    def fix_gauge(self, excluded: set[int]) -> None:
        """Subtracts the mean correction after a step, and interpolates the corrections of frames in `excluded`."""
        if self._gauge.excluded != excluded:
            self._gauge = _Gauge(self._times, set(excluded), self.values.device)
        gauge = self._gauge
        # A correction moves the world as one camera sees it, so the mean of all would move the world itself. Without
        # the mean, Gaussians stay in the solve's frame.
        self.values -= self.values[gauge.keep].mean(0)
        if not excluded:
            return
        if self.values.device.type == "cpu":
            self.values[gauge.rows] = self.at(self._times[gauge.rows.numpy()], excluded)
        else:
            self.values[gauge.rows] = torch.lerp(self.values[gauge.left], self.values[gauge.right], gauge.share)

    def regularisation(self) -> Tensor:
        """Weighted mean squared correction, 0-dim."""
        return self.config.small * self.values.square().mean()


class _Gauge:
    """Indices and interpolation weights on the device. They are rebuilt only when the held-back frames change, so that
    no step waits for a transfer."""

    def __init__(self, times: np.ndarray, excluded: set[int], device: torch.device) -> None:
        keep = np.asarray([n for n in range(len(times)) if n not in excluded])
        rows = np.asarray(sorted(excluded), dtype=np.int64)
        right = np.searchsorted(times[keep], times[rows]).clip(0, len(keep) - 1)
        left = np.where(times[rows] < times[keep[right]], (right - 1).clip(0), right)
        span = np.maximum(times[keep[right]] - times[keep[left]], 1e-12)
        share = ((times[rows] - times[keep[left]]) / span).clip(0.0, 1.0)
        self.excluded = excluded
        self.keep, self.rows, self.left, self.right = (
            from_numpy(index.astype(np.int64)).to(device) for index in (keep, rows, keep[left], keep[right])
        )
        self.share = from_numpy(share.astype(np.float32)[:, None]).to(device)


# Number of halvings of a twist before the series (scaling and squaring): 1 radian becomes 1/16, for which 6 terms reach
# float32 accuracy.
_HALVED = 4


def _exponential(twist: Tensor) -> Tensor:
    """Matrix exponential of twists [..., 4, 4]. On a GPU by its series, since `torch.matrix_exp` synchronises."""
    return matrix_exp(twist) if twist.device.type == "cpu" else _series(twist)


def _series(twist: Tensor) -> Tensor:
    """Matrix exponential of twists [..., 4, 4] of at most 1 radian and 1 unit, by a truncated series."""
    small, one = twist / 2.0**_HALVED, torch.eye(4, dtype=twist.dtype, device=twist.device)
    total = one
    for n in range(6, 0, -1):
        total = one + small @ total / n
    for _ in range(_HALVED):
        total = total @ total
    return total


def corrected(viewmats: Tensor, corrections: Tensor) -> Tensor:
    """World-to-camera matrices [..., 4, 4] after SE(3) corrections [..., 6]; differentiable in both arguments."""
    x, y, z = corrections[..., :3].unbind(-1)
    o = torch.zeros_like(x)
    twist = unflatten(torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1), -1, (3, 3))
    twist = torch.cat([twist, corrections[..., 3:, None]], dim=-1)
    twist = torch.cat([twist, torch.zeros_like(twist[..., :1, :])], dim=-2)
    return viewmats @ _exponential(twist)
