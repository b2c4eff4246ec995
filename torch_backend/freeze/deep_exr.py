"""Frozen frames as deep OpenEXR: a list of samples in each pixel, for compositors that merge by depth."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from itertools import repeat
from pathlib import Path
from typing import Any, cast

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from .exr import HALF_MAX, ROWS, FrameMetadata, frame_spec, set_margin, write_beside

DEEP_CHANNELS = ("R", "G", "B", "A", "Z")
"""Point samples: without ZBack a sample is a surface, not a volume."""
_FORMATS = (oiio.HALF, oiio.HALF, oiio.HALF, oiio.HALF, oiio.FLOAT)

Samples = Callable[[slice], tuple[NDArray[np.float32], NDArray[np.float32]]]
"""Rows -> ([S, h, W, 4] colour in the file's light, premultiplied by its own alpha; [S, h, W] depth), front to back; a
sample is there where alpha is above 0."""


def write_deep_exr(
    path: Path, size: tuple[int, ...], samples: Samples, metadata: FrameMetadata, margin: tuple[int, int] = (0, 0)
) -> Path:
    """Writes one frame of deep samples atomically: half colour and alpha, float32 depth along the camera's axis, ZIPS.

    Args:
        path: the file.
        size: (height, width) with overscan.
        samples: makes the samples, some rows at a time.
        metadata: as in `write_frozen_exr`, but in the axes and units that `depth_units` says.
        margin: as there.

    Raises:
        OSError: as `write_frozen_exr`.
    """
    height, width = size
    spec = frame_spec(width, height, DEEP_CHANNELS, _FORMATS, metadata)
    spec.attribute("compression", "zips")  # all that deep files can have
    spec.deep = True
    set_margin(spec, margin)

    def rows(output: Any, top: int) -> bool:
        part = slice(top, min(top + ROWS, height))
        begin, end = spec.y + part.start, spec.y + part.stop
        return bool(output.write_deep_scanlines(begin, end, 0, _deep_data(*samples(part))))

    return write_beside(path, spec, rows)


def _deep_data(rgba: NDArray[np.float32], depth: NDArray[np.float32]) -> oiio.DeepData:
    """OpenImageIO's own of samples as `Samples` gives them. It takes one number at a time: mapped, half as slow."""
    values = np.concatenate([rgba.clip(-HALF_MAX, HALF_MAX), depth[..., None]], axis=-1).reshape(
        len(rgba), -1, len(DEEP_CHANNELS)
    )
    is_covered = values[..., 3] > 0.0
    data = cast(Any, oiio.DeepData())
    data.init(is_covered.shape[1], len(DEEP_CHANNELS), tuple(oiio.TypeDesc(kind) for kind in _FORMATS), DEEP_CHANNELS)
    run = deque[None](maxlen=0).extend
    run(map(data.set_samples, range(is_covered.shape[1]), is_covered.sum(0).tolist()))
    pixels, layers = np.nonzero(is_covered.T)
    at = (np.cumsum(is_covered, axis=0) - 1)[layers, pixels].tolist()
    places = pixels.tolist()
    for channel in range(len(DEEP_CHANNELS)):
        run(map(data.set_deep_value, places, repeat(channel), at, values[layers, pixels, channel].tolist()))
    return data
