"""Reads, writes and resizes pictures. PNG files go through OpenImageIO.

Arrays are RGB, [H, W, 3], uint8 or uint16, display-referred sRGB. OpenImageIO and pycolmap must not be loaded into one
process: their copies of zlib collide (double free in deflateEnd, seen with 3.2.2 and 4.2.1). Therefore only the child
process `sfm/worker.py` loads pycolmap.
"""

from __future__ import annotations

import errno
import math
import re
import shutil
import struct
import zlib
from pathlib import Path
from typing import Any

import av
import numpy as np
import OpenImageIO as oiio
from av.video.reformatter import Interpolation
from numpy.typing import NDArray

from ..array_types import SparseMatrix, sparse_entries
from ..contract import (
    FRAMES_FOLDER,
    MOST_PIXELS,
    RAW_FOLDER,
    ExitCode,
    JobError,
    MissingError,
    UserError,
    open_regular,
    regular_file,
)
from ..shot import atomic_path

# Run-length compression after libpng's Paeth filter. Compared with zlib's level 2 and a filter chosen per row, it takes
# half the time (a third for 16 bits). Files are 3 to 12 % smaller: most matches in filtered pictures are chance.
_PNG_ENCODING = {"compression": "rle", "png:filter": 128}

CAREFUL = Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT | Interpolation.FULL_CHR_H_INP
"""Accurate flags of FFmpeg's scaler. Without them, it reads chroma only at every other column, and rounds down."""

_FULL_BYTES = 4 << 20
# Folder of working frames -> (hint how to recreate them, exit code).
_REMEDIES = {
    RAW_FOLDER: ("Import the clip again.", ExitCode.FOOTAGE),
    FRAMES_FOLDER: ("Solve the camera again.", ExitCode.SOLVE),
}


def error_of(source: Any = oiio) -> str:
    """Returns and clears the pending error of OpenImageIO or of one of its objects."""
    try:
        text = source.geterror()
    except UnicodeDecodeError:  # the message quotes bytes of a damaged file
        return "it is damaged"
    claimed = re.search(r"claimed to be (\d+)x(\d+)", text)
    if claimed:  # the rest of the message is advice for programmers
        return f"it claims to be {claimed[1]} x {claimed[2]} pixels"
    return text.strip().partition("\n")[0].rstrip(".")


def check_size(name: str, spec: oiio.ImageSpec) -> None:
    """Raises JobError (FOOTAGE) if a picture's header announces more than `MOST_PIXELS`. Call before reading pixels."""
    for width, height in ((spec.full_width, spec.full_height), (spec.width, spec.height)):
        if width * height > MOST_PIXELS:
            raise too_large(name, width, height)


def too_large(name: str, width: int, height: int) -> JobError:
    """The error for a picture with more than `MOST_PIXELS`."""
    return JobError(
        f"{name} is {width} x {height} pixels according to its header, but at most {MOST_PIXELS >> 20} megapixels "
        "are supported.",
        "Make it smaller.",
        ExitCode.FOOTAGE,
    )


def write_png(path: str | Path, pixels: NDArray[Any], key: str = "") -> None:
    """Writes [H, W, 3] uint8 or uint16 atomically as a PNG of the same depth. Raises OSError if that fails.

    `key` is stored in the file as the text `splannequin:key`.
    """
    if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.dtype.type not in (np.uint8, np.uint16):
        raise ValueError(f"pixels should be [H, W, 3] uint8 or uint16, got {pixels.shape} {pixels.dtype}")
    buffer = oiio.ImageBuf(np.ascontiguousarray(pixels))
    for name, value in _PNG_ENCODING.items():
        buffer.specmod().attribute(name, value)
    buffer.specmod().attribute("oiio:ColorSpace", "sRGB")
    if key:
        buffer.specmod().attribute("splannequin:key", key)
    with atomic_path(path) as partial:
        # OpenImageIO's writer reports no error when the disk is full.
        if not (buffer.write(str(partial)) and _has_end(partial)):
            full = shutil.disk_usage(partial.parent).free < max(_FULL_BYTES, pixels.nbytes)
            raise OSError(errno.ENOSPC if full else errno.EIO, f"cannot write picture: {error_of(buffer)}", str(path))


def _has_end(png: Path) -> bool:
    """True if a PNG ends with its IEND chunk."""
    with open(png, "rb") as written:
        written.seek(max(0, png.stat().st_size - 8))
        return written.read(4) == b"IEND"


def read_png(path: str | Path) -> NDArray[Any]:
    """Reads a PNG as [H, W, 3] uint8 or uint16, as stored. Raises FileNotFoundError, or ValueError naming the file."""
    path = Path(path)
    if not path.is_file():
        raise MissingError(f"picture {path} does not exist")
    buffer = oiio.ImageBuf(regular_file(path))
    kind = oiio.UINT16 if str(buffer.spec().format) == "uint16" else oiio.UINT8
    pixels = None if buffer.has_error else buffer.get_pixels(kind)
    if pixels is None or buffer.has_error:
        raise UserError(f"picture {path} cannot be read: {error_of(buffer)}")
    pixels = np.asarray(pixels)
    return pixels[..., :3] if pixels.shape[2] >= 3 else np.repeat(pixels[..., :1], 3, axis=2)


def read_frame(path: Path) -> NDArray[Any]:
    """Reads a working frame like `read_png`. Raises JobError, which names the frame and the step that recreates it."""
    try:
        return read_png(path)
    except (ValueError, FileNotFoundError) as error:
        remedy = _REMEDIES.get(path.parent.name)
        if remedy is None:
            raise
        raise JobError(f"Frame {int(path.stem)} is damaged or missing: {path}.", *remedy) from error


def is_whole_png(path: Path) -> bool:
    """True if all chunks of a PNG are present with a correct checksum. Ten times faster than decoding."""
    try:
        with open_regular(path) as handle:
            whole = handle.read(8) == b"\x89PNG\r\n\x1a\n"
            kind = b""
            while whole and kind != b"IEND":
                size, kind = struct.unpack(">I4s", handle.read(8))
                part = handle.read(size + 4)
                whole = len(part) == size + 4 and zlib.crc32(part[:-4], zlib.crc32(kind)) == int.from_bytes(part[-4:])
            return whole
    except (OSError, ValueError, struct.error):
        return False


def resize(pixels: NDArray[Any], width: int, height: int) -> NDArray[Any]:
    """Resizes [h, w, 3] uint8 or uint16 to [height, width, 3] of the same dtype by Lanczos-3, without linearising."""
    if pixels.shape[:2] == (height, width):
        return pixels
    kind = "rgb48le" if pixels.dtype == np.uint16 else "rgb24"
    # FFmpeg's scaler takes 24 ms for 1080 to 720 lines, OpenImageIO 850 ms. They differ by 0.13 of an 8-bit step (RMS).
    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), kind)
    return frame.reformat(width, height, kind, interpolation=Interpolation.LANCZOS | CAREFUL).to_ndarray()


def resize_float(pixels: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """Resizes [h, w, C] float32 (black 0, white 1) to [height, width, C] by Lanczos-3, without clipping.

    The parts below 0 and above 1 use a tent filter.
    """
    if pixels.shape[:2] == (height, width):
        return pixels
    core = np.clip(pixels, 0.0, 1.0)
    beyond = pixels - core
    resized = _weigh(core, width, height, 3)
    # Around a lamp of fifty times white, Lanczos would ring to black: a tent filter cannot ring.
    return resized + _weigh(beyond, width, height, 1) if beyond.any() else resized


def _weigh(pixels: NDArray[np.float32], width: int, height: int, lobes: int) -> NDArray[np.float32]:
    h, w, channels = pixels.shape
    tall = (_weights(h, height, lobes) @ pixels.reshape(h, w * channels)).reshape(height, w, channels)
    wide = np.empty((height, width, channels), np.float32)
    across = _weights(w, width, lobes)
    for row, into in zip(tall, wide, strict=True):
        into[:] = across @ row
    return wide


def _weights(size: int, new_size: int, lobes: int) -> SparseMatrix:
    """Weights [new_size, size] float32 along one side, of a tent (1 lobe) or a Lanczos kernel. The border is repeated.

    For downscaling, the kernel widens by the scale factor.
    """
    scale = max(1.0, size / new_size)
    centre = (np.arange(new_size) + 0.5) * (size / new_size) - 0.5
    reach = int(np.ceil(lobes * scale))
    index = np.floor(centre).astype(np.int64)[:, None] + np.arange(-reach, reach + 1)
    at = (index - centre[:, None]) / scale
    kernel = 1.0 - np.abs(at) if lobes == 1 else np.sinc(at) * np.sinc(at / lobes)
    weights = np.where(np.abs(at) < lobes, kernel, 0.0)
    weights /= weights.sum(axis=1, keepdims=True)
    rows = np.broadcast_to(np.arange(new_size)[:, None], index.shape).ravel()
    columns = index.clip(0, size - 1).ravel()
    return sparse_entries(weights.astype(np.float32).ravel(), rows, columns, (new_size, size))


WORKING_LINES = 720
"""Default maximum height of working frames of landscape footage, in pixels."""
WORKING_AREA = 1280 * WORKING_LINES
"""Default maximum area of working frames of portrait and square footage, in pixels: the area of a 16:9 frame."""


def working_size(width: int, height: int, requested_height: int) -> tuple[int, int]:
    """(width, height) of the working frames in pixels for a requested height. Never larger than the source.

    A requested height of 0 means the source's height, limited by `WORKING_LINES` or `WORKING_AREA`. Scaled frames have
    even sides, for video encoders; unscaled frames keep odd sides.
    """
    most = WORKING_LINES if width > height else max(WORKING_LINES, int(math.sqrt(WORKING_AREA * height / width)))
    target = min(height, requested_height if requested_height > 0 else most)
    if target == height:
        return width, height
    target = max(2, target // 2 * 2)
    return max(2, round(width * target / height / 2) * 2), target
