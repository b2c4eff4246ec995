"""Decisions that do not depend on rounding: soft masks, [h, w] in 0..1, replace bool masks.

A threshold is a ramp (`above`), and of plates that are about equally good the first is chosen.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

MARGIN = 0.1
"""Half the width of a ramp, relative to its threshold. Choices between plates cannot be soft: values within this share
of the best count as equal. Even the narrowest ramp is 1000 times wider than rounding errors."""
_SHARPEST = 1e-4
"""Least width of a ramp."""


def above(value: Tensor | float, threshold: Tensor | float) -> Tensor:
    """Soft `value > threshold` in 0..1, for a threshold of 0 or more: a ramp of +-`MARGIN` * threshold around it."""
    value = value if isinstance(value, Tensor) else torch.tensor(value, device="cpu")
    # Another instruction set or picture size changes floats by 1e-7. At a hard threshold, a pixel would switch plates.
    width = 2.0 * MARGIN * threshold
    width = width.clamp_min(_SHARPEST) if isinstance(width, Tensor) else max(width, _SHARPEST)
    return ((value - threshold) / width + 0.5).clamp(0.0, 1.0)


def first_best(values: Tensor) -> Tensor:
    """Index along the first dimension of the largest value (values >= 0); the first, if several are about equal."""
    return (values >= (1.0 - MARGIN) * values.amax(dim=0)).float().argmax(dim=0)


def first_least(values: Sequence[float], least: float) -> int:
    """Index of the smallest value (values >= 0); the first, if several are about equal or at most `least`."""
    most = max((1.0 + MARGIN) * min(values), least)
    return next(n for n, value in enumerate(values) if value <= most)
