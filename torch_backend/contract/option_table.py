"""Options of the steps' parameters on the command lines, in the reference and on the panel.

Each field that users can set has an `Option` in its metadata. Both command lines (`command_line`), Blender's
properties and docs/reference.md are made from these, so that an option is added in one place.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from .errors import UserError


@dataclass(frozen=True)
class Limit:
    """Valid range of a number among a job's parameters."""

    what: str
    """Name of the number in messages."""
    low: float
    """Smallest valid value."""
    high: float
    """Largest valid value."""
    also: Mapping[int, str] = field(default_factory=dict[int, str])
    """Valid values outside the range -> their meaning."""


@dataclass(frozen=True)
class Option:
    """How users set one field, on a command line and on the panel."""

    flag: str = ""
    """Name on a command line: --name, or a bare name for a positional argument. Empty: on no command line."""
    help: str = ""
    """Description for --help and the reference, which append `default`."""
    default: str = ""
    """Description of the default, if its value does not explain itself."""
    choices: tuple[str, ...] = ()
    """Valid values; empty: any."""
    metavar: str | None = None
    """Placeholder of the value in --help and the reference: its unit or kind."""
    parse: Callable[[str], Any] | None = None
    """Converts text to a value, with ValueError on invalid text; None: conversion to the field's type."""
    switch: bool = False
    """True if the flag takes no value and inverts the field's default."""
    many: bool = False
    """True if the option takes one or more values, as a list."""
    is_path: bool = False
    """True if the value is a path, which is made absolute. An address (with ://) stays unchanged."""
    commands: tuple[str, ...] = ()
    """Verbs that have the option; empty: all verbs with these parameters."""
    side: str = ""
    """Side whose command line has the option (`verbs.BACKEND`, `verbs.BLENDER`); empty: both."""
    required: bool = False
    """True if the option must be passed."""
    effective_with: tuple[str, tuple[Any, ...]] | None = None
    """(field, values): the option has an effect only if that other field has one of these values."""
    always: Any = None
    """Value that the command lines always set, without an option."""
    limit: Limit | None = None
    """Valid range of a number."""
    label: str = ""
    """Name on the panel; empty: not on the panel, or in another form."""
    tip: str = ""
    """Tooltip on the panel."""
    items: Mapping[str, tuple[str, str]] = field(default_factory=dict[str, tuple[str, str]])
    """Choices on the panel: value -> (name, tooltip). .blend files store their position, so new ones go last."""

    @property
    def dest(self) -> str:
        """Name among parsed arguments."""
        return self.flag.lstrip("-").replace("-", "_")


def option(default: Any, *, words: str = "", **entries: Any) -> Any:
    """A dataclass field with an `Option` of these `entries`; `words` describes the default."""
    return field(default=default, metadata={"option": Option(default=words, **entries)})


def options_of(cls: type) -> Iterator[tuple[dataclasses.Field[Any], Option]]:
    """(field, `Option`) of each field of a dataclass that has one, in order."""
    for one in dataclasses.fields(cls):
        if "option" in one.metadata:
            yield one, one.metadata["option"]


def default_of(one: dataclasses.Field[Any], spec: Option) -> str:
    """Description of a field's default; empty if there is nothing to say."""
    if spec.default or one.default in (None, "") or spec.switch:
        return spec.default
    return f"{one.default:g}" if isinstance(one.default, float) else str(one.default)


def limits_of(cls: type) -> dict[str, Limit]:
    """Field -> `Limit` of its number."""
    return {one.name: spec.limit for one, spec in options_of(cls) if spec.limit is not None}


def panel(cls: type, name: str, default: Any = None) -> dict[str, Any]:
    """Keyword arguments of the Blender property for a field: name, description, default, and items of a choice.

    Args:
        cls: dataclass of parameters.
        name: a field with a `label`.
        default: default on the panel; None: the field's default.
    """
    one, spec = next((one, spec) for one, spec in options_of(cls) if one.name == name)
    words: dict[str, Any] = {"name": spec.label, "description": spec.tip}
    words["default"] = one.default if default is None else default
    if spec.items:
        words["items"] = [(value, *shown) for value, shown in spec.items.items()]
    elif spec.choices == SWITCH:
        words["default"] = one.default == SWITCH[0]
    return words


def overscan(text: str) -> float:
    """`FreezeParams.overscan` from an option's text: 0 to 100 percent, or "lens" (-1). ValueError on other text."""
    try:
        value = -1.0 if text == "lens" else float(text)
    except ValueError:
        value = math.nan
    if text != "lens" and not 0.0 <= value <= 100.0:
        raise UserError(f"overscan is 0 to 100 percent, or lens, got {text!r}")
    return value


MASK_ALPHA = "alpha"
"""Value of a mask option in place of a file: the alpha of the footage."""


MASK_FOUND = "found"
"""Value of the ignore mask option: what the import found to be burnt into the clip, if anything."""


def mask_path(text: str) -> str:
    """Mask from the text of an option: an absolute path, `MASK_ALPHA`, or empty for none."""
    return "" if text == "none" else text if text in ("", MASK_ALPHA) else os.path.abspath(text)


def ignored_path(text: str) -> str:
    """`mask_path` for the ignore mask, which may also be `MASK_FOUND`."""
    return text if text == MASK_FOUND else mask_path(text)


SWITCH = ("on", "off")
"""Values of `FreezeParams.detail` and `FreezeParams.develop`."""
