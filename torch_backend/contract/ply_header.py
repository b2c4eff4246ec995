"""Reads the header of a binary PLY, for Blender and the backend: number of vertices, and properties of a vertex."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

from .errors import UserError

PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2", "ushort": "<u2",
    "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "float": "<f4", "float32": "<f4",
    "double": "<f8", "float64": "<f8",
}  # fmt: skip
"""PLY type of a property -> NumPy type."""
_MAX_HEADER_LINES = 1000


def read_ply_header(handle: BinaryIO, path: str | Path) -> tuple[int, list[tuple[str, str]]]:
    """Number of vertices, and (name, NumPy type) of each property in file order.

    Leaves the handle at the first vertex. ValueError unless the file is a binary little-endian PLY that begins with
    vertices.
    """
    if handle.readline(16).strip() != b"ply":
        raise UserError(f"{path}: not a PLY file")
    count: int | None = None
    fields: list[tuple[str, str]] = []
    element = ""
    for _ in range(_MAX_HEADER_LINES):
        words = handle.readline(1024).decode("ascii", errors="replace").split()
        match words:
            case ["format", "binary_little_endian", _] | ["comment", *_] | ["obj_info", *_]:
                pass
            case ["format", kind, *_]:
                raise UserError(f"{path}: format {kind}; only binary_little_endian is read")
            case ["element", name, number] if number.isdecimal():
                if count is None and name != "vertex":
                    raise UserError(f"{path}: element {name} comes before the vertices")
                element, count = name, int(number) if name == "vertex" else count
            case ["property", kind, name] if kind in PLY_TYPES:
                if element == "vertex":
                    fields.append((name, PLY_TYPES[kind]))
            case ["property", "list", *_] if element != "vertex":
                pass
            case ["end_header"] if count is not None and len({name for name, _ in fields}) == len(fields) > 0:
                return count, fields
            case _:
                raise UserError(f"{path}: bad line in the PLY header: {' '.join(words)[:80]!r}")
    raise UserError(f"{path}: the PLY header does not end within {_MAX_HEADER_LINES} lines")
