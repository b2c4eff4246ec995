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

    def at(self, times: np.ndarray, held: set[int] | None = None) -> Tensor:
        """Corrections [T, 6] at normalised times [T], linear between the trained frames that are not in `held`."""
        keep = [n for n in range(len(self._times)) if n not in (held or ())]
        known = self.values.detach().cpu().numpy()[keep]
        columns = [np.interp(times, self._times[keep], known[:, n]) for n in range(6)]
        return from_numpy(np.stack(columns, axis=1)).to(self.values)

    @torch.no_grad()
    def fix_gauge(self, held: set[int]) -> None:
        """After a step: takes the mean correction out, and puts frames in `held` between their neighbours."""
        keep = [n for n in range(len(self._times)) if n not in held]
        self.values -= self.values[keep].mean(0)
        if held:
            rows = sorted(held)
            self.values[rows] = self.at(self._times[rows], held)

    def regularisation(self) -> Tensor:
        """No larger than needed."""
        return self.config.small * self.values.square().mean()


def corrected(viewmats: Tensor, corrections: Tensor) -> Tensor:
    """viewmats [..., 4, 4] world-to-camera after corrections [..., 6] of SE(3), differentiable in both."""
    x, y, z = corrections[..., :3].unbind(-1)
    o = torch.zeros_like(x)
    twist = unflatten(torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1), -1, (3, 3))
    twist = torch.cat([twist, corrections[..., 3:, None]], dim=-1)
    twist = torch.cat([twist, torch.zeros_like(twist[..., :1, :])], dim=-2)
    return viewmats @ matrix_exp(twist)
