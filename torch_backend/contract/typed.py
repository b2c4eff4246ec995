"""Converts plain JSON to dataclasses, checked field by field, and checks versions of files."""

from __future__ import annotations

import dataclasses
import functools
import typing
from collections.abc import Mapping
from typing import Any

from .errors import UserError
from .files import printable

CONTRACT_VERSION = 1


def check_version(data: Mapping[str, Any], what: str, newest: int = CONTRACT_VERSION) -> None:
    """Raises ValueError if a newer Splannequin wrote `data`."""
    version = data.get("version", 1)
    if not isinstance(version, int) or version > newest:
        raise UserError(
            f"{what} has version {_short(version)}, this Splannequin reads up to {newest}: "
            "update the add-on and its backend"
        )


def from_dict(cls: type, data: Mapping[str, Any]) -> Any:
    """A dataclass from plain JSON. ValueError names an unknown or missing field, or a value of the wrong type."""
    hints = _hints(cls)
    unknown = set(data) - set(hints)
    if unknown:
        raise UserError(f"{cls.__name__} has no field {sorted(unknown)[0]!r}: it has {', '.join(hints)}")
    missing = _needed(cls) - set(data)
    if missing:
        raise UserError(f"{cls.__name__} has no {min(missing)}")
    values = {name: _checked(cls.__name__, name, hints[name], value) for name, value in data.items()}
    try:
        return cls(**values)
    except (TypeError, OverflowError) as error:
        raise UserError(f"{cls.__name__}: {error}") from error


@functools.cache
def _needed(cls: type) -> set[str]:
    """Fields that have no default."""
    none = dataclasses.MISSING
    return {f.name for f in dataclasses.fields(cls) if f.default is none and f.default_factory is none}


@functools.cache
def _hints(cls: type) -> dict[str, Any]:
    """Type hints of a class. Cached, because a camera path makes hundreds of frames on Blender's main thread."""
    return typing.get_type_hints(cls)


def _checked(owner: str, name: str, hint: Any, value: Any) -> Any:
    """`value` if it fits the annotation, else ValueError. An int may be a float; a bool is not a number."""
    accepted = typing.get_args(hint) if type(None) in typing.get_args(hint) else (hint,)
    for option in accepted:
        base = typing.get_origin(option) or option
        if base is Any or (base is type(None) and value is None):
            return value
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if base is float and number and abs(value) < _LARGEST_FLOAT:
            return float(value)
        if base is int:
            if number and isinstance(value, int) and abs(value) < _LARGEST_INT:
                return value
        elif base is not float and isinstance(base, type) and isinstance(value, base):
            return value
    raise UserError(f"{owner}.{name} cannot be {_short(value)}")


_LARGEST_FLOAT, _LARGEST_INT = 1e300, 1 << 53
"""Limits of numbers. Numbers that JSON cannot hold without loss, NaN and infinity are refused."""


def _short(value: Any) -> str:
    """Text of a value for an error message."""
    if isinstance(value, (list, dict)):
        return f"a {'list' if isinstance(value, list) else 'JSON object'}"
    if isinstance(value, int) and abs(value) >= _LARGEST_INT:
        return "a number that large"
    return repr(value if not isinstance(value, str) else printable(value, 80))
