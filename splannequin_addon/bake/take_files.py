"""A take's files on disk as the compositor reads them: frame numbers and header values. No bpy."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...torch_backend import contract
from ..scene import numbered


@dataclass
class Take:
    """Frozen frames on disk, as the compositor reads them."""

    folder: Path
    """Folder of NNNNNN.exr."""
    first: int
    """First existing frame number."""
    last: int
    """Last existing frame number, inclusive."""
    depth_scale: float = 1.0
    """Scene units per solve unit: factor of the depth layer."""
    size: tuple[int, int] = (0, 0)
    """Width and height of the frames in pixels, without overscan."""
    margin: tuple[int, int] = (0, 0)
    """Overscan in pixels: (left and right, above and below)."""
    plate_size: tuple[int, int] = (0, 0)
    """Width and height in pixels of the plate that the take's warp applies to; (0, 0) without a warp."""
    light: str | tuple[float, ...] = "linear"
    """Encoding of the frames' light, in the form that `compat.colour_space` accepts."""


def take_of(folder: Path, depth_scale: float = 1.0) -> Take:
    """The take in a folder. Raises FileNotFoundError if the folder has no frozen frames."""
    numbers = numbered.frame_numbers(folder)
    if not numbers:
        raise contract.MissingError(f"{folder} has no frozen frames (NNNNNN.exr)")
    first = numbered.frame_path(folder, numbers[0])
    light = _exr_value(_exr_header(first), "splannequin:probe", "v3f", "<3f") or "linear"
    size, margin = exr_windows(first)
    return Take(folder, numbers[0], numbers[-1], depth_scale, size, margin, _plate_size(folder, numbers), light)


def _plate_size(take: Path, numbers: Sequence[int]) -> tuple[int, int]:
    """Width and height of the plate that a take's warp applies to; (0, 0) if any frame lacks its warp."""
    folder = contract.TakeFolder(take).warps
    if set(numbers) - set(numbered.frame_numbers(folder)):
        return 0, 0
    header = _exr_header(numbered.frame_path(folder, numbers[0]))
    found = [_exr_value(header, f"splannequin:{name}", "int", "<i") for name in ("plateWidth", "plateHeight")]
    return (found[0][0], found[1][0]) if found[0] and found[1] else (0, 0)


def exr_windows(path: Path) -> tuple[tuple[int, int], tuple[int, int]]:
    """((width, height), overscan (left and right, above and below)) of an EXR, in pixels.

    Raises ValueError without a header, or if the margins of opposite sides differ.
    """
    header = _exr_header(path)
    # From the header, because Blender reports 0 x 0 for a multilayer file.
    frame, data = (_exr_value(header, name, "box2i", "<4i") for name in ("displayWindow", "dataWindow"))
    if frame is None or data is None:
        raise contract.UserError(f"{path} is not an OpenEXR file. Freeze the take again.")
    (left, top, right, bottom), (data_left, data_top, data_right, data_bottom) = frame, data
    margin = (left - data_left, top - data_top)
    # Blender centres the pixels, regardless of the frame's position in them.
    if margin != (data_right - right, data_bottom - bottom) or min(margin) < 0:
        raise contract.UserError(f"{path} has different overscan on opposite sides. Freeze the take again.")
    return (right - left + 1, bottom - top + 1), margin


def _exr_header(path: Path) -> bytes:
    """First 16 KiB of an OpenEXR file, which contain its attributes; empty for any other file."""
    with contract.open_regular(path) as source:
        header = source.read(16384)
    return header if header[:4] == b"\x76\x2f\x31\x01" else b""


def _exr_value(header: bytes, name: str, kind: str, form: str) -> tuple[Any, ...] | None:
    """Value of an attribute as `struct` unpacks it; None if the header lacks the attribute."""
    key = f"{name}\0{kind}\0".encode()
    at = header.find(key)
    return None if at < 0 else struct.unpack_from(form, header, at + len(key) + 4)
