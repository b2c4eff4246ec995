"""Inputs of one training step: the kind of step, and the tensors that change from step to step.

Everything that changes from step to step is a tensor. A step can therefore be recorded once as a CUDA graph and
replayed on other inputs (`recorder`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ..supervision import Draws


@dataclass(frozen=True)
class StepKind:
    """Kind of a step. Between two events of a run, steps of one kind run the same operations on tensors of the same
    sizes."""

    sh_degree: int
    """SH degree in use."""
    moves: bool
    """True if there is a field that moves at least one Gaussian."""
    detached: bool
    """True if the photometric loss does not train the field."""
    hidden: bool
    """True if the step marks Gaussians that are hidden in the frame."""
    anchored: bool
    """True if the step anchors pairs of Gaussian and time."""
    penalised: bool
    """True if the step evaluates the field's regularisers."""
    soft: bool
    """True if moving pixels are compared at low resolution (`softened.py`)."""
    ignored: bool
    """True if some pixels are left out of the loss."""
    depth: bool
    """True if moving Gaussians are pulled to a depth map."""
    recordable: bool
    """True if the step reads nothing back from the GPU and takes everything that depends on its frame from
    `StepFacts`."""


@dataclass
class StepFacts:
    """Inputs that change from step to step. They may be on any device until `on` or `into` moves them."""

    numbers: Tensor
    """[7] float32: normalised time at which the field is evaluated; weights of the exposure's two bins; price of
    motion; background colour [3]."""
    places: Tensor
    """[3] int64: time bin of the frame; the exposure's two bins."""
    viewmat: Tensor
    """[4, 4] world-to-camera matrix of the solve."""
    K: Tensor
    """[3, 3] intrinsics in pixels."""
    image: Tensor
    """[H, W, 3] display-referred training image, float32 on the device."""
    ignored: Tensor | None
    """bool [H, W] pixels that are left out of the loss; None: no pixel."""
    movers: Tensor | None
    """bool [H, W] moving pixels that are compared at low resolution; None: no pixel."""
    draws: Draws | None
    """Random numbers that select the pairs to anchor; None: no pairs."""
    depth: Tensor | None = None
    """[2, H, W] target inverse depth (0: no target) and its standard deviation; None: no targets."""

    @property
    def field_time(self) -> Tensor:
        """[1] float32 normalised time at which the field is evaluated."""
        return self.numbers[:1]

    @property
    def exposure_shares(self) -> Tensor:
        """[2] float32 weights of the exposure's two bins."""
        return self.numbers[1:3]

    @property
    def motion_price(self) -> Tensor:
        """Price of motion, 0-dim float32."""
        return self.numbers[3]

    @property
    def background(self) -> Tensor:
        """[3] float32 background colour."""
        return self.numbers[4:]

    @property
    def time_bin(self) -> Tensor:
        """[1] int64 time bin of the frame."""
        return self.places[:1]

    @property
    def exposure_bins(self) -> Tensor:
        """[2] int64 the exposure's two bins."""
        return self.places[1:]

    def on(self, device: torch.device) -> StepFacts:
        """Copy of all tensors on `device`."""
        return self._mapped(lambda t: t.to(device, non_blocking=True))

    def room(self, device: torch.device) -> StepFacts:
        """Uninitialised tensors of the same shapes on `device`, to be filled by `into`."""
        return self._mapped(lambda t: torch.empty(t.shape, dtype=t.dtype, device=device))

    def into(self, room: StepFacts) -> None:
        """Copies all tensors into `room`, which was allocated for a step of the same kind."""
        for target, value in zip(room._tensors(), self._tensors(), strict=True):
            target.copy_(value, non_blocking=True)

    def _tensors(self) -> list[Tensor]:
        """All tensors that are not None, in a fixed order."""
        found = [self.numbers, self.places, self.viewmat, self.K, self.image]
        found += [t for t in (self.ignored, self.movers, self.depth) if t is not None]
        return [*found, *(() if self.draws is None else self.draws.tensors())]

    def _mapped(self, make: Callable[[Tensor], Tensor]) -> StepFacts:
        def of(value: Tensor | None) -> Tensor | None:
            return None if value is None else make(value)

        draws = None if self.draws is None else Draws(*map(make, self.draws.tensors()))
        parts = make(self.numbers), make(self.places), make(self.viewmat), make(self.K), make(self.image).float()
        return StepFacts(*parts, of(self.ignored), of(self.movers), draws, of(self.depth))
