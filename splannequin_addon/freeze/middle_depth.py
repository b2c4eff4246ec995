"""Depth in the middle of a take's frame, read from its file. No bpy, which cannot read pixels of a multilayer EXR.

Supports only the format that the backend writes: single part, scan lines, ZIP.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np

from ...torch_backend import contract

# Scan lines per ZIP chunk.
_LINES = 16
# Channel type (uint, half, float) -> bytes per pixel.
_SIZES = {0: 4, 1: 2, 2: 4}


def of_frame(path: Path) -> float:
    """Median of the layer Z around the middle of a frame, solve units; 0 without depth or for an unsupported file.

    The area has `_LINES` lines and as many columns. Pixels without a surface (`contract.NO_DEPTH`) are ignored.
    """
    try:
        return _read(path)
    except (OSError, ValueError, KeyError, IndexError, struct.error, zlib.error):
        return 0.0


def _read(path: Path) -> float:
    with contract.open_regular(path) as file:
        mark, flags = struct.unpack("<4sI", file.read(8))
        header = contract.read_exr_header(file)
        if mark != b"\x76\x2f\x31\x01" or flags & 0x1A00 or header["compression"][0] != 3:
            return 0.0
        left, top, right, bottom = struct.unpack("<4i", header["dataWindow"])
        first_x, first_y, last_x, last_y = struct.unpack("<4i", header["displayWindow"])
        width, row = right - left + 1, (first_y + last_y + 1) // 2 - top
        channels = _channels(header["channels"])
        if not 0 < width <= contract.LIVE_LIMIT * 4 or not 0 <= row <= bottom - top or "Z" not in channels:
            return 0.0
        file.seek(8 * (row // _LINES), 1)
        file.seek(struct.unpack("<Q", file.read(8))[0])
        _, packed = struct.unpack("<2i", file.read(8))
        lines = min(_LINES, bottom - top + 1 - row // _LINES * _LINES)
        whole = width * sum(channels.values()) * lines
        data = _unpacked(file.read(min(max(packed, 0), whole)), whole)
    before = width * sum(size for name, size in channels.items() if name < "Z")
    kind = np.dtype("<f2" if channels["Z"] == 2 else "<f4")
    depth = data.reshape(lines, -1)[:, before : before + width * channels["Z"]].copy().view(kind)
    middle = (first_x + last_x + 1) // 2 - left
    seen = depth[:, max(middle - _LINES // 2, 0) : middle + _LINES // 2].ravel().astype(np.float64)
    seen = np.sort(seen[(seen > 0.0) & (seen < contract.NO_DEPTH)])
    return float(seen[len(seen) // 2]) if len(seen) else 0.0


def _channels(listed: bytes) -> dict[str, int]:
    """Channel name -> bytes per pixel, in file order."""
    found: dict[str, int] = {}
    while listed and listed[0]:
        name, _, listed = listed.partition(b"\0")
        found[name.decode("latin-1")] = _SIZES[struct.unpack_from("<i", listed)[0]]
        listed = listed[16:]
    return found


def _unpacked(packed: bytes, size: int) -> np.ndarray:
    """Uncompressed bytes of a chunk, [size] uint8. Raises ValueError if their number differs from `size`."""
    if len(packed) == size:  # a chunk that ZIP would enlarge is stored uncompressed
        return np.frombuffer(packed, np.uint8)
    unzipped = np.frombuffer(zlib.decompressobj().decompress(packed, size), np.uint8)
    if len(unzipped) != size:
        raise ValueError("a chunk has an unexpected size")
    # OpenEXR stores the differences of bytes, offset by 128, even bytes before odd bytes.
    steps = unzipped.copy()
    steps[1:] -= 128
    halves = np.cumsum(steps, dtype=np.uint8)
    result = np.empty(size, np.uint8)
    result[0::2], result[1::2] = halves[: (size + 1) // 2], halves[(size + 1) // 2 :]
    return result
