"""One table of options: what a field of a step's parameters is on a command line, in the manual and on the panel.

Each field that has a door carries an `Option` in its metadata. Both command lines, Blender's properties and the tables
of the manual are made from them, so an option is added in one place.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import typing
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Limit:
    """What a number among a job's parameters may be."""

    what: str
    """What a sentence calls it."""
    low: float
    """Least."""
    high: float
    """Most."""
    also: Mapping[int, str] = field(default_factory=dict)
    """Values outside of that which have a meaning -> what they are for."""


@dataclass(frozen=True)
class Option:
    """The doors of one field."""

    flag: str = ""
    """On a command line: --name, or a bare name for what stands without one. Empty: no command line has it."""
    help: str = ""
    """What it does, for --help and the manual; `default` below it is added there."""
    default: str = ""
    """The default in words, where its value says too little."""
    choices: tuple[str, ...] = ()
    """What it may be."""
    metavar: str | None = None
    """What --help and the manual write for the value, unit or kind."""
    parse: Callable[[str], Any] | None = None
    """Text to value, ValueError on what cannot be; None: as the field's type."""
    turns_off: bool = False
    """The flag takes no value, and sets the field to False."""
    is_path: bool = False
    """The value is a path, handed on as an absolute one; an address (with ://) as it is."""
    commands: tuple[str, ...] = ()
    """Only these commands have it; empty: all that ask for these parameters."""
    always: Any = None
    """What the command lines ask for without an option."""
    limit: Limit | None = None
    """What a number may be."""
    label: str = ""
    """Name on the panel; empty: the panel has it not, or in another form."""
    tip: str = ""
    """Tooltip on the panel."""
    items: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    """On the panel, of choices: value -> (name, tooltip), in the order that .blend files keep: new ones go last."""

    @property
    def dest(self) -> str:
        """Its name among parsed arguments."""
        return self.flag.lstrip("-").replace("-", "_")


def option(default: Any, *, words: str = "", **told: Any) -> Any:
    """A dataclass field with an `Option` of the words in `told`; `words` is its default in words."""
    return field(default=default, metadata={"option": Option(default=words, **told)})


def options_of(cls: type) -> Iterator[tuple[dataclasses.Field[Any], Option]]:
    """Fields of a dataclass that have an `Option`, with it, in order."""
    for one in dataclasses.fields(cls):
        if "option" in one.metadata:
            yield one, one.metadata["option"]


def default_of(one: dataclasses.Field[Any], told: Option) -> str:
    """The default of a field in words; empty if it says nothing."""
    if told.default or one.default in (None, "") or told.turns_off:
        return told.default
    return f"{one.default:g}" if isinstance(one.default, float) else str(one.default)


def limits_of(cls: type) -> dict[str, Limit]:
    """Field -> what the number in it may be."""
    return {one.name: told.limit for one, told in options_of(cls) if told.limit is not None}


def add_options(
    parser: argparse.ArgumentParser, kinds: Mapping[str, type], command: str, unset: Mapping[str, str] | None = None
) -> None:
    """Gives a command the options of some kinds of jobs; one that several of them have, once.

    Args:
        parser: of the command.
        kinds: kind of job -> dataclass of its parameters.
        command: its name.
        unset: field -> in words, what this command line takes for it where nothing is said; see `asked`.
    """
    there: set[str] = set()
    for cls in kinds.values():
        hints = typing.get_type_hints(cls)
        for one, told in options_of(cls):
            if not told.flag or told.flag in there or (told.commands and command not in told.commands):
                continue
            there.add(told.flag)
            if told.turns_off:
                parser.add_argument(told.flag, action="store_true", help=told.help)
                continue
            words: dict[str, Any] = {"help": told.help, "metavar": told.metavar, "choices": told.choices or None}
            if told.flag.startswith("--"):
                own = (unset or {}).get(one.name)
                words["default"] = one.default if own is None else ""
                default = own or default_of(one, told)
                words["help"] += f" (default: {default})" if default else ""
            parser.add_argument(told.flag, type=_parser_of(told, hints[one.name]), **words)


def asked(
    args: argparse.Namespace, kinds: Mapping[str, type], command: str, unset: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Kind of job -> its parameters, as the arguments of `add_options` ask for them.

    Args:
        args: parsed arguments.
        kinds: as they were given to `add_options`.
        command: its name.
        unset: field -> value where nothing was said of what `add_options` was given as `unset`.
    """
    found = {}
    for kind, cls in kinds.items():
        values = {}
        for one, told in options_of(cls):
            if told.always is not None:
                values[one.name] = told.always
            elif told.flag and (not told.commands or command in told.commands):
                value = getattr(args, told.dest)
                if told.turns_off:
                    value = not value
                elif told.is_path and value and "://" not in value:
                    value = str(Path(value).absolute())
                values[one.name] = (unset or {}).get(one.name, value) if value == "" else value
        found[kind] = cls(**values)
    return found


def _parser_of(told: Option, hint: Any) -> Callable[[str], Any]:
    """What makes a value of the text on a command line."""
    if told.parse is not None:
        return _in_words(told.parse)
    return next(kind for kind in (int, float, str) if kind is hint or kind in typing.get_args(hint))


def _in_words(parse: Callable[[str], Any]) -> Callable[[str], Any]:
    """argparse shows the sentence of one kind of error only."""

    def wrapped(text: str) -> Any:
        try:
            return parse(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return wrapped


def panel(cls: type, name: str, default: Any = None) -> dict[str, Any]:
    """What Blender's property of a field is made with: name, description, default, and items of a choice.

    Args:
        cls: dataclass of parameters.
        name: the field, which has a `label`.
        default: what the panel shows until it is set; None: the field's own default.
    """
    one, told = next((one, told) for one, told in options_of(cls) if one.name == name)
    words: dict[str, Any] = {"name": told.label, "description": told.tip}
    words["default"] = one.default if default is None else default
    if told.items:
        words["items"] = [(value, *shown) for value, shown in told.items.items()]
    elif told.choices == SWITCH:
        words["default"] = one.default == SWITCH[0]
    return words


def overscan(text: str) -> float:
    """`FreezeParams.overscan` as a command line gives it: 0 to 100 percent, or "lens" (-1). ValueError on else."""
    try:
        value = -1.0 if text == "lens" else float(text)
    except ValueError:
        value = math.nan
    if text != "lens" and not 0.0 <= value <= 100.0:
        raise ValueError(f"overscan is 0 to 100 percent, or lens, got {text!r}")
    return value


SWITCH = ("on", "off")
"""What `FreezeParams.detail` and `FreezeParams.develop` may be."""
