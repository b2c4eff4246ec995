"""Pose refinement: a small rigid correction per trained frame, found while everything is still static, then frozen.

A corrected camera is viewmat @ exp(correction): the correction moves the world as that frame's camera sees it, so a
part that all frames share would move the world itself. It is taken out after every step (the gauge): the Gaussians
stay where the solve put the world, and corrections say only how frames disagree. Frames that are not trained on get
what lies between their neighbours in time.

Corrections serve training alone: they are not part of a run's cameras. Takes are rendered from the solve's cameras,
or an artist's own, which Blender has too; refined ones would part from everything that stands in the scene there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..torch_types import from_numpy, matrix_exp, unflatten


@dataclass
class PosesConfig:
    """Whether and how far cameras are corrected. Shares are of the run's length."""

    on: bool = False
    """Are they? Off: see docs/architecture.md for what it did to the clips it was tried on."""
    start: float = 0.1
    """Share of the run at which it begins: before, geometry is too coarse to hold a camera to."""
    until: float = 1.0 / 3.0
    """Share at which corrections are frozen: a camera must not follow what moves."""
    lr: float = 2e-4
    """Learning rate, in radians and in scene units alike."""
    small: float = 1.0
    """Weight of the mean squared correction: what the images do not ask for goes back to the solve."""


class Poses:
    """Corrections of I trained frames; `times` [I] normalised, ascending. Both ends may move."""

    def __init__(self, times: list[float], config: PosesConfig, device: torch.device) -> None:
        self.config, self._times = config, np.asarray(times)
        self.values = torch.nn.Parameter(torch.zeros(len(times), 6, device=device))
        """[I, 6]: turn in radians about the scene's axes through its origin, and shift in scene units."""
        self._gauge = _Gauge(self._times, set(), device)

    def at(self, times: np.ndarray, held: set[int] | None = None) -> Tensor:
        """Corrections [T, 6] at normalised times [T], linear between the trained frames that are not in `held`."""
        keep = [n for n in range(len(self._times)) if n not in (held or ())]
        known = self.values.detach().cpu().numpy()[keep]
        columns = [np.interp(times, self._times[keep], known[:, n]) for n in range(6)]
        return from_numpy(np.stack(columns, axis=1)).to(self.values)

    @torch.no_grad()
    def fix_gauge(self, held: set[int]) -> None:
        """After a step: takes the mean correction out, and puts frames in `held` between their neighbours."""
        if self._gauge.held != held:
            self._gauge = _Gauge(self._times, set(held), self.values.device)
        gauge = self._gauge
        self.values -= self.values[gauge.keep].mean(0)
        if not held:
            return
        if self.values.device.type == "cpu":
            self.values[gauge.rows] = self.at(self._times[gauge.rows.numpy()], held)
        else:
            self.values[gauge.rows] = torch.lerp(self.values[gauge.left], self.values[gauge.right], gauge.share)

    def regularisation(self) -> Tensor:
        """No larger than needed."""
        return self.config.small * self.values.square().mean()


class _Gauge:
    """Indices into the frames, on the device: made where frames are held back anew, so that no step waits for them."""

    def __init__(self, times: np.ndarray, held: set[int], device: torch.device) -> None:
        keep = np.asarray([n for n in range(len(times)) if n not in held])
        rows = np.asarray(sorted(held), dtype=np.int64)
        right = np.searchsorted(times[keep], times[rows]).clip(0, len(keep) - 1)
        left = np.where(times[rows] < times[keep[right]], (right - 1).clip(0), right)
        span = np.maximum(times[keep[right]] - times[keep[left]], 1e-12)
        share = ((times[rows] - times[keep[left]]) / span).clip(0.0, 1.0)
        self.held = held
        self.keep, self.rows, self.left, self.right = (
            from_numpy(index.astype(np.int64)).to(device) for index in (keep, rows, keep[left], keep[right])
        )
        self.share = from_numpy(share.astype(np.float32)[:, None]).to(device)


_HALVED = 4
"""A twist is halved so often before its series: a turn of a radian has 1/16 of one left, and float32 needs 6 terms."""


def _exponential(twist: Tensor) -> Tensor:
    """exp of twists [..., 4, 4]. On a GPU by its series: torch's own has the host wait for one."""
    return matrix_exp(twist) if twist.device.type == "cpu" else _series(twist)


def _series(twist: Tensor) -> Tensor:
    """exp of twists [..., 4, 4] of at most a radian or a unit."""
    small, one = twist / 2.0**_HALVED, torch.eye(4, dtype=twist.dtype, device=twist.device)
    total = one
    for n in range(6, 0, -1):
        total = one + small @ total / n
    for _ in range(_HALVED):
        total = total @ total
    return total


def corrected(viewmats: Tensor, corrections: Tensor) -> Tensor:
    """viewmats [..., 4, 4] world-to-camera after corrections [..., 6] of SE(3), differentiable in both."""
    x, y, z = corrections[..., :3].unbind(-1)
    o = torch.zeros_like(x)
    twist = unflatten(torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1), -1, (3, 3))
    twist = torch.cat([twist, corrections[..., 3:, None]], dim=-1)
    twist = torch.cat([twist, torch.zeros_like(twist[..., :1, :])], dim=-2)
    return viewmats @ _exponential(twist)
