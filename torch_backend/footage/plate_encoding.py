"""Encoding of plates in memory: keeps the precision of the source in few bytes.

Codes are [H, W, 3]: uint8 or uint16, display-referred sRGB from 0 to the largest code; or float16, scene-linear Rec.709
with values below 0 and above 1. A half float holds light as EXR does: with a relative error of 2.5e-4, up to 65504.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from .color import InputSpace, linear_to_srgb, srgb_to_linear
from .images import resize, resize_float

ROWS = 64
"""Number of rows converted at a time: a large plate takes four times the memory as float32."""
_HALF_MAX = np.float32(65504.0)


def half_of(pixels: NDArray[np.float32], space: InputSpace) -> NDArray[np.float16]:
    """Converts [H, W, 3] as read, in `space`, to float16 codes."""
    out = np.empty(pixels.shape, np.float16)
    for top in range(0, len(pixels), space.rows):
        out[top : top + space.rows] = space.to_linear(pixels[top : top + space.rows])
    return out


def display(codes: NDArray[Any]) -> NDArray[np.float32]:
    """Converts codes of any shape to extended display-referred values, white 1."""
    out = np.empty(codes.shape, np.float32)
    for top in range(0, len(codes), ROWS):
        part = codes[top : top + ROWS]
        if codes.dtype == np.float16:
            np.take(_display_of_halves(), part.view(np.uint16), out=out[top : top + ROWS], mode="clip")
        else:
            np.multiply(part, np.float32(1.0 / np.iinfo(codes.dtype).max), out=out[top : top + ROWS])
    return out


def linear(codes: NDArray[Any]) -> NDArray[np.float32]:
    """Converts codes of any shape to scene-linear Rec.709."""
    if codes.dtype == np.float16:
        return codes.astype(np.float32)
    out, table = np.empty(codes.shape, np.float32), _linear_of_integers(np.iinfo(codes.dtype).max)
    for top in range(0, len(codes), ROWS):
        np.take(table, codes[top : top + ROWS], out=out[top : top + ROWS], mode="clip")
    return out


def from_display(pixels: NDArray[np.float32], kind: DTypeLike) -> NDArray[Any]:
    """Converts extended display-referred values to codes of a dtype. Clips and rounds integer codes."""
    if np.dtype(kind) == np.float16:
        return np.clip(srgb_to_linear(pixels), -_HALF_MAX, _HALF_MAX).astype(np.float16)
    most = np.float32(np.iinfo(kind).max)
    return np.rint(np.clip(pixels * most, 0, most)).astype(kind)


def resize_plate(codes: NDArray[Any], width: int, height: int) -> NDArray[Any]:
    """Resizes codes to [height, width, 3] of the same dtype, by Lanczos-3 on display-referred values as in `resize`."""
    if codes.shape[:2] == (height, width):
        return codes
    if codes.dtype != np.float16:
        return resize(codes, width, height)
    return from_display(resize_float(display(codes), width, height), np.float16)


@cache
def _display_of_halves() -> NDArray[np.float32]:
    """Table of the display-referred value of each of the 65536 half floats, indexed by its bits."""
    with np.errstate(all="ignore"):
        return linear_to_srgb(np.arange(65536, dtype=np.uint16).view(np.float16).astype(np.float32))


@cache
def _linear_of_integers(most: int) -> NDArray[np.float32]:
    return srgb_to_linear(np.arange(most + 1, dtype=np.float32) * np.float32(1.0 / most))
