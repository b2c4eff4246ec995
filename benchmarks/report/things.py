"""Additional figures of hard scenes: recall of a small mover, and false motion on glass and mirrors, which change with
the view but not with time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from .real import motion_shares
from .truth import PANES

if TYPE_CHECKING:
    from .truth import TruthScene

RECALL_DISTANCE = 0.15
"""Greatest distance of a pixel's colour from the truth with which it shows the thing: root mean square over channels of
display-referred values in [0, 1]. It equals a PSNR of 16.5 dB: the thing may be soft or slightly displaced."""
RECALL_CONTRAST = 0.1
"""Distance of thing and background, in the same measure, below which they are too similar; such pixels do not
count."""
LEAST_PIXELS = 6
"""Least pixels of the thing for a pose to be the worst one; with fewer it only counts in the sum."""
OPENED = 0.5
"""Motion matte above which a pixel of a frozen frame was treated as moving."""


def recalled(image: Tensor, truth: Tensor, behind: Tensor, mask: Tensor) -> tuple[int, int]:
    """(pixels that show the thing, pixels that should) of a frozen frame.

    A pixel shows it if its colour is within `RECALL_DISTANCE` of the truth, and closer to the truth than to `behind`.

    Args:
        image, truth, behind: [H, W, 3] display-referred in [0, 1]; `behind` is the truth without the thing.
        mask: bool [H, W], the thing's pixels in the truth.
    """
    error, mistaken, contrast = (_distance(a, b) for a, b in ((image, truth), (image, behind), (truth, behind)))
    counted = mask & (contrast > RECALL_CONTRAST)
    return int((counted & (error <= RECALL_DISTANCE) & (error < mistaken)).sum()), int(counted.sum())


def _distance(a: Tensor, b: Tensor) -> Tensor:
    """[H, W] root mean square difference over channels."""
    return (a.float().clamp(0.0, 1.0) - b.float().clamp(0.0, 1.0)).square().mean(2).sqrt()


def recall_of(
    behind: Mapping[str, Tensor], image: Tensor, truth: Tensor, regions: Mapping[str, Tensor]
) -> dict[str, list[int]]:
    """{thing: [pixels that show it, pixels that should]} of a frozen frame, for every thing in `behind`."""
    return {name: list(recalled(image, truth, b, regions[name])) for name, b in behind.items() if name in regions}


def overall(counts: Sequence[tuple[int, int]]) -> tuple[float | None, float | None]:
    """(share over all pixels, share in the worst frame) of the counts of `recalled` in several frames.

    None without counted pixels. Frames with fewer than `LEAST_PIXELS` cannot be the worst one.
    """
    should = sum(of for _, of in counts)
    each = [found / of for found, of in counts if of >= LEAST_PIXELS]
    return sum(found for found, _ in counts) / should if should else None, min(each) if each else None


def opened_on(motion: Tensor, regions: Mapping[str, Tensor]) -> dict[str, float]:
    """{pane: share of it that a freeze's motion matte [H, W] calls moving}, for visible panes."""
    return {n: float((motion[regions[n]] > OPENED).float().mean()) for n in PANES if n in regions and regions[n].any()}


def matte_on_panes(truth: TruthScene, frames: Sequence[int], width: int, height: int) -> dict[str, dict[str, float]]:
    """{pane: {"moving", "unknown": share of its pixels}} by the shot's motion matte, over frames of the clip.

    {} for scenes without panes. ValueError if a frame has no matte.
    """
    sums: dict[str, Tensor] = {}
    for frame in frames:
        regions = truth.frame_regions(frame, width, height)
        panes = [name for name in PANES if name in regions and regions[name].any()]
        if not panes:
            continue
        shares = motion_shares(truth.shot, frame, width, height)
        unknown = 1.0 - shares["moving"] - shares["still"]
        for name in panes:
            of = regions[name]
            found = [shares["moving"][of].sum(), unknown[of].sum(), of.sum()]
            sums[name] = sums.get(name, torch.zeros(3, device=of.device)) + torch.stack([v.float() for v in found])
    return {n: {"moving": float(s[0] / s[2]), "unknown": float(s[1] / s[2])} for n, s in sums.items()}
