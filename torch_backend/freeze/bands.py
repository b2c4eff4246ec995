"""Large pictures in little memory: some rows at a time.

A step that takes a dozen pictures of scratch takes a dozen bands instead. Pictures up to `BAND_PIXELS` are one band:
they are made as a whole, and what is made in bands is the same.
"""

from __future__ import annotations

import ctypes
import sys

BAND_PIXELS = 1 << 19
"""Pixels of a band: 17 bands of 3840 x 2160, one of 640 x 480."""


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
