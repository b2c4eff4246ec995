"""Regions of a matte as wholes: what hangs together is kept or let go together, so that no outline of it stays.

Pure functions on masks [h, w], bool. Beyond the border nothing counts.
"""

from __future__ import annotations

import torch
from torch import Tensor

from .reproject import narrowed, resized, widened


def opened(mask: Tensor, by: int) -> Tensor:
    """The mask without what is narrower than 2 `by` + 1 pixels: outlines, which errors of depth explain."""
    return widened(narrowed(mask.float(), by), by) > 0.5


def closed(mask: Tensor, by: int) -> Tensor:
    """The mask with holes and gaps filled that are no wider than 2 `by` pixels."""
    return narrowed(widened(mask.float(), by), by) > 0.5


def grown(seeds: Tensor, where: Tensor, reach: int) -> Tensor:
    """`seeds`, and of `where` what hangs together with them and lies within `reach` pixels of them, going along it."""
    h, w = seeds.shape
    size = (w + 1) // 2, (h + 1) // 2  # a quarter of the work; regions are larger than its pixels
    inside, found = (resized(mask.float(), *size) for mask in (where | seeds, seeds))
    inside, found = (inside > 0.4).float(), (found > 0.4).float()
    for _ in range((reach + 1) // 2):
        found = torch.minimum(widened(found, 1), inside)
    return seeds | (where & (resized(found, w, h) > 0.25))
