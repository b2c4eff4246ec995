"""Regions of a matte as wholes: what hangs together is kept or let go together, so that no outline of it stays.

Pure functions on masks [h, w], bool. Beyond the border nothing counts.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..torch_types import from_numpy
from .reproject import narrowed, resized, widened


def opened(mask: Tensor, by: int) -> Tensor:
    """The mask without what is narrower than 2 `by` + 1 pixels: outlines, which errors of depth explain."""
    return widened(narrowed(mask, by), by) if bool(mask.any()) else mask


def closed(mask: Tensor, by: int) -> Tensor:
    """The mask with holes and gaps filled that are about 2 `by` pixels wide or less."""
    if by <= 0:
        return mask
    h, w = mask.shape
    half = resized(mask.float(), (w + 1) // 2, (h + 1) // 2) > 0.4  # a quarter of the work
    filled = narrowed(widened(half, (by + 1) // 2), (by + 1) // 2)
    return mask | (resized(filled.float(), w, h) > 0.5)


def grown(seeds: Tensor, where: Tensor, reach: int, thin: int = 0) -> Tensor:
    """`seeds`, and of `where` what hangs together with them and lies within `reach` pixels of them, going along it.

    What of `where` is narrower than 2 `thin` + 1 pixels leads nowhere.
    """
    if not bool(where.any()):
        return seeds
    h, w = seeds.shape
    size = (w + 1) // 2, (h + 1) // 2  # a quarter of the work; regions are larger than its pixels
    found, inside = (resized(mask.float(), *size) > 0.4 for mask in (seeds, where))
    inside = opened(inside, (thin + 1) // 2) | found
    for _ in range((reach + 1) // 2):
        before, found = found, widened(found, 1) & inside
        if torch.equal(before, found):  # nothing is left to reach
            break
    return seeds | (where & (resized(found.float(), w, h) > 0.25))


def components(mask: Tensor) -> list[Tensor]:
    """bool [h, w] each: the connected regions of a mask."""
    import cv2

    count, found = cv2.connectedComponents(mask.numpy().astype(np.uint8), connectivity=8)
    labels = from_numpy(np.asarray(found, np.int64))
    return [labels == n for n in range(1, count)]


def larger(mask: Tensor, least: float) -> Tensor:
    """Of the mask those connected regions that have `least` pixels or more."""
    import cv2

    _, found, about, _ = cv2.connectedComponentsWithStats(mask.numpy().astype(np.uint8), connectivity=8)
    keeps = np.asarray(about[:, cv2.CC_STAT_AREA]) >= least
    keeps[0] = False
    return from_numpy(keeps)[from_numpy(np.asarray(found, np.int64))]


def enclosed(mask: Tensor, ground: Tensor, rim: int, share: float, least: float = 0.0) -> Tensor:
    """Of the mask those connected regions of whose surroundings, `rim` pixels wide, `share` or more is `ground`.

    Those of fewer than `least` pixels are none.
    """
    import cv2

    count, found, about, _ = cv2.connectedComponentsWithStats(mask.numpy().astype(np.uint8), connectivity=8)
    areas = from_numpy(np.asarray(about[:, cv2.CC_STAT_AREA], np.float32))
    labels = from_numpy(np.asarray(found, np.int64))
    around = widened(labels.float(), rim).long()  # where two regions meet the later one has it
    around[mask] = 0
    size, good = (torch.zeros(count, device="cpu") for _ in range(2))
    size.index_add_(0, around.flatten(), torch.ones(around.numel(), device="cpu"))
    good.index_add_(0, around.flatten(), ground.flatten().float())
    keeps = (good >= share * size) & (areas >= least)
    keeps[0] = False
    return keeps[labels]
