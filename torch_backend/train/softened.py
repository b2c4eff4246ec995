"""Trains movers on softened pictures in the first steps of their field.

A hand that is farther from where the field has it than Gaussians are wide has nothing that pulls it there, and stays
where it is most of the time. In pictures of large pixels it overlaps with itself. What stands still is learnt from
whole pictures all the while, and so is everything before there is a field: a run that began on coarse pictures
altogether lost 0.2 to 0.9 dB of what stands still (docs/decisions.md, "Gate and field").
"""

from __future__ import annotations

from torch import Tensor
from torch.nn import functional as F

from ..torch_types import integers
from .losses import photometric

_LENGTHS_OF = 640.0
_MARGIN = 4.0
"""Pixels of pictures 640 wide around what moves that are softened with it."""


class SoftenedMovers:
    """The photometric loss of a run, in which what moves is soft for a while."""

    def __init__(self, movers: Tensor | None, width: int, span: tuple[float, float], block: float) -> None:
        """
        Args:
            movers: bool [I, H, W], moving pixels of each trained frame; None: unknown, and nothing is softened.
            width: W.
            span: start and end of the softening, as shares of the run.
            block: pixels of pictures 640 wide along the side of a softened one.
        """
        self.block, self.margin = round(block * width / _LENGTHS_OF), max(1, round(_MARGIN * width / _LENGTHS_OF))
        self.span = span if self.block > 1 else (0.0, 0.0)
        self.movers = movers
        self._any = [] if movers is None else integers(movers.flatten(1).any(dim=1).long())

    @property
    def until(self) -> float:
        """Share of the run at which the last softened picture was learnt from; 0: none is."""
        return 0.0 if not any(self._any) else self.span[1]

    def movers_at(self, frame: int, progress: float) -> Tensor | None:
        """bool [H, W] what moves in the trained frame at position `frame`, if that is softened once a share `progress`
        of the run is done."""
        due = self.movers is not None and self.span[0] <= progress < self.span[1] and self._any[frame] > 0
        return self.movers[frame] if due and self.movers is not None else None

    def loss(
        self, image: Tensor, target: Tensor, dssim: float, ignored: Tensor | None, movers: Tensor | None
    ) -> Tensor:
        """As `photometric`, 0-dim.

        Args:
            image, target: [H, W, 3].
            dssim: weight of structure.
            ignored: bool [H, W] pixels that teach nothing; None: all do.
            movers: bool [H, W] what moves, of a frame that is softened; None: it is not.
        """
        if movers is None:
            return photometric(image, target, dssim, ignored)
        moves = F.max_pool2d(movers[None, None].float(), 2 * self.margin + 1, 1, self.margin)[0, 0] > 0.0
        taught = moves if ignored is None else moves & ~ignored
        sharp = photometric(image, target, dssim, moves if ignored is None else moves | ignored)
        return sharp + photometric(self._soft(image), self._soft(target), dssim, ~self._touched(taught))

    def _soft(self, image: Tensor) -> Tensor:
        """[h, w, 3] means of the blocks of [H, W, 3]; those at the far borders may be smaller."""
        return F.avg_pool2d(image.permute(2, 0, 1)[None], self.block, ceil_mode=True)[0].permute(1, 2, 0).contiguous()

    def _touched(self, mask: Tensor) -> Tensor:
        """bool [h, w]: blocks in which a pixel of the mask lies."""
        return F.max_pool2d(mask[None, None].float(), self.block, ceil_mode=True)[0, 0] > 0.0
