"""Orientation of stored pictures and videos: the eight EXIF orientations, and the transform to upright."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import av
import numpy as np
import OpenImageIO as oiio
from av.sidedata.sidedata import Type
from numpy.typing import NDArray

from .av_types import side_data
from .oiio_types import attribute

# Tolerance for the elements of a display matrix: a rotation by one degree changes them by 0.017.
_NEARLY = 0.02
_WORDS = {
    2: "mirrored left to right", 3: "turned by 180 degrees", 4: "mirrored top to bottom",
    5: "mirrored along its diagonal", 6: "turned clockwise", 7: "mirrored along its other diagonal",
    8: "turned counterclockwise",
}  # fmt: skip
# Elements (a, b, c, d) of a display matrix with x' = a x + c y and y' = b x + d y, y downwards -> EXIF code.
_MATRICES = {
    (1, 0, 0, 1): 1, (-1, 0, 0, 1): 2, (-1, 0, 0, -1): 3, (1, 0, 0, -1): 4,
    (0, 1, 1, 0): 5, (0, 1, -1, 0): 6, (0, -1, -1, 0): 7, (0, -1, 1, 0): 8,
}  # fmt: skip


@dataclass(frozen=True)
class Orientation:
    """One of the eight EXIF orientations."""

    code: int = 1
    """EXIF code, 1 to 8; 1: the picture is stored upright."""

    _PARTS: ClassVar[dict[int, tuple[bool, int]]] = {
        1: (False, 0), 2: (True, 0), 3: (False, 2), 4: (True, 2), 5: (True, 1), 6: (False, 3), 7: (True, 3),
        8: (False, 1),
    }  # fmt: skip
    """Code -> (mirror left to right first, number of quarter turns counterclockwise)."""

    @property
    def is_mirrored(self) -> bool:
        """True if the orientation includes a reflection."""
        return self._PARTS[self.code][0]

    @property
    def swaps_sides(self) -> bool:
        """True if width and height are exchanged."""
        return self.code >= 5

    @property
    def words(self) -> str:
        """Description of the transform, for the end of a sentence; empty for upright pictures."""
        return _WORDS.get(self.code, "")

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height of the upright picture, from those of the stored one."""
        return (height, width) if self.swaps_sides else (width, height)

    def upright(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """The upright version of a stored picture [h, w, ...], contiguous."""
        is_mirrored, turns = self._PARTS[self.code]
        return np.ascontiguousarray(np.rot90(pixels[:, ::-1] if is_mirrored else pixels, turns))


UPRIGHT = Orientation()
"""Orientation of pictures that are stored upright."""


def orientation_of_picture(spec: oiio.ImageSpec) -> Orientation | None:
    """The orientation in a picture's header; upright if missing, None for an invalid code."""
    code = attribute(spec, "Orientation")
    if code is None or code == 0:  # cameras write 0 for unknown
        return UPRIGHT
    return Orientation(code) if isinstance(code, int) and 1 <= code <= 8 else None


def orientation_of_matrix(matrix: NDArray[np.int32]) -> Orientation | None:
    """The orientation in a display matrix (9 numbers, as in MP4 and FFmpeg); None if it is none of the eight.

    Scale and offset are ignored: pictures are shown whole, and FFmpeg converts unequal scales to a pixel aspect.
    """
    a, b, u, c, d, v = (float(value) for value in matrix[:6])
    across, down = math.hypot(a, b), math.hypot(c, d)
    if across == 0 or down == 0 or u or v:
        return None
    exact = a / across, b / across, c / down, d / down
    rounded = round(exact[0]), round(exact[1]), round(exact[2]), round(exact[3])
    if max(abs(x - y) for x, y in zip(exact, rounded, strict=True)) > _NEARLY or rounded not in _MATRICES:
        return None
    found = Orientation(_MATRICES[rounded])
    # FFmpeg's pixel aspect is that of the shown picture. After a quarter turn, it would not fit the stored picture.
    return None if found.swaps_sides and abs(across / down - 1.0) > _NEARLY else found


def display_matrix(frame: av.VideoFrame) -> NDArray[np.int32] | None:
    """The display matrix of a decoded frame or of its stream; None if neither has one."""
    data = side_data(frame, Type.DISPLAYMATRIX)
    return np.frombuffer(data, np.int32, 9) if len(data) >= 36 else None
