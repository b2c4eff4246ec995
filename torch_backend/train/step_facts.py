"""What one training step is told: which work it is, and the numbers and pictures that are other in each.

Everything that changes from step to step comes in as a tensor. So a step's work can be recorded once and carried out
again on other numbers (`recorder`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ..supervision import Draws


@dataclass(frozen=True)
class StepKind:
    """Which work a step is. Between two events of a run, steps of one kind are the same work on tensors of the same
    sizes."""

    sh_degree: int
    """Harmonics in use."""
    moves: bool
    """Is there a field, and something that it moves?"""
    detached: bool
    """Do the images leave the field alone?"""
    hidden: bool
    """Does the step mark Gaussians that are hidden in the frame?"""
    anchored: bool
    """Are pairs anchored?"""
    penalised: bool
    """Does the field pay for not being smooth?"""
    soft: bool
    """Is what moves learnt from a softened picture?"""
    ignored: bool
    """Are there pixels that teach nothing?"""
    depth: bool
    """Is what moves pulled to a depth map?"""
    recordable: bool
    """Does it ask a GPU nothing, and do its frame's own numbers all come in as `StepFacts`?"""


@dataclass
class StepFacts:
    """What is other in each step. Anywhere, until `on` or `into` brings it to the device."""

    numbers: Tensor
    """[7] float32: normalised time at which the field is evaluated; the shares of the exposure's two bins; what motion
    is priced at; the background's colour."""
    places: Tensor
    """[3] int64: the frame's time bin; the exposure's two bins."""
    viewmat: Tensor
    """[4, 4] the solve's camera."""
    K: Tensor
    """[3, 3] px."""
    image: Tensor
    """[H, W, 3] display-referred, float32 on the device."""
    ignored: Tensor | None
    """bool [H, W] pixels that teach nothing."""
    movers: Tensor | None
    """bool [H, W] what moves in the frame, where that is softened."""
    draws: Draws | None
    """What pairs to anchor are drawn by."""
    depth: Tensor | None = None
    """[2, H, W] inverse depth that pixels should have, 0 where nothing is asked, and its standard deviation."""

    @property
    def asked(self) -> Tensor:
        """[1] float32 normalised time at which the field is evaluated."""
        return self.numbers[:1]

    @property
    def exposure_shares(self) -> Tensor:
        """[2] float32 shares of the exposure's two bins."""
        return self.numbers[1:3]

    @property
    def motion_price(self) -> Tensor:
        """0-dim float32, what motion is priced at."""
        return self.numbers[3]

    @property
    def background(self) -> Tensor:
        """[3] float32 colour."""
        return self.numbers[4:]

    @property
    def time_bin(self) -> Tensor:
        """[1] int64, the frame's."""
        return self.places[:1]

    @property
    def exposure_bins(self) -> Tensor:
        """[2] int64."""
        return self.places[1:]

    def on(self, device: torch.device) -> StepFacts:
        """The same on a device."""
        return self._made(lambda t: t.to(device, non_blocking=True))

    def room(self, device: torch.device) -> StepFacts:
        """Tensors of these shapes, on a device, for `into`."""
        return self._made(lambda t: torch.empty(t.shape, dtype=t.dtype, device=device))

    def into(self, room: StepFacts) -> None:
        """Writes it into the `room` of one of the same kind."""
        for target, value in zip(room._tensors(), self._tensors(), strict=True):
            target.copy_(value, non_blocking=True)

    def _tensors(self) -> list[Tensor]:
        """All that there are, in one order."""
        found = [self.numbers, self.places, self.viewmat, self.K, self.image]
        found += [t for t in (self.ignored, self.movers, self.depth) if t is not None]
        return [*found, *(() if self.draws is None else self.draws.tensors())]

    def _made(self, make: Callable[[Tensor], Tensor]) -> StepFacts:
        def of(value: Tensor | None) -> Tensor | None:
            return None if value is None else make(value)

        draws = None if self.draws is None else Draws(*map(make, self.draws.tensors()))
        parts = make(self.numbers), make(self.places), make(self.viewmat), make(self.K), make(self.image).float()
        return StepFacts(*parts, of(self.ignored), of(self.movers), draws, of(self.depth))
