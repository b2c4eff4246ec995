"""Reads and writes single mattes as EXR or 16-bit PNG, with a key of their inputs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from ...contract import MATTE_FORMATS, TakeFolder, UserError, frame_file, is_whole_picture, regular_file
from ...footage.images import error_of, write_png
from ..exr import linear_spec, read_key, set_margin, write_exr


def matte_file(folder: TakeFolder, name: str, frame: int, suffix: str) -> Path:
    """Path of one frame of a matte; `suffix` is one of `MATTE_FORMATS`."""
    return folder.matte_frames(name) / frame_file(frame, f".{suffix}")


def write_matte(path: Path, matte: NDArray[np.float32], margin: tuple[int, int], key: str) -> None:
    """Writes a matte [H, W] in 0..1, atomically.

    R, G and B of an EXR (half) or a PNG (16 bits, linear) all hold the matte. A PNG has no overscan: `margin` pixels
    (left and right, above and below) are cropped. OSError if the file cannot be written.
    """
    # Three channels, so that every program shows the matte as a picture.
    three = np.repeat(matte[..., None], 3, axis=2)
    if path.suffix == ".png":
        across, down = margin
        height, width = matte.shape
        inner = three[down : height - down, across : width - across]
        write_png(path, np.rint(inner * 65535.0).astype(np.uint16), key)
        return
    spec = linear_spec(matte.shape[1], matte.shape[0], ("R", "G", "B"), (oiio.HALF,) * 3)
    spec.attribute("splannequin:key", key)
    set_margin(spec, margin)
    write_exr(path, spec, [three])


def read_matte(path: Path, margin: tuple[int, int]) -> NDArray[np.float32]:
    """Matte [H, W] in 0..1 from a file of `write_matte`, with overscan. ValueError if the file cannot be read."""
    buffer = oiio.ImageBuf(regular_file(path))
    pixels = None if buffer.has_error else buffer.get_pixels(oiio.FLOAT)
    if pixels is None or buffer.has_error:
        raise UserError(f"matte {path} cannot be read: {error_of(buffer)}")
    matte = np.ascontiguousarray(np.asarray(pixels, np.float32)[..., 0])
    across, down = margin
    return np.pad(matte, ((down, down), (across, across))) if path.suffix == ".png" else matte


def is_current(path: Path, key: str) -> bool:
    """True if a file is complete and stores `key`."""
    return is_whole_picture(path) and read_key(path) == key


def remaining_suffixes(suffix: str) -> list[str]:
    """The formats in `MATTE_FORMATS` other than `suffix`."""
    return [candidate for candidate in MATTE_FORMATS if candidate != suffix]
