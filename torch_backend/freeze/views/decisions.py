"""Decisions that do not hang on the last bit of a float: soft masks, [h, w] in 0..1, instead of bool ones.

Another instruction set, or another size of picture, changes floats by some 1e-7. A pixel that lies on a threshold would
then jump from one plate to another, and a region of it with it. So a threshold is a ramp (`above`), masks are joined by
least and greatest values, and what is decided of whole regions is decided at several levels of a mask (`by_levels`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce

import torch
from torch import Tensor

MARGIN = 0.1
"""Half the width of a ramp, as a share of its threshold. Above rounding errors by a factor of 1000 in the smallest."""
LEVELS = 4
"""Levels of a mask at which regions are decided on: one that comes or goes at a level moves a pixel by 1/4 at most."""
_SHARPEST = 1e-4
"""Least width of a ramp."""
_ALIKE = 0.01
"""Values are equally good up to this share of the best: choices between plates cannot be soft."""


def above(value: Tensor | float, threshold: Tensor | float, margin: float = MARGIN) -> Tensor:
    """In 0..1 whether a value is above a threshold of 0 or more: 0.5 at it, 0 and 1 from `margin` of it on."""
    value = torch.as_tensor(value, device="cpu")
    width = 2.0 * margin * threshold
    width = width.clamp_min(_SHARPEST) if isinstance(width, Tensor) else max(width, _SHARPEST)
    return ((value - threshold) / width + 0.5).clamp(0.0, 1.0)


def all_of(*masks: Tensor) -> Tensor:
    """The least of several masks, soft or bool."""
    return reduce(torch.minimum, (mask.float() for mask in masks))


def any_of(*masks: Tensor) -> Tensor:
    """The greatest of several masks, soft or bool."""
    return reduce(torch.maximum, (mask.float() for mask in masks))


def none_of(*masks: Tensor) -> Tensor:
    """What is in none of several masks, soft or bool."""
    return 1.0 - any_of(*masks)


def by_levels(mask: Tensor, choose: Callable[[Tensor], Tensor]) -> Tensor:
    """The mask with what is chosen of its regions.

    The mask is cut into `LEVELS` layers of equal thickness. `choose` is given the bool mask [h, w] of what reaches into
    a layer, and says in 0..1 how much of each pixel stays, [..., h, w]. Where everything does the mask is unchanged.
    """
    mask = mask.float()
    out, before, chosen = torch.zeros_like(mask), None, None
    for level in range(LEVELS):
        within = mask > level / LEVELS
        if not bool(within.any()):
            break
        if chosen is None or before is None or not torch.equal(within, before):
            before, chosen = within, choose(within)
        out = out + chosen * (mask * LEVELS - level).clamp(0.0, 1.0) / LEVELS
    return out


def first_best(values: Tensor) -> Tensor:
    """Index along the first dimension of the greatest value, of values of 0 or more; of equally good ones the first."""
    return (values >= (1.0 - _ALIKE) * values.amax(dim=0)).float().argmax(dim=0)


def first_least(values: Sequence[float], least: float) -> int:
    """Index of the smallest of values of 0 or more; of equally good ones, or of those up to `least`, the first."""
    most = max((1.0 + _ALIKE) * min(values), least)
    return next(n for n, value in enumerate(values) if value <= most)
