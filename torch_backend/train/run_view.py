"""Attributes of a run in training that its measurements read."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from ..contract import Reporter
from .config import TrainConfig
from .model import DynamicModel


class RunView(Protocol):
    """A run in training; `Trainer` is one. Nothing of it is changed through this, but for the model's Gaussians."""

    config: TrainConfig
    """Every number of the run."""
    model: DynamicModel
    """What is trained."""
    report: Reporter
    """Receives progress, and says when the run is cancelled."""
    device: torch.device
    """Where it trains."""
    images: Tensor
    """[I, H, W, 3] float16 display-referred, the trained frames; on the device or in host memory."""
    movers: Tensor | None
    """bool [I, H, W], pixels that the motion mattes mark as moving; None without mattes."""
    train_ids: list[int]
    """[I] indices of them into the scene's frames."""
    times: list[float]
    """[I] their normalised times."""
    viewmats: Tensor
    """[F, 4, 4] world-to-camera of the scene's frames."""
    Ks: Tensor
    """[F, 3, 3] intrinsics in pixels of the images."""
    width: int
    """Pixels."""
    height: int
    """Pixels."""

    @property
    def progress(self) -> float:
        """Share of the run that is done."""
        ...

    @property
    def excluded_frames(self) -> set[int]:
        """Positions of the trained frames that are not trained on now: kept back, or unusable."""
        ...

    @property
    def background(self) -> Tensor:
        """[3] what shows where nothing covers when a frame is measured or shown."""
        ...

    def ignored_at(self, index: int) -> Tensor | None:
        """bool [H, W] which pixels of frame `index` of the scene teach nothing, on the device; None: all do."""
        ...

    def bin_of_frame(self, frame: int) -> int:
        """Time bin of the support bitmap for the trained frame at position `frame`."""
        ...
