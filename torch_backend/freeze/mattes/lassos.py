"""Reads lassos, the polygons drawn around an object at a frame of a take, from JSON files.

    {"mattes": [{"name": "left man", "frame": 30, "polygon": [[75, 200], [95, 188], ...]}, ...]}

Coordinates are pixels of the frozen frame without its overscan, from the top left corner. If a lasso has "width" and
"height", its coordinates are pixels of a picture of that size and are scaled. A file may also be a single lasso.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard, cast

import numpy as np
from numpy.typing import NDArray

from ...contract import ExitCode, JobError, checked_name, read_json
from ...contract.files import is_json_object

MOST_CORNERS = 100_000
"""Largest number of corners of a polygon; a polygon drawn by hand has some hundreds."""


@dataclass(frozen=True)
class Lasso:
    """A polygon around an object."""

    name: str
    """Name of the matte."""
    frame: int
    """Frame number of the take at which the polygon was drawn."""
    polygon: tuple[tuple[float, float], ...]
    """Corners, in pixels of the frozen frame without its overscan."""

    def corners(self) -> NDArray[np.float64]:
        """Corners [P, 2] in pixels."""
        return np.array(self.polygon, np.float64)

    def to_json(self) -> dict[str, Any]:
        """JSON object of the lasso, in the format of `read_lassos`."""
        return {"name": self.name, "frame": self.frame, "polygon": [list(corner) for corner in self.polygon]}


def read_lassos(path: str | Path, width: int, height: int) -> list[Lasso]:
    """The lassos of a file, for a take with frames of `width` x `height` pixels.

    JobError names the file, the lasso and its error.
    """
    try:
        data = read_json(path)
    except FileNotFoundError:
        raise JobError(f"{path} does not exist.", "Check the name of the file of lassos.", ExitCode.USAGE) from None
    rows = json_list(data.get("mattes", [data] if "polygon" in data else None))
    if not rows:
        raise JobError(f"{path} contains no lasso.", _FORM, ExitCode.USAGE)
    return [lasso_of(row, f"Lasso {n} of {path}", width, height) for n, row in enumerate(rows, 1)]


_FORM = 'Write {"mattes": [{"name": "a name", "frame": 1, "polygon": [[x, y], [x, y], [x, y]]}]}.'


def lasso_of(row: object, what: str, width: int, height: int) -> Lasso:
    """One lasso from JSON. JobError if it is invalid; `what` is its name in the message."""
    if not is_json_object(row):
        raise JobError(f"{what} is not a JSON object.", _FORM, ExitCode.USAGE)
    name, frame, polygon = row.get("name"), row.get("frame"), row.get("polygon")
    if not isinstance(name, str):
        raise JobError(f"{what} has no name.", _FORM, ExitCode.USAGE)
    checked_name(name, "matte")
    if not isinstance(frame, int) or isinstance(frame, bool):
        raise JobError(f"{what} has no valid frame: {frame!r} should be a whole number.", _FORM, ExitCode.USAGE)
    drawn = json_list(polygon)
    if not 3 <= len(drawn) <= MOST_CORNERS:
        raise JobError(f"{what} has no polygon of at least 3 corners.", _FORM, ExitCode.USAGE)
    scale = _scale(row, "width", width), _scale(row, "height", height)
    corners: list[tuple[float, float]] = []
    for corner in drawn:
        pair = [value for value in json_list(corner) if _is_number(value)]
        if len(pair) != 2 or len(json_list(corner)) != 2:
            raise JobError(f"{what} has a corner {corner!r} that is not [x, y] in pixels.", _FORM, ExitCode.USAGE)
        corners.append((float(pair[0]) * scale[0], float(pair[1]) * scale[1]))
    return Lasso(name, frame, tuple(corners))


def json_list(value: object) -> list[Any]:
    """`value`, read from JSON, if it is a list, else an empty list."""
    return cast(list[Any], value) if isinstance(value, list) else []


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e6


def _scale(row: Mapping[str, Any], name: str, size: int) -> float:
    """Pixels of the take's frames per pixel of the picture on which a lasso was drawn."""
    value = row.get(name)
    return size / value if _is_number(value) and value > 0 else 1.0
