"""Rows of an EXR as OpenEXR stores them, packed by a C++ kernel that Warp compiles.

OpenImageIO converts rows for a file of half and float channels value by value, and does not accept converted rows from
Python. A frame of 1920 x 1080 and 18 channels took it 0.9 CPU seconds, apart from the compression. A file is therefore
written as one half channel whose rows have the same bytes, and the header of the real channels replaces its header.
"""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from ..contract import open_regular
from ..kernel_text import kernel_text
from ..native import INTEGER, POINTER, Snippet

ROUNDED = {"grain": 2, "splat": 3, "plate": 4}
"""Layer of rounded halves -> its number in the kernel. Grain keeps 2 bits of mantissa and splats keep 8. `plate` is in
steps of 1/256."""
_ROWS_OF_A_CHUNK = 16
_KERNEL = Path(__file__).with_name("kernels") / "exr_rows.cpp"


@functools.cache
def _snippet() -> Snippet:
    fields = {
        **dict.fromkeys(("channels", "out", "infinite"), POINTER),
        **dict.fromkeys(("count", "width", "height", "bytes"), INTEGER),
    }
    return Snippet("exr_rows", fields, kernel_text(_KERNEL))


def warm_up() -> None:
    """Compiles the kernel, or loads it from the cache. Call this from the main thread."""
    _snippet().warm_up()


@dataclass(frozen=True)
class Packing:
    """Layout of the rows of a ZIP-compressed scanline EXR."""

    spec: oiio.ImageSpec
    """Header of the file, half and float channels."""
    names: Sequence[str]
    """Names of the layers that `packed` receives, see `ROUNDED`."""

    @functools.cached_property
    def _sizes(self) -> list[int]:
        """Bytes of a value of each channel, in the order of `spec`."""
        spec = self.spec
        return [2 if spec.channelformat(c).basetype == oiio.HALF else 4 for c in range(spec.nchannels)]

    @functools.cached_property
    def _places(self) -> list[int]:
        """First byte of each channel in a row. OpenEXR sorts channels by name."""
        names = list(cast(Any, self.spec).channelnames)
        order = sorted(range(len(names)), key=lambda channel: names[channel].encode())
        ends = np.cumsum([0] + [self._sizes[channel] * self.spec.width for channel in order]).tolist()
        return [ends[order.index(channel)] for channel in range(len(names))]

    def packed(self, layers: Sequence[NDArray[np.float32]]) -> tuple[NDArray[np.float16], list[str]]:
        """([h, N] rows as one half channel, names of the layers with NaN or infinity).

        `layers` are [h, W] or [h, W, c]; their channels together are those of `spec`, in order. Halves are clamped to
        +-65504.
        """
        parts = [layer[..., None] if layer.ndim == 2 else layer for layer in layers]
        channels = [(part[..., c], n) for n, part in enumerate(parts) for c in range(part.shape[2])]
        table = np.array(
            [
                (a.ctypes.data, a.strides[1] // 4, a.strides[0] // 4, place, self._kind(n, size), n)
                for (a, n), place, size in zip(channels, self._places, self._sizes, strict=True)
            ],
            np.int64,
        )
        height, row_bytes = len(parts[0]), sum(self._sizes) * self.spec.width
        out, infinite = np.empty((height, row_bytes // 2), np.float16), np.zeros(len(parts), np.float32)
        _snippet().run(
            channels=table.ctypes.data, out=out.ctypes.data, infinite=infinite.ctypes.data, count=len(table),
            width=self.spec.width, height=height, bytes=row_bytes,
        )  # fmt: skip
        return out, [name for name, is_infinite in zip(self.names, infinite, strict=True) if is_infinite]

    def _kind(self, layer: int, size: int) -> int:
        return 0 if size == 4 else ROUNDED.get(self.names[layer], 1)

    def disguised(self) -> tuple[oiio.ImageSpec, bytes]:
        """(header of a file with the same bytes in one half channel, the real header, which is as long)."""
        plain = oiio.ImageSpec(sum(self._sizes) * self.spec.width // 2, self.spec.height, 1, oiio.HALF)
        plain.y = self.spec.y
        plain.attribute("compression", "zip")
        plain.attribute("padding", "x")
        real = _header(self.spec)
        plain.attribute("padding", "x" * (1 + len(real) - len(_header(plain))))
        return plain, real


def _header(spec: oiio.ImageSpec) -> bytes:
    """Header of a ZIP-compressed EXR. OSError if the folder for temporary files is missing or full."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "header.exr"
        output = cast(Any, oiio.ImageOutput).create(str(path))
        if not (output.open(str(path), spec) and output.close()):
            raise OSError(f"OpenImageIO cannot write the header of an EXR: {output.geterror()}")
        chunks = -(-spec.height // _ROWS_OF_A_CHUNK)
        with open_regular(path) as source:
            return source.read()[: -8 * chunks]  # without the table of the chunks' places
