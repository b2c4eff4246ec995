"""Large pictures in little memory: some rows at a time.

A step that takes a dozen pictures of scratch takes a dozen bands instead. Pictures up to `BAND_PIXELS` are one band:
they are made as a whole, and what is made in bands is the same.
"""

from __future__ import annotations

import ctypes
import math
import sys

import torch
from torch import Tensor

from .reproject import look_up

BAND_PIXELS = 1 << 19
"""Pixels of a band: 17 bands of 3840 x 2160, one of 640 x 480."""
_REACH = 3
"""Rows beyond a place that a bicubic look-up may touch."""


def bands(rows: int, columns: int) -> list[slice]:
    """Slices of rows that together are a picture of `rows` x `columns`, top to bottom."""
    step = max(1, BAND_PIXELS // max(1, columns))
    return [slice(top, min(top + step, rows)) for top in range(0, rows, step)]


def hand_back() -> None:
    """Gives back to the system what was freed and the C library keeps, which has a call for it (glibc).

    Planes of 4K are just below the 32 MiB from which it maps memory of its own: holes between small things stay.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)


def look_up_near(picture: Tensor, pixels: Tensor) -> Tensor:
    """`reproject.look_up`, bicubic, of places that lie near to each other: only the rows that they need become float32.

    Equal to it but for the rounding of coordinates, some 1e-4 pixels.
    """
    height, width = picture.shape[:2]
    if height * width <= BAND_PIXELS or not pixels.numel():
        return look_up(picture, pixels, "bicubic")
    least, most = (float(y) for y in torch.aminmax(pixels[..., 1]))
    if not (math.isfinite(least) and math.isfinite(most)):
        return look_up(picture, pixels, "bicubic")
    top = min(max(0, math.floor(least) - _REACH), height - 1)
    bottom = max(min(height, math.ceil(most) + _REACH), top + 1)
    down = torch.tensor([0.0, float(top)], dtype=pixels.dtype, device=pixels.device)
    return look_up(picture[top:bottom], pixels - down, "bicubic")
