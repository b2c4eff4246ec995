"""Placement of a shot's solve in a scene: the similarity that transforms exported splats and cameras.

Blender writes the placement of the shot's root object into the shot folder when it starts a job. The backend, which
does not know Blender's scene, reads it. Without a placement, exports are upright in solve units (`Placement`'s
default).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .errors import UserError
from .files import SHORT_JSON, is_json_object, read_json
from .typed import CONTRACT_VERSION, check_version, from_dict

UPRIGHT = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
"""Row-major [4, 4]: the solve's axes (x right, y down, z forward) to Blender's (x right, y forward, z up)."""
TOLERANCE = 1e-4
"""Largest relative deviation from a similarity: Blender multiplies a few float32 matrices."""


@dataclass
class Placement:
    """Transform from a shot's solve to the scene into which everything is exported."""

    scene_from_solve: list[float] = field(default_factory=lambda: list(UPRIGHT))
    """16 floats, row-major: a similarity (rotation, one scale, translation) from solve units and axes to the scene's,
    z up."""
    metres_per_unit: float = 1.0
    """Length in metres of one unit of the scene."""
    solve: str = ""
    """`file_digest` of the cameras.json of the solve to which the placement applies; empty: any solve."""
    version: int = CONTRACT_VERSION
    """Version of this contract."""

    def __post_init__(self) -> None:
        matrix = self.scene_from_solve
        try:
            is_finite = all(math.isfinite(value) for value in matrix)
        except TypeError:  # `from_dict` does not check the items of lists
            is_finite = False
        if len(matrix) != 16 or not is_finite:
            raise UserError("The placement's scene_from_solve should be 16 finite numbers, a 4 x 4 matrix by rows.")
        rows = [matrix[0:3], matrix[4:7], matrix[8:11]]
        square = self.scale**2
        products = [sum(a * b for a, b in zip(rows[i], rows[j])) for i in range(3) for j in range(3)]
        ideal = [square if i == j else 0.0 for i in range(3) for j in range(3)]
        is_similar = all(abs(p - w) <= TOLERANCE * square for p, w in zip(products, ideal))
        if not (self.scale > 0.0 and is_similar and list(matrix[12:]) == [0.0, 0.0, 0.0, 1.0]):
            raise UserError(
                "The placement's scene_from_solve should only rotate, scale uniformly and move, but it mirrors, "
                "shears or flattens."
            )
        if not (math.isfinite(self.metres_per_unit) and self.metres_per_unit > 0.0):
            raise UserError(f"The placement's metres_per_unit is {self.metres_per_unit}: it should be above 0.")

    @property
    def scale(self) -> float:
        """Scene units per solve unit: the cube root of the determinant; below 0 if the matrix mirrors."""
        (a, b, c), (d, e, f), (g, h, i) = (self.scene_from_solve[n : n + 3] for n in (0, 4, 8))
        return math.cbrt(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g))

    def to_json(self) -> dict[str, Any]:
        """Plain types, for `json.dump`."""
        return dataclasses.asdict(self)

    @staticmethod
    def from_json(data: Mapping[str, Any]) -> Placement:
        """Inverse of `to_json`; ValueError on an unknown version, a wrong field or a matrix that is no similarity."""
        check_version(data, "placement")
        placement: Placement = from_dict(Placement, data)
        return placement

    @staticmethod
    def load(path: str | Path) -> Placement:
        """Reads a placement; FileNotFoundError or ValueError names the file."""
        data = read_json(path, SHORT_JSON)
        try:
            return Placement.from_json(data)
        except ValueError as error:
            raise UserError(f"{path} is not a placement: {error}") from error


def placement_of(facts: Mapping[str, Any]) -> Placement:
    """The placement with which a take's splats were exported, from its take.json.

    Takes of earlier versions have none: their splats are in the axes and units of the solve. ValueError if the entry
    is damaged.
    """
    placement = facts.get("placement")
    if placement is None:
        return Placement([float(row == column) for row in range(4) for column in range(4)])
    if not is_json_object(placement):
        raise UserError("The take's placement is damaged: freeze it again.")
    return Placement.from_json(placement)
