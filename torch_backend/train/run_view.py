"""Interface of a run in training, as its measurements see it."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from ..contract import Reporter
from .config import TrainConfig
from .model import DynamicModel


class RunView(Protocol):
    """A run in training; `Trainer` implements it. Only the model's Gaussians may be changed through this interface."""

    config: TrainConfig
    """Configuration of the run."""
    model: DynamicModel
    """Model in training."""
    report: Reporter
    """Receives progress and signals cancellation."""
    device: torch.device
    """Device of the training."""
    images: Tensor
    """[I, H, W, 3] float16 display-referred training frames, on the device or in host memory."""
    movers: Tensor | None
    """bool [I, H, W], pixels that the motion mattes mark as moving; None without mattes."""
    train_ids: list[int]
    """[I] indices of the training frames in the scene's frames."""
    times: list[float]
    """[I] normalised times of the training frames."""
    viewmats: Tensor
    """[F, 4, 4] world-to-camera of the scene's frames."""
    Ks: Tensor
    """[F, 3, 3] intrinsics in pixels of the images."""
    width: int
    """Width of the images in pixels."""
    height: int
    """Height of the images in pixels."""

    @property
    def progress(self) -> float:
        """Share of the run that is done."""
        ...

    @property
    def excluded_frames(self) -> set[int]:
        """Positions among the training frames that are currently excluded: probe frames and unusable frames."""
        ...

    @property
    def background(self) -> Tensor:
        """[3] background colour for measurements and previews."""
        ...

    def ignored_at(self, index: int) -> Tensor | None:
        """bool [H, W] ignored pixels of the scene's frame `index`, on the device; None: no pixel is ignored."""
        ...

    def bin_of_frame(self, frame: int) -> int:
        """Time bin of the support bitmap for the training frame at position `frame`."""
        ...
