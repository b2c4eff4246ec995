"""Processes large pictures in bands of rows to save memory.

A step that needs a dozen temporary pictures only needs a dozen temporary bands. A picture of up to `BAND_PIXELS` is one
band. The result does not depend on the bands.
"""

from __future__ import annotations

import ctypes
import sys

BAND_PIXELS = 1 << 19
"""Largest number of pixels per band: 3840 x 2160 pixels are 16 bands, 640 x 480 one."""


def bands(rows: int, columns: int) -> list[slice]:
    """Slices of rows that cover a picture of `rows` x `columns`, from top to bottom."""
    step = max(1, BAND_PIXELS // max(1, columns))
    return [slice(top, min(top + step, rows)) for top in range(0, rows, step)]


def hand_back() -> None:
    """Returns freed memory to the operating system (`malloc_trim` of glibc); does nothing elsewhere.

    A 4K plane is just below the 32 MiB from which glibc maps memory separately. Its freed blocks would otherwise stay
    on the heap between small allocations.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)
