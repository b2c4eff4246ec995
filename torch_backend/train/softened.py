"""Trains moving pixels on low-resolution images during the first steps of the field.

If a hand's true position is farther from its Gaussians than their width, no gradient pulls them there, and they stay at
the most frequent position. At low resolution, both positions overlap. Still pixels are always trained at full
resolution, and so are all pixels before a field exists.
"""

from __future__ import annotations

from torch import Tensor
from torch.nn import functional as F

from ..torch_types import integers
from .losses import photometric

_LENGTHS_OF = 640.0
"""Image width in pixels to which lengths refer."""
# Width of the margin around moving pixels that is included, in pixels of an image 640 wide.
_MARGIN = 4.0


class SoftenedMovers:
    """Photometric loss of a run, which compares moving pixels at low resolution during a part of the run."""

    def __init__(self, movers: Tensor | None, width: int, span: tuple[float, float], block: float) -> None:
        """
        Args:
            movers: bool [I, H, W] moving pixels of each training frame; None: all pixels have full resolution.
            width: W.
            span: start and end of training at low resolution, as shares of the run.
            block: side of a low-resolution pixel, in pixels of an image 640 wide.
        """
        self.block, self.margin = round(block * width / _LENGTHS_OF), max(1, round(_MARGIN * width / _LENGTHS_OF))
        self.span = span if self.block > 1 else (0.0, 0.0)
        self.movers = movers
        self._any = [] if movers is None else integers(movers.flatten(1).any(dim=1).long())

    @property
    def until(self) -> float:
        """Share of the run at which training at low resolution ends; 0: it is not used."""
        return 0.0 if not any(self._any) else self.span[1]

    def movers_at(self, frame: int, progress: float) -> Tensor | None:
        """bool [H, W] moving pixels of the training frame at position `frame`; None if they have full resolution at
        `progress` (share of the run)."""
        # Not before the field exists: runs that began at low resolution lost 0.2 to 0.9 dB in still regions.
        is_active = self.movers is not None and self.span[0] <= progress < self.span[1] and self._any[frame] > 0
        return self.movers[frame] if is_active and self.movers is not None else None

    def loss(
        self, image: Tensor, target: Tensor, dssim: float, ignored: Tensor | None, movers: Tensor | None
    ) -> Tensor:
        """Photometric loss, 0-dim; see `photometric`.

        Args:
            image, target: [H, W, 3].
            dssim: weight of D-SSIM.
            ignored: bool [H, W] pixels that are left out; None: no pixel.
            movers: bool [H, W] pixels that are compared at low resolution; None: no pixel.
        """
        if movers is None:
            return photometric(image, target, dssim, ignored)
        moves = F.max_pool2d(movers[None, None].float(), 2 * self.margin + 1, 1, self.margin)[0, 0] > 0.0
        taught = moves if ignored is None else moves & ~ignored
        # Both terms are means over the whole image, so moving and still regions keep their shares of the loss.
        sharp = photometric(image, target, dssim, moves if ignored is None else moves | ignored)
        return sharp + photometric(self._soft(image), self._soft(target), dssim, ~self._touched(taught))

    def _soft(self, image: Tensor) -> Tensor:
        """[h, w, 3] block means of an image [H, W, 3]; blocks at the right and bottom border may be smaller."""
        return F.avg_pool2d(image.permute(2, 0, 1)[None], self.block, ceil_mode=True)[0].permute(1, 2, 0).contiguous()

    def _touched(self, mask: Tensor) -> Tensor:
        """bool [h, w] blocks that contain a pixel of the mask."""
        return F.max_pool2d(mask[None, None].float(), self.block, ceil_mode=True)[0, 0] > 0.0
