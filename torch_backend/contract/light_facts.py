"""Facts of a panorama of a take's light: takes/NAME/panorama/KEY.json next to KEY.exr. Both sides read them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from .errors import UserError
from .files import SHORT_JSON, read_json
from .identity import file_digest
from .placement import Placement
from .shot_folder import TakeFolder
from .typed import CONTRACT_VERSION, check_version, from_dict


@dataclass
class LightFacts:
    """A panorama: where it was rendered from, and how much of it is filled."""

    picture: str
    """`file_digest` of the panorama. The facts do not apply to a file with another digest."""
    position: list[float]
    """Point from which the panorama is rendered: x, y and z in the axes and units of Blender's scene."""
    filled: float
    """Share of the sphere's solid angle, 0 to 1, that no splat covers. This part is filled smoothly."""
    placement: dict[str, Any] = field(default_factory=dict[str, Any])
    """The `Placement` of the solve in that scene. The panorama's directions are in the scene's axes."""
    version: int = CONTRACT_VERSION
    """Version of this contract."""

    def __post_init__(self) -> None:
        if len(self.position) != 3 or not all(is_place(value) for value in self.position):
            raise UserError("position should be three finite numbers")
        if not 0.0 <= self.filled <= 1.0:
            raise UserError(f"filled is {self.filled}: it should be 0 to 1")
        Placement.from_json(self.placement)

    def to_json(self) -> dict[str, Any]:
        """Plain types, for `json.dump`."""
        return dataclasses.asdict(self)

    @staticmethod
    def from_json(data: Mapping[str, Any]) -> LightFacts:
        """Inverse of `to_json`; ValueError on an unknown version or a wrong field."""
        check_version(data, "light")
        facts: LightFacts = from_dict(LightFacts, data)
        return facts


def light_of_take(take: TakeFolder, key: str) -> LightFacts | None:
    """Facts of the take's panorama with this key; None if the JSON or the EXR is missing, damaged, or
    they do not match."""
    try:
        facts = LightFacts.from_json(read_json(take.light_facts(key), SHORT_JSON))
        return facts if facts.picture == file_digest(take.light(key)) else None
    except (OSError, ValueError):
        return None


def point_of(text: str) -> tuple[float, float, float]:
    """The point in a text X,Y,Z. ValueError if the text is not a point."""
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not all(is_place(value) for value in (x, y, z)):
        raise UserError(f"The position is {text!r}: it should be three numbers, X,Y,Z.")
    return x, y, z


def point_text(text: str) -> str:
    """`text` unchanged, if it is a point. ValueError as `point_of`."""
    point_of(text)
    return text


def is_place(value: object) -> bool:
    """True for a float whose square fits single precision."""
    return isinstance(value, float) and abs(value) < 1e15
