"""Resampling a picture through a map, once computed and applied to every frame."""

from __future__ import annotations

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray


def warp(pixels: NDArray, where: NDArray[np.float32]) -> NDArray:
    """Takes each output pixel from where it lies in `pixels`, with a Catmull-Rom filter (exact where nothing moves).

    `pixels` is [H, W, 3] uint8 or uint16, `where` [H, W, 2]: x and y in pixels, centres at +0.5. Same shape and dtype
    out. ValueError if the sizes differ.
    """
    height, width = pixels.shape[:2]
    if where.shape != (height, width, 2):
        raise ValueError(f"the map is {where.shape}, the picture {pixels.shape}: their sizes differ")
    st = oiio.ImageBuf(np.ascontiguousarray(where / np.array([width, height], np.float32), dtype=np.float32))
    source = oiio.ImageBuf(np.ascontiguousarray(pixels))
    target = oiio.ImageBufAlgo.st_warp(source, st, "catmull-rom", 0.0)
    if target.has_error:
        raise ValueError(f"cannot undistort {pixels.shape}: {target.geterror()}")
    return np.asarray(target.get_pixels(oiio.UINT16 if pixels.dtype == np.uint16 else oiio.UINT8))
