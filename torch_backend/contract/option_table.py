"""One table of options: what a field of a step's parameters is on a command line, in the reference and on the panel.

Each field that has a door carries an `Option` in its metadata. Both command lines (`command_line`), Blender's
properties and docs/reference.md are made from them, so an option is added in one place.
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
    """What a number among a job's parameters may be."""

    what: str
    """What a sentence calls it."""
    low: float
    """Least."""
    high: float
    """Most."""
    also: Mapping[int, str] = field(default_factory=dict[int, str])
    """Values outside of that which have a meaning -> what they are for."""


@dataclass(frozen=True)
class Option:
    """The doors of one field."""

    flag: str = ""
    """On a command line: --name, or a bare name for what stands without one. Empty: no command line has it."""
    help: str = ""
    """What it does, for --help and the reference; `default` below it is added there."""
    default: str = ""
    """The default in words, where its value says too little."""
    choices: tuple[str, ...] = ()
    """What it may be."""
    metavar: str | None = None
    """Placeholder of the value in --help and the reference: its unit or kind."""
    parse: Callable[[str], Any] | None = None
    """Text to value, ValueError on what cannot be; None: as the field's type."""
    switch: bool = False
    """The flag takes no value, and turns the field over: what is True without it is False with it."""
    many: bool = False
    """It takes one value or several, and is a list; what stands without a flag may be repeated."""
    is_path: bool = False
    """The value is a path, handed on as an absolute one; an address (with ://) as it is."""
    commands: tuple[str, ...] = ()
    """Only these commands have it; empty: all that ask for these parameters."""
    side: str = ""
    """Only the command line of this side has it (`verbs.BACKEND`, `verbs.BLENDER`); empty: both."""
    required: bool = False
    """A command cannot do without it."""
    heeded_with: tuple[str, tuple[Any, ...]] | None = None
    """(field, values): it says nothing unless that other field is one of these."""
    always: Any = None
    """What the command lines ask for without an option."""
    limit: Limit | None = None
    """What a number may be."""
    label: str = ""
    """Name on the panel; empty: the panel has it not, or in another form."""
    tip: str = ""
    """Tooltip on the panel."""
    items: Mapping[str, tuple[str, str]] = field(default_factory=dict[str, tuple[str, str]])
    """On the panel, of choices: value -> (name, tooltip), in the order that .blend files keep: new ones go last."""

    @property
    def dest(self) -> str:
        """Its name among parsed arguments."""
        return self.flag.lstrip("-").replace("-", "_")


def option(default: Any, *, words: str = "", **entries: Any) -> Any:
    """A dataclass field with an `Option` of the words in `entries`; `words` is its default in words."""
    return field(default=default, metadata={"option": Option(default=words, **entries)})


def options_of(cls: type) -> Iterator[tuple[dataclasses.Field[Any], Option]]:
    """Fields of a dataclass that have an `Option`, with it, in order."""
    for one in dataclasses.fields(cls):
        if "option" in one.metadata:
            yield one, one.metadata["option"]


def default_of(one: dataclasses.Field[Any], spec: Option) -> str:
    """The default of a field in words; empty if it says nothing."""
    if spec.default or one.default in (None, "") or spec.switch:
        return spec.default
    return f"{one.default:g}" if isinstance(one.default, float) else str(one.default)


def limits_of(cls: type) -> dict[str, Limit]:
    """Field -> what the number in it may be."""
    return {one.name: spec.limit for one, spec in options_of(cls) if spec.limit is not None}


def panel(cls: type, name: str, default: Any = None) -> dict[str, Any]:
    """What Blender's property of a field is made with: name, description, default, and items of a choice.

    Args:
        cls: dataclass of parameters.
        name: the field, which has a `label`.
        default: what the panel shows until it is set; None: the field's own default.
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
    """`FreezeParams.overscan` as a command line gives it: 0 to 100 percent, or "lens" (-1). ValueError on else."""
    try:
        value = -1.0 if text == "lens" else float(text)
    except ValueError:
        value = math.nan
    if text != "lens" and not 0.0 <= value <= 100.0:
        raise UserError(f"overscan is 0 to 100 percent, or lens, got {text!r}")
    return value


MASK_ALPHA = "alpha"
"""Of a mask: the alpha of the footage, in the place of a file."""


MASK_FOUND = "found"
"""Of the mask of what is ignored: what the import found to be burnt into the clip; nothing where it found nothing."""


def mask_path(text: str) -> str:
    """A mask as a command line gives it: an absolute path, `MASK_ALPHA`, or empty for none."""
    return "" if text == "none" else text if text in ("", MASK_ALPHA) else os.path.abspath(text)


def ignored_path(text: str) -> str:
    """The same, of what is ignored: that may be `MASK_FOUND`."""
    return text if text == MASK_FOUND else mask_path(text)


SWITCH = ("on", "off")
"""What `FreezeParams.detail` and `FreezeParams.develop` may be."""
