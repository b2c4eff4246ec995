"""Working frames with a highlight shoulder, as the import writes them for scene-linear footage. Does not need bpy."""

import struct
import zlib
from pathlib import Path

import numpy as np

START, ROLL = 0.8, 0.0414
STEPS = np.array([0.05, 0.3, 0.6, 0.61, 1.0, 4.0, 20.0, 60.0])


def light(width: int, height: int) -> np.ndarray:
    """[H, W, 3] float64: vertical bars of `STEPS` from left to right; blue has half the value."""
    bars = STEPS[np.arange(width) * len(STEPS) // width]
    return np.tile(bars[None, :, None] * [1.0, 1.0, 0.5], (height, 1, 1))


def shown(light: np.ndarray) -> np.ndarray:
    """Encode linear light as the import does for working frames, 0 to 1."""
    srgb = np.where(light > 0.0031308, 1.055 * light ** (1 / 2.4) - 0.055, 12.92 * light)
    return np.minimum(srgb, START) + ROLL * np.log1p(np.maximum(srgb - START, 0.0) / ROLL)


def write(path: Path, light: np.ndarray) -> None:
    """Write linear light as a 16-bit PNG."""
    codes = np.rint(shown(light) * 65535.0).astype(">u2")
    rows = b"".join(b"\0" + row.tobytes() for row in codes)
    parts = [(b"IHDR", struct.pack(">2I5B", codes.shape[1], codes.shape[0], 16, 2, 0, 0, 0))]
    parts += [(b"sRGB", b"\0"), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    with path.open("wb") as file:
        file.write(b"\x89PNG\r\n\x1a\n")
        for kind, data in parts:
            file.write(struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)))
