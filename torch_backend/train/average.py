"""Parameter averaging over the last steps of a run; the mean is the result of the run.

Each step fits one frame. At the learning rates of a short run, parameters oscillate around the optimum of all frames
until the end. Their mean over the last steps is nearer to that optimum than any single step (Polyak and Juditsky,
"Acceleration of stochastic approximation by averaging", 1992), so learning rates need not fall as far. Figures:
docs/decisions.md, "Rates, Gaussians and the end of a run".
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

_PREFIX = "mean."


class ParameterMean:
    """Running mean of named parameters. It restarts when shapes change because Gaussians were dropped or split."""

    def __init__(self) -> None:
        self.count = 0
        """Number of averaged steps."""
        self._mean: dict[str, Tensor] = {}

    @torch.no_grad()
    def add(self, parameters: Mapping[str, Tensor]) -> None:
        """Adds the parameters after a step to the mean."""
        if {name: value.shape for name, value in parameters.items()} != {n: v.shape for n, v in self._mean.items()}:
            self.count, self._mean = 0, {name: value.detach().clone() for name, value in parameters.items()}
        self.count += 1
        for name, value in parameters.items():
            self._mean[name].lerp_(value.detach(), 1.0 / self.count)

    @torch.no_grad()
    def copy_into(self, parameters: Mapping[str, Tensor]) -> None:
        """Sets the parameters to their mean and resets it. Values without a finite mean stay unchanged."""
        for name, mean in self._mean.items():
            value = parameters[name].detach()
            value.copy_(torch.where(mean.isfinite(), mean, value))
        self.count, self._mean = 0, {}

    def state(self) -> dict[str, Tensor]:
        """Tensors for a checkpoint; empty if no step was averaged."""
        if not self.count:
            return {}
        count = torch.tensor(self.count, device="cpu")
        return {f"{_PREFIX}{name}": value for name, value in self._mean.items()} | {f"{_PREFIX}steps": count}

    def restore(self, tensors: Mapping[str, Tensor], device: torch.device) -> None:
        """Inverse of `state`: restores the mean from a checkpoint's tensors."""
        found = {n.removeprefix(_PREFIX): v for n, v in tensors.items() if n.startswith(_PREFIX)}
        self.count = int(found.pop("steps", 0))
        self._mean = {name: value.to(device, copy=True) for name, value in found.items()}
