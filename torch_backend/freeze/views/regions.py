"""Regions of a matte as wholes: what hangs together is kept or let go together, so that no outline of it stays.

Pure functions on masks [h, w], soft in 0..1 (`decisions.py`) or bool. Beyond the border nothing counts.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ...torch_types import from_numpy
from .decisions import above, all_of, any_of, by_levels
from .reproject import narrowed, widened


def opened(mask: Tensor, by: int) -> Tensor:
    """The mask without what is narrower than 2 `by` + 1 pixels: outlines, which errors of depth explain."""
    return widened(narrowed(mask, by), by) if bool(mask.any()) else mask


def closed(mask: Tensor, by: int) -> Tensor:
    """The mask with holes and gaps filled that are about 2 `by` pixels wide or less."""
    if by <= 0:
        return mask
    half = (by + 1) // 2  # at half the size: a quarter of the work
    return any_of(mask, _doubled(narrowed(widened(_halved(mask), half), half), mask))


def grown(seeds: Tensor, where: Tensor, reach: int, thin: int = 0) -> Tensor:
    """`seeds`, and of `where` what hangs together with them and lies within `reach` pixels of them, going along it.

    What of `where` is narrower than 2 `thin` + 1 pixels leads nowhere.
    """
    if not bool(where.any()):
        return seeds
    found, inside = _halved(seeds), _halved(where)  # a quarter of the work; regions are larger than its pixels
    inside = any_of(opened(inside, (thin + 1) // 2), found)
    for _ in range((reach + 1) // 2):
        before, found = found, all_of(widened(found, 1), inside)
        if torch.equal(before, found):  # nothing is left to reach
            break
    return any_of(seeds, all_of(where, _doubled(found, where)))


def components(mask: Tensor) -> list[Tensor]:
    """bool [h, w] each: the connected regions of a bool mask."""
    import cv2

    count, found = cv2.connectedComponents(mask.numpy().astype(np.uint8), connectivity=8)
    labels = from_numpy(np.asarray(found, np.int64))
    return [labels == n for n in range(1, count)]


def larger(mask: Tensor, least: float) -> Tensor:
    """Of the mask those connected regions that have more than about `least` pixels."""
    return by_levels(mask, lambda within: _labelled(within, least)[0])


def enclosed(mask: Tensor, ground: Tensor, rim: int, share: float, least: float = 0.0) -> Tensor:
    """Of the mask those connected regions of whose surroundings, `rim` pixels wide, `share` or more is `ground`.

    Those of fewer than about `least` pixels are none.
    """
    return by_levels(mask, lambda within: standing_on(within, ground, rim, share, least))


def standing_on(mask: Tensor, ground: Tensor, rim: int, share: float, least: float = 0.0) -> Tensor:
    """[h, w] in 0..1: how far each region of a bool mask is what `enclosed` asks for."""
    large, labels = _labelled(mask, least)
    if share <= 0.0:
        return large
    around = widened(labels.float(), rim).long()  # where two regions meet the later one has it
    around[mask] = 0
    size, good = (torch.zeros(int(labels.max()) + 1, device="cpu") for _ in range(2))
    size.index_add_(0, around.flatten(), torch.ones(around.numel(), device="cpu"))
    good.index_add_(0, around.flatten(), ground.flatten().float())
    return all_of(large, above(good / size.clamp_min(1.0), share)[labels])


def holes(mask: Tensor) -> Tensor:
    """bool [h, w]: the regions of a bool mask that do not reach the border: what is all around is no hole."""
    labels = _labelled(mask, 0.0)[1]
    keeps = torch.ones(int(labels.max()) + 1, device="cpu") > 0
    keeps[torch.cat([labels[0], labels[-1], labels[:, 0], labels[:, -1]])] = False
    return keeps[labels] & mask


def _labelled(mask: Tensor, least: float) -> tuple[Tensor, Tensor]:
    """([h, w] in 0..1: what is of a region of a bool mask with more than about `least` pixels, [h, w] int64: which)."""
    import cv2

    _, found, about, _ = cv2.connectedComponentsWithStats(mask.numpy().astype(np.uint8), connectivity=8)
    areas = from_numpy(np.asarray(about[:, cv2.CC_STAT_AREA], np.float32))
    labels = from_numpy(np.asarray(found, np.int64))
    # Half a pixel less, so that a region of exactly as many pixels is one.
    keeps = above(areas, max(0.0, least - 0.5)) if least > 0.5 else torch.ones_like(areas)
    return all_of(keeps[labels], mask), labels


def _halved(mask: Tensor) -> Tensor:
    """[h / 2, w / 2] of a mask: the second greatest of each four pixels, so a bool one has what half of them have."""
    h, w = mask.shape
    if h % 2 or w % 2:
        mask = torch.nn.functional.pad(mask.float()[None, None], (0, w % 2, 0, h % 2), mode="replicate")[0, 0]
    a, b, c, d = (mask[top::2, left::2].float() for top in (0, 1) for left in (0, 1))
    return any_of(all_of(a, b), all_of(c, d), all_of(any_of(a, b), any_of(c, d)))


def _doubled(half: Tensor, like: Tensor) -> Tensor:
    """A mask of half the size at that of `like`."""
    h, w = like.shape
    return half.repeat_interleave(2, 0).repeat_interleave(2, 1)[:h, :w]
