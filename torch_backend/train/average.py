"""The mean of a run's last steps, which is what the run keeps.

Every step follows one frame, and the rates that a short run needs keep its parameters moving about what all frames
agree on until the very end. Their mean over the last steps is nearer to it than any of them (Polyak and Juditsky,
"Acceleration of stochastic approximation by averaging", 1992), so rates need not fall as far. Figures:
docs/decisions.md, "Rates, Gaussians and the end of a run".
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

_PREFIX = "mean."


class ParameterMean:
    """Running mean of named parameters. It starts over where their shapes change: rows were dropped or split."""

    def __init__(self) -> None:
        self.count = 0
        """Steps that are in it."""
        self._mean: dict[str, Tensor] = {}

    @torch.no_grad()
    def add(self, parameters: Mapping[str, Tensor]) -> None:
        """Takes the parameters after a step in."""
        if {name: value.shape for name, value in parameters.items()} != {n: v.shape for n, v in self._mean.items()}:
            self.count, self._mean = 0, {name: value.detach().clone() for name, value in parameters.items()}
        self.count += 1
        for name, value in parameters.items():
            self._mean[name].lerp_(value.detach(), 1.0 / self.count)

    @torch.no_grad()
    def put_into(self, parameters: Mapping[str, Tensor]) -> None:
        """Sets the parameters to their mean, and forgets it. Without a step in it, or a finite mean, they stay."""
        for name, mean in self._mean.items():
            value = parameters[name].detach()
            value.copy_(torch.where(mean.isfinite(), mean, value))
        self.count, self._mean = 0, {}

    def state(self) -> dict[str, Tensor]:
        """For a checkpoint; empty without a step."""
        if not self.count:
            return {}
        count = torch.tensor(self.count, device="cpu")
        return {f"{_PREFIX}{name}": value for name, value in self._mean.items()} | {f"{_PREFIX}steps": count}

    def restore(self, tensors: Mapping[str, Tensor], device: torch.device) -> None:
        """Inverse of `state`, from a checkpoint's tensors."""
        found = {n.removeprefix(_PREFIX): v for n, v in tensors.items() if n.startswith(_PREFIX)}
        self.count = int(found.pop("steps", 0))
        self._mean = {name: value.to(device, copy=True) for name, value in found.items()}
