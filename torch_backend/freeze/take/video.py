"""Writes a video of frames for review: H.264 in MP4, Rec.709, playable everywhere."""

from __future__ import annotations

import math
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc
from numpy.typing import NDArray

from ...shot import atomic_path

CRF = 17
"""x264's constant rate factor: visually lossless at review size."""
MPEG4_QSCALE = 2
"""Quantiser of the fallback encoder; 2 is its best quality."""


def write_video(path: str | Path, frames: Iterable[NDArray[np.uint8]], fps: float) -> str:
    """Encodes display-referred frames [H,W,3] uint8, all of one size, to an MP4, atomically.

    Returns "". If this PyAV has no H.264 encoder, MPEG-4 part 2 is used, and a message for the artist is returned. Odd
    sizes are padded by one repeated row or column, because 4:2:0 needs even sizes. ValueError if there are no frames,
    if shape or type of a frame is wrong, or if `fps` is invalid; OSError if the file cannot be written.
    """
    rate = rational_fps(fps)
    codec = "libx264" if "libx264" in av.codecs_available else "mpeg4"
    source = iter(frames)
    first = next(source, None)
    if first is None:
        raise ValueError("frames should hold at least one frame, got none")
    shape = _checked(first, 0, None).shape
    # PyAV raises FFmpeg's errors as OSError with an errno, also for a full disk.
    with (
        atomic_path(path) as partial,
        av.open(str(partial), "w", format="mp4", options={"movflags": "faststart"}) as mp4,
    ):
        output: Any = mp4  # PyAV's annotations leave the packet type open
        stream = _add_stream(mp4, codec, rate, shape[1] + shape[1] % 2, shape[0] + shape[0] % 2)
        output.mux(stream.encode(_picture(first, 0, rate)))
        for index, frame in enumerate(source, start=1):
            output.mux(stream.encode(_picture(_checked(frame, index, shape), index, rate)))
        output.mux(stream.encode(None))
    if codec == "libx264":
        return ""
    return "PyAV has no H.264 encoder here, so the video is MPEG-4 part 2: larger, and some players do not show it."


def rational_fps(fps: float) -> Fraction:
    """`fps` as a fraction; 23.976, 29.97, 59.94 and similar rates become exactly n*1000/1001. ValueError unless > 0."""
    if not (math.isfinite(fps) and fps > 0):
        raise ValueError(f"fps should be a positive number, got {fps}")
    ntsc = Fraction(round(fps * 1.001) * 1000, 1001)
    if ntsc and abs(float(ntsc) - fps) < 5e-4 * fps and abs(round(fps) - fps) > 1e-6:
        return ntsc
    return Fraction(fps).limit_denominator(1000)


def _add_stream(container: Any, codec: str, rate: Fraction, width: int, height: int) -> Any:
    stream = container.add_stream(codec, rate=rate)
    stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
    context = stream.codec_context
    context.time_base = 1 / rate
    context.color_range = ColorRange.MPEG
    context.colorspace = Colorspace.ITU709
    context.color_primaries = ColorPrimaries.BT709
    context.color_trc = ColorTrc.BT709
    if codec == "libx264":
        stream.options = {"crf": str(CRF), "preset": "medium"}
    else:
        stream.options = {"flags": "+qscale", "global_quality": str(MPEG4_QSCALE * 118)}
    return stream


def _picture(frame: NDArray[np.uint8], index: int, rate: Fraction) -> av.VideoFrame:
    """One frame as Rec.709 yuv420p in video range, padded to even size."""
    height, width = frame.shape[:2]
    if height % 2 or width % 2:
        frame = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24").reformat(
        format="yuv420p",
        src_color_range=ColorRange.JPEG,
        dst_color_range=ColorRange.MPEG,
        dst_colorspace=Colorspace.ITU709,
    )
    picture.pts, picture.time_base = index, 1 / rate
    # The pixels are sRGB. They are tagged as Rec.709, because players show that without a conversion.
    picture.color_primaries, picture.color_trc = ColorPrimaries.BT709, ColorTrc.BT709
    picture.colorspace = Colorspace.ITU709
    return picture


def _checked(frame: NDArray[np.uint8], index: int, shape: tuple[int, ...] | None) -> NDArray[np.uint8]:
    if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8 or not frame.size:
        raise ValueError(f"frames[{index}] should be [H,W,3] uint8, got {list(frame.shape)} {frame.dtype}")
    if shape is not None and frame.shape != shape:
        raise ValueError(f"frames[{index}] should be {list(shape)} like the first, got {list(frame.shape)}")
    return frame
