"""Coarse to fine: a run begins on pictures of half the width.

There a gesture is half as many pixels long and pictures are smoother, so a field finds where a hand went that it would
otherwise leave where it is most of the time; and a step costs a third. Support, size on screen and the gate count in
pixels of the whole pictures all the while.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from ..scene import Scene

_LEAST = 32
"""Pixels that the shorter side of coarse pictures has at least: a window of SSIM is 11 wide."""


@dataclass(frozen=True)
class PictureSize:
    """Pictures that are trained on for a while, and the cameras that see them."""

    width: int
    """Pixels."""
    height: int
    """Pixels."""
    Ks: Tensor
    """[F, 3, 3] intrinsics of the scene's frames, in these pixels."""
    area: float
    """Pixels of the whole picture that a pixel of these is."""

    def of(self, image: Tensor) -> Tensor:
        """A whole image [H, W, 3] at this size: the mean of the pixels that fall on one."""
        if image.shape[:2] == (self.height, self.width):
            return image
        small = F.interpolate(image.permute(2, 0, 1)[None], (self.height, self.width), mode="area")
        return small[0].permute(1, 2, 0).contiguous()

    def any_of(self, mask: Tensor | None) -> Tensor | None:
        """A mask bool [H, W] of whole pixels at this size: wherever one of them is set."""
        if mask is None or mask.shape == (self.height, self.width):
            return mask
        return F.interpolate(mask.float()[None, None], (self.height, self.width), mode="area")[0, 0] > 0.0


def picture_sizes(scene: Scene, width: int, height: int, device: torch.device) -> tuple[PictureSize, PictureSize]:
    """(whole pictures, coarse ones), which are the whole ones if half of them would be too small."""
    whole = PictureSize(width, height, scene.camera_at(width, height).to(device), 1.0)
    w, h = round(width / 2), round(height / 2)
    if min(w, h) < _LEAST:
        return whole, whole
    return whole, PictureSize(w, h, scene.camera_at(w, h).to(device), width * height / (w * h))
