"""Converts a decoded video frame to R'G'B' by its YCbCr matrix and range, with an error below one step.

Uses FFmpeg's scaler with its accurate flags: without them, errors reach 3 of 255, and pictures become darker by 1 on
average. Above 8 bits, the scaler leaves white below 65535 by a known factor, which this module corrects. For steep
curves (HDR, linear light), the module computes floats from the planes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace, Interpolation
from numpy.typing import NDArray

from .images import CAREFUL

MATRICES = {1: 1, 4: 4, 5: 5, 6: 5, 7: 7, 9: 9, 10: 9}
"""YCbCr matrix of the stream (ITU-T H.273) -> matrix of FFmpeg's scaler. BT.2020 constant luminance is read as
non-constant luminance."""
LUMA = {1: (0.2126, 0.0722), 4: (0.30, 0.11), 5: (0.299, 0.114), 7: (0.212, 0.087), 9: (0.2627, 0.0593)}
"""Matrix of the scaler -> shares of red and blue in luma."""
BT709, BT601, RGB = 1, 5, 0
VIDEO_RANGE, FULL_RANGE = 1, 2
MATRIX_OVERRIDES = {"bt709": BT709, "bt601": BT601, "bt2020": 9}
"""Value of --matrix -> the scaler's matrix."""
RANGE_OVERRIDES = {"video": VIDEO_RANGE, "full": FULL_RANGE}

# The scaler's 16-bit output for white in video range: 65536 * 255 / 256.
_WHITE16_OF_VIDEO_RANGE = 65280


@dataclass(frozen=True)
class Coding:
    """Matrix and range of the planes of a clip's frames."""

    matrix: int
    """YCbCr matrix, a key of `LUMA`; `RGB` if the planes are red, green and blue."""
    is_full: bool
    """True if codes go from 0 to the largest, False if black is 16 and white 235 of 255."""
    is_matrix_declared: bool
    """True if the file or the artist declares the matrix, False if it was assumed."""
    is_range_declared: bool
    """True if the file or the artist declares the range, False if it was assumed."""

    @property
    def matrix_name(self) -> str:
        """Name of the matrix for messages."""
        return "RGB" if self.matrix == RGB else Colorspace(self.matrix).name

    @property
    def range_name(self) -> str:
        """Name of the range for messages."""
        return "full" if self.is_full else "video"


def coding_of(frame: av.VideoFrame, matrix: str = "", code_range: str = "") -> Coding:
    """Matrix and range of a frame: by the artist's choice ("": none), else by its tags, else by what players assume.

    Players assume BT.709 for 1280 columns or more, BT.601 for fewer, and video range for YCbCr.
    """
    if frame.format.is_rgb or frame.format.name == "pal8":
        return Coding(RGB, is_full=True, is_matrix_declared=True, is_range_declared=True)
    tagged = MATRICES.get(int(frame.colorspace))
    assumed = BT709 if max(frame.width, frame.height) >= 1280 else BT601
    # Formats named yuvj are full range. FFmpeg also assumes full range for grey without a tag.
    named_full = frame.format.name.startswith("yuvj")
    tag = FULL_RANGE if named_full else int(frame.color_range)
    known = tag in (VIDEO_RANGE, FULL_RANGE)
    guess = FULL_RANGE if _is_grey(frame) else VIDEO_RANGE
    codes = RANGE_OVERRIDES.get(code_range) or (tag if known else guess)
    return Coding(
        MATRIX_OVERRIDES.get(matrix) or tagged or assumed,
        is_full=codes == FULL_RANGE,
        is_matrix_declared=bool(matrix) or tagged is not None or _is_grey(frame),
        is_range_declared=bool(code_range) or known,
    )


def depth_of(frame: av.VideoFrame) -> int:
    """Bit depth of the deepest component."""
    return max(component.bits for component in frame.format.components)


def rgb_codes(frame: av.VideoFrame, coding: Coding, *, deep: bool) -> NDArray[Any]:
    """R'G'B' [H, W, 3], uint8, or uint16 if `deep`: black is 0, white the largest code."""
    if _is_grey(frame):
        # The scaler always treats grey as full range.
        return _grey_codes(frame, coding, deep=deep)
    pixels: NDArray[Any] = _scaled(frame, coding, "rgb48le" if deep else "rgb24").to_ndarray()
    if not deep or coding.matrix == RGB:
        return pixels
    if not coding.is_full:  # 65280 becomes 65535
        np.minimum(pixels, _WHITE16_OF_VIDEO_RANGE, out=pixels)
        pixels += (pixels + np.uint16(128)) >> np.uint16(8)
    elif 8 <= (bits := depth_of(frame)) < 16:  # the largest code, shifted left to 16 bits, becomes 65535
        white = np.uint16((1 << 16) - (1 << (16 - bits)))
        np.minimum(pixels, white, out=pixels)
        pixels += pixels >> np.uint16(bits)
    return pixels


def exact_rgb(frame: av.VideoFrame, coding: Coding) -> NDArray[np.float32]:
    """R'G'B' [H, W, 3] float32 for steep curves: white is 1; values below 0 and above 1 are kept."""
    if coding.matrix == RGB or _is_grey(frame):
        return rgb_codes(frame, coding, deep=True).astype(np.float32) * np.float32(1.0 / 65535.0)
    y, cb, cr = _planes(frame, coding)
    kr, kb = LUMA[coding.matrix]
    red, blue = y + np.float32(2 * (1 - kr)) * cr, y + np.float32(2 * (1 - kb)) * cb
    green = (y - np.float32(kr) * red - np.float32(kb) * blue) / np.float32(1 - kr - kb)
    return np.stack([red, green, blue], axis=-1).astype(np.float32, copy=False)


def _planes(frame: av.VideoFrame, coding: Coding) -> list[NDArray[np.float32]]:
    """Y in 0 to 1, Cb and Cr in -0.5 to 0.5, [H, W] each. Codes outside of the range exceed these limits."""
    bits, form = depth_of(frame), frame.format
    # For 4:4:4, keep the bit depth: conversion to 16 bits would stretch full-range luma and shift its chroma.
    whole = form.chroma_width(64) == 64 and form.chroma_height(64) == 64
    stored = bits if whole else 16
    even = _scaled(frame, coding, "yuv444p" if stored == 8 else f"yuv444p{stored}le", keeps_range=True)
    kind = np.uint8 if stored == 8 else np.uint16
    codes = [
        np.frombuffer(memoryview(plane), kind).reshape(plane.height, -1)[:, : plane.width].astype(np.float32)
        for plane in even.planes[:3]
    ]
    codes = [c * np.float32(2.0 ** (bits - stored)) for c in codes]
    middle = np.float32(1 << (bits - 1))
    if coding.is_full:
        luma_black, luma_span, chroma_span = 0, (1 << bits) - 1, (1 << bits) - 1
    else:
        luma_black, luma_span, chroma_span = (x << (bits - 8) for x in (16, 219, 224))
    y = (codes[0] - np.float32(luma_black)) / np.float32(luma_span)
    return [y, *((c - middle) / np.float32(chroma_span) for c in codes[1:])]


def _scaled(frame: av.VideoFrame, coding: Coding, kind: str, *, keeps_range: bool = False) -> av.VideoFrame:
    codes = ColorRange.JPEG if coding.is_full else ColorRange.MPEG
    if coding.matrix != RGB:
        frame.color_range = codes  # the coding may differ from the frame's tag
    matrix = None if coding.matrix == RGB else Colorspace(coding.matrix)
    into = codes if keeps_range else None
    return frame.reformat(
        format=kind,
        src_colorspace=matrix,
        interpolation=Interpolation.BICUBIC | CAREFUL,
        src_color_range=codes,
        dst_color_range=into,
    )


def _is_grey(frame: av.VideoFrame) -> bool:
    return frame.format.name.startswith("gray") and "f" not in frame.format.name


def _grey_codes(frame: av.VideoFrame, coding: Coding, *, deep: bool) -> NDArray[Any]:
    """R'G'B' from luma only."""
    bits = depth_of(frame)
    plane = frame.planes[0]
    big = frame.format.name.endswith("be")
    kind = np.dtype(np.uint8) if bits == 8 else np.dtype(np.uint16).newbyteorder(">" if big else "<")
    codes = np.frombuffer(memoryview(plane), kind).reshape(plane.height, -1)[:, : plane.width].astype(np.float32)
    black, span = (0, (1 << bits) - 1) if coding.is_full else (16 << (bits - 8), 219 << (bits - 8))
    largest = 65535 if deep else 255
    luma = np.rint(np.clip((codes - black) / np.float32(span), 0.0, 1.0) * np.float32(largest))
    return np.repeat(luma.astype(np.uint16 if deep else np.uint8)[..., None], 3, axis=2)
