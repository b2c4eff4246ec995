"""The header of a take's surface.ply: a mesh with colours, and which triangles are people. Both sides read it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from .errors import UserError
from .files import LONGEST_CHECKPOINT, open_regular
from .identity import file_digest
from .shot_folder import TakeFolder

VERTEX_FIELDS = (
    ("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1"),
)  # fmt: skip
"""(name, NumPy type) of a vertex's fields: position in the scene's units, display-referred colour."""
TRIANGLE_FIELDS = (("corners", "u1"), ("a", "<i4"), ("b", "<i4"), ("c", "<i4"), ("people", "u1"))
"""(name, NumPy type) of a triangle's fields: number of corners (3), its vertices, 1 if it moves in the clip."""
_VERTEX_BYTES, _TRIANGLE_BYTES = 15, 14
_LONGEST = 1000
_TEXT = """ply
format binary_little_endian 1.0
comment splannequin take {}
element vertex {}
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
element face {}
property list uchar int vertex_indices
property uchar people
end_header
"""


@dataclass(frozen=True)
class SurfaceHeader:
    """Content of the header."""

    take: str
    """`file_digest` of the take.json of the take from which the surface was made."""
    vertices: int
    """Number of vertices; they follow the header."""
    triangles: int
    """Number of triangles; they follow the vertices."""

    def to_bytes(self) -> bytes:
        """The header as bytes of the file."""
        return _TEXT.format(self.take, self.vertices, self.triangles).encode("ascii")


def surface_of_take(take: TakeFolder) -> SurfaceHeader | None:
    """The header of a take's surface; None if there is no surface, or if the take has changed since."""
    try:
        with open_regular(take.surface, LONGEST_CHECKPOINT) as handle:
            header = read_surface_header(handle, take.surface)
        return header if header.take == file_digest(take.facts) else None
    except (OSError, ValueError):
        return None


def read_surface_header(handle: BinaryIO, path: str | Path) -> SurfaceHeader:
    """The header of an open file; leaves the handle at the first vertex. ValueError if it is invalid or truncated."""
    start = handle.read(_LONGEST).partition(b"end_header\n")
    text = (start[0] + start[1]).decode("ascii", errors="replace")
    found = re.fullmatch(re.escape(_TEXT).replace(r"\{\}", r"(\w{1,100})"), text)
    if found is None or not (found[2].isdecimal() and found[3].isdecimal()) or len(found[2] + found[3]) > 20:
        raise UserError(f"{path} is not the surface of a take: create it again.")
    header = SurfaceHeader(found[1], int(found[2]), int(found[3]))
    size = handle.seek(0, 2) - len(text)
    if size != header.vertices * _VERTEX_BYTES + header.triangles * _TRIANGLE_BYTES:
        raise UserError(f"{path} is truncated: create it again.")
    handle.seek(len(text))
    return header
