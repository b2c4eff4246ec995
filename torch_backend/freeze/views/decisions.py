"""Decisions that do not hang on the last bit of a float: soft masks, [h, w] in 0..1, instead of bool ones.

Another instruction set, or another size of picture, changes floats by some 1e-7. A pixel that lies on a threshold would
then jump from one plate to another. So a threshold is a ramp (`above`), and choices between plates prefer the first of
those that are equally good.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

MARGIN = 0.1
"""Half the width of a ramp, as a share of its threshold; values are equally good up to this share of the best, because
choices between plates cannot be soft. Above rounding errors by a factor of 1000 in the smallest."""
_SHARPEST = 1e-4
"""Least width of a ramp."""


def above(value: Tensor | float, threshold: Tensor | float) -> Tensor:
    """In 0..1 whether a value is above a threshold of 0 or more: 0.5 at it, 0 and 1 from `MARGIN` of it on."""
    value = torch.as_tensor(value, device="cpu")
    width = 2.0 * MARGIN * threshold
    width = width.clamp_min(_SHARPEST) if isinstance(width, Tensor) else max(width, _SHARPEST)
    return ((value - threshold) / width + 0.5).clamp(0.0, 1.0)


def first_best(values: Tensor) -> Tensor:
    """Index along the first dimension of the greatest value, of values of 0 or more; of equally good ones the first."""
    return (values >= (1.0 - MARGIN) * values.amax(dim=0)).float().argmax(dim=0)


def first_least(values: Sequence[float], least: float) -> int:
    """Index of the smallest of values of 0 or more; of equally good ones, or of those up to `least`, the first."""
    most = max((1.0 + MARGIN) * min(values), least)
    return next(n for n, value in enumerate(values) if value <= most)
