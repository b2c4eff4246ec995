"""Writes a Cryptomatte: all mattes of a frame in one file, from which compositors select by name.

Cryptomatte specification 1.2.0 (Friedman, Jones: "Fully automatic ID mattes with support for motion blur and
transparency", SIGGRAPH 2015 posters; https://github.com/Psyop/Cryptomatte). The identifier of a matte is the
MurmurHash3 of its name, stored as a float. Each pixel holds (identifier, share) pairs, the largest share first. Two
pairs form a layer of R G B A. The header's manifest maps names to identifiers.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from ...contract import CRYPTOMATTE, layers_of
from ..exr import LazyLayer, linear_spec, set_margin, write_exr

LAYERS = layers_of(CRYPTOMATTE)
PAIRS = 2 * len(LAYERS)
"""Largest number of mattes per pixel; beyond it, the mattes with the smallest shares are dropped."""
_MASK = 0xFFFFFFFF


def murmur3(data: bytes, seed: int = 0) -> int:
    """MurmurHash3_x86_32 (Appleby, public domain) of bytes."""
    hashed = seed
    block_bytes = len(data) // 4 * 4
    blocks = [*struct.unpack(f"<{block_bytes // 4}I", data[:block_bytes]), int.from_bytes(data[block_bytes:], "little")]
    for n, block in enumerate(blocks):
        block = block * 0xCC9E2D51 & _MASK
        block = _turned(block, 15) * 0x1B873593 & _MASK
        hashed ^= block
        if n < block_bytes // 4:  # MurmurHash3 omits this step for a tail of fewer than four bytes
            hashed = (_turned(hashed, 13) * 5 + 0xE6546B64) & _MASK
    hashed ^= len(data)
    hashed = (hashed ^ hashed >> 16) * 0x85EBCA6B & _MASK
    hashed = (hashed ^ hashed >> 13) * 0xC2B2AE35 & _MASK
    return hashed ^ hashed >> 16


def _turned(value: int, by: int) -> int:
    """A 32-bit word rotated left by `by` bits."""
    return (value << by | value >> 32 - by) & _MASK


def identifier(name: str) -> int:
    """32-bit Cryptomatte identifier of a name: its hash, changed if the float would be infinite, NaN or denormal."""
    hashed = murmur3(name.encode())
    return hashed ^ 1 << 23 if hashed >> 23 & 255 in (0, 255) else hashed


def as_float(bits: int) -> np.float32:
    """The float32 with the given 32 bits."""
    return np.uint32(bits).view(np.float32)


def manifest(names: Sequence[str]) -> str:
    """JSON object: name -> identifier as eight hexadecimal digits."""
    return json.dumps({name: f"{identifier(name):08x}" for name in names}, ensure_ascii=False, separators=(",", ":"))


def ranked(mattes: Mapping[str, NDArray[np.float32]]) -> NDArray[np.float32]:
    """[H, W, 2 * PAIRS]: (identifier, share) pairs of each pixel's mattes, the largest share first, then 0.

    Shares of a pixel that sum to more than 1 are scaled to sum to 1. ValueError if there are no mattes, or if their
    sizes differ.
    """
    identifiers = np.array([as_float(identifier(name)) for name in mattes], np.float32)
    shares = np.stack([np.clip(matte, 0.0, 1.0) for matte in mattes.values()], axis=-1).astype(np.float32)
    shares /= np.maximum(shares.sum(-1, keepdims=True), 1.0)
    order = np.argsort(-shares, axis=-1, kind="stable")[..., :PAIRS]
    found = np.take_along_axis(shares, order, -1)
    pairs = np.zeros((*shares.shape[:2], PAIRS, 2), np.float32)
    pairs[..., : order.shape[-1], 1] = found
    pairs[..., : order.shape[-1], 0] = np.where(found > 0.0, identifiers[order], np.float32(0.0))
    return pairs.reshape(*shares.shape[:2], 2 * PAIRS)


def write_cryptomatte(
    path: str | Path, mattes: Mapping[str, NDArray[np.float32]], margin: tuple[int, int] = (0, 0), key: str = ""
) -> Path:
    """Writes mattes [H, W] in 0..1 of a frame as a Cryptomatte, atomically: float32, ZIP.

    `margin`: pixels of overscan in the arrays, as in `write_frozen_exr`. OSError if the file cannot be written.
    """
    shape = next(iter(mattes.values())).shape
    names = tuple(channel for layer in LAYERS for channel in layer.channels)
    spec = linear_spec(shape[1], shape[0], names, (oiio.FLOAT,) * len(names))
    layer = CRYPTOMATTE
    prefix = f"cryptomatte/{murmur3(layer.encode()):08x}"[: len("cryptomatte/") + 7]
    attributes = {
        "name": layer,
        "hash": "MurmurHash3_32",
        "conversion": "uint32_to_float32",
        "manifest": manifest([*mattes]),
    }
    for name, value in attributes.items():
        spec.attribute(f"{prefix}/{name}", value)
    if key:
        spec.attribute("splannequin:key", key)
    set_margin(spec, margin)

    def rows(of: slice) -> NDArray[np.float32]:
        return ranked({name: matte[of] for name, matte in mattes.items()})

    return write_exr(Path(path), spec, [LazyLayer((*shape, 2 * PAIRS), rows)])
