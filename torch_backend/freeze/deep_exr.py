"""Writes frozen frames as deep OpenEXR, with several samples per pixel, for compositors that merge by depth."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from itertools import repeat
from pathlib import Path
from typing import Any, cast

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from .exr import HALF_MAX, ROWS, FrameMetadata, frame_spec, set_margin, write_picture

DEEP_CHANNELS = ("R", "G", "B", "A", "Z")
"""Channels of a deep frame. Without ZBack, a sample is a surface, not a volume."""
_FORMATS = (oiio.HALF, oiio.HALF, oiio.HALF, oiio.HALF, oiio.FLOAT)

Samples = Callable[[slice], tuple[NDArray[np.float32], NDArray[np.float32]]]
"""Rows -> ([S, h, W, 4] colour in the file's primaries, premultiplied by the sample's alpha; [S, h, W] depth), front to
back. A sample with alpha 0 does not exist."""


def write_deep_exr(
    path: Path, size: tuple[int, ...], samples: Samples, metadata: FrameMetadata, margin: tuple[int, int] = (0, 0)
) -> Path:
    """Writes one frame of deep samples atomically: half colour and alpha, float32 depth along the camera's axis, ZIPS.

    Args:
        path: output file.
        size: (height, width) with overscan.
        samples: returns the samples of some rows.
        metadata: as in `write_frozen_exr`, but in the axes and units that `depth_units` states.
        margin: as in `write_frozen_exr`.

    Raises:
        OSError: as `write_frozen_exr`.
    """
    height, width = size
    spec = frame_spec(width, height, DEEP_CHANNELS, _FORMATS, metadata)
    spec.attribute("compression", "zips")  # deep files support no stronger compression
    spec.deep = True
    set_margin(spec, margin)

    def rows(output: Any, top: int) -> bool:
        part = slice(top, min(top + ROWS, height))
        begin, end = spec.y + part.start, spec.y + part.stop
        return bool(output.write_deep_scanlines(begin, end, 0, _deep_data(*samples(part))))

    return write_picture(path, spec, rows)


def _deep_data(rgba: NDArray[np.float32], depth: NDArray[np.float32]) -> oiio.DeepData:
    """OpenImageIO's `DeepData` of samples. It accepts one value per call; `map` takes half the time of a loop."""
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
