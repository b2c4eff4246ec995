"""Builds both command lines, the backend's and Blender's, from the table of verbs: a verb has the same options."""

from __future__ import annotations

import argparse
import typing
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from .errors import ExitCode, JobError
from .option_table import Option, default_of, options_of
from .shot_folder import INFO_FILE, SHOT_SUFFIX
from .take_options import FreezeParams
from .train_options import TrainParams
from .verbs import VERBS, Verb

CODES = "exit codes: " + ", ".join(f"{code.value} {code.name.lower()}" for code in ExitCode)
_JSON = "print events as JSON lines instead of text"


def command_line(
    prog: str, side: str, unset: Mapping[str, str] | None = None
) -> tuple[argparse.ArgumentParser, dict[str, argparse.ArgumentParser]]:
    """Argument parser of one side's command line, and the parsers of its verbs.

    Args:
        prog: name of the program, for help texts.
        side: `verbs.BACKEND` or `verbs.BLENDER`.
        unset: field -> description of this side's default. If the option is not passed, its value is "", which
            `requested_params` replaces.
    """
    top = argparse.ArgumentParser(
        prog=prog, description="Freeze time in a handheld clip of people holding still.", epilog=CODES
    )
    top.add_argument("--json", action="store_true", dest="json_before", help=_JSON)
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    parsers: dict[str, argparse.ArgumentParser] = {}
    for name, verb in VERBS.items():
        if side not in verb.sides:
            continue
        text = verb.help if not verb.now else f"old name of {verb.help}"
        one = parsers[name] = commands.add_parser(name, help=text, description=text, epilog=CODES)
        one.add_argument("--json", action="store_true", help=_JSON if verb.json else argparse.SUPPRESS)
        _add_options(one, name, verb, side, unset or {})
    return top, parsers


def as_json(args: argparse.Namespace) -> bool:
    """True if --json was passed, before or after the verb."""
    return bool(args.json or args.json_before)


class _Noted(argparse.Action):
    """Stores a value or turns a switch, and notes in `said` that the option was passed and is not a default."""

    def __call__(
        self, parser: Any, namespace: argparse.Namespace, values: Any, option_string: str | None = None
    ) -> None:
        setattr(namespace, self.dest, True if self.nargs == 0 else values)
        if option_string is not None:
            namespace.explicit = {**getattr(namespace, "explicit", {}), self.dest: self.option_strings[0]}


def options_for(name: str, cls: type, side: str = "") -> list[tuple[Any, Option]]:
    """(field, option) pairs of a dataclass that a verb has on one side's command line; `side` empty: on any."""
    return [
        (one, spec)
        for one, spec in options_of(cls)
        if spec.flag and (not spec.commands or name in spec.commands) and (not side or spec.side in ("", side))
    ]


def _add_options(parser: argparse.ArgumentParser, name: str, verb: Verb, side: str, unset: Mapping[str, str]) -> None:
    """Adds the options of a verb to its parser. An option that several dataclasses have is added once."""
    added: set[str] = set()
    for cls in (verb.words, *verb.jobs.values()):
        hints = typing.get_type_hints(cls)
        for one, spec in options_for(name, cls, side):
            if spec.flag in added:
                continue
            added.add(spec.flag)
            words: dict[str, Any] = {"action": _Noted, "help": spec.help}
            if spec.switch:
                parser.add_argument(spec.flag, nargs=0, default=False, required=False, **words)
                continue
            words.update(metavar=spec.metavar, choices=spec.choices or None)
            if one.name in verb.shown:
                words["metavar"], words["help"] = verb.shown[one.name]
            if spec.many:
                words["nargs"] = "+"
            if spec.flag.startswith("--"):
                fallback = unset.get(one.name)
                words["required"] = spec.required
                words["default"] = (None if spec.required else one.default) if fallback is None else ""
                default = fallback or default_of(one, spec)
                words["help"] += f" (default: {default})" if default else ""
            parser.add_argument(spec.flag, type=_parser_of(spec, hints[one.name]), **words)


def requested_params(args: argparse.Namespace, unset: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Parameters that parsed arguments request, by kind of job; empty for a verb that starts no job.

    Args:
        args: parsed by a `command_line`.
        unset: field -> value if the option was not passed, for fields in `unset` of `command_line`.

    Raises:
        JobError: an option does not apply to the input of the verb.
    """
    name = args.command
    kinds = VERBS[name].jobs
    if freezes_a_shot(args):
        _refuse_clip_options(args)
        ranges = {name: getattr(args, name) for name in _RANGE if name in getattr(args, "explicit", {})}
        return {"freeze": FreezeParams(**{**_values(args, name, FreezeParams, unset or {}), **ranges})}
    return {kind: cls(**_values(args, name, cls, unset or {})) for kind, cls in kinds.items()}


def _values(args: argparse.Namespace, name: str, cls: type, unset: Mapping[str, Any]) -> dict[str, Any]:
    """Field -> value of a dataclass, from parsed arguments."""
    values = {one.name: spec.always for one, spec in options_of(cls) if spec.always is not None}
    for one, spec in options_for(name, cls):
        value = getattr(args, spec.dest)
        if spec.switch:
            value = one.default != value
        elif spec.is_path:
            value = [_absolute(item) for item in value] if spec.many else _absolute(value)
        values[one.name] = unset.get(one.name, value) if value == "" else value
    return values


def _absolute(path: str) -> str:
    """`path` as an absolute path. An address (with ://) and an empty text stay unchanged."""
    return path if not path or "://" in path else str(Path(path).absolute())


def words_of(args: argparse.Namespace) -> Any:
    """Arguments of a verb besides the parameters of its jobs: an object of its `words`, from parsed arguments."""
    verb = VERBS[args.command]
    return verb.words(**_values(args, args.command, verb.words, {}))


def arguments_of(words: Any) -> list[str]:
    """Inverse of `words_of`: command-line arguments for an object of a verb's `words`, without the verb's name."""
    found: list[str] = []
    for one, spec in options_of(words.__class__):
        value: Any = getattr(words, one.name)
        if not spec.flag.startswith("--"):
            found += [str(item) for item in (value if spec.many else (value,))]
        elif value != one.default and value is not None:
            found.append(spec.flag if spec.switch else f"{spec.flag}={value}")
    return found


def is_shot(path: str | Path) -> bool:
    """True for a shot folder, or a path with its suffix. Any other folder may hold the pictures of a clip."""
    place = Path(path)
    return place.suffix == SHOT_SUFFIX or (place / INFO_FILE).is_file()


def freezes_a_shot(args: argparse.Namespace) -> bool:
    """True for `freeze SHOT`, which runs one step only; False for `freeze CLIP` and every other verb."""
    return args.command == "freeze" and "://" not in args.clip and is_shot(args.clip)


_RANGE = ("first", "last", "step")
"""Options of the frame range: frames to read of a clip, or frames to freeze of a shot."""


def _refuse_clip_options(args: argparse.Namespace) -> None:
    """Raises JobError if `freeze SHOT` has options that only apply to earlier steps."""
    known = {*_RANGE, *(spec.dest for _, spec in options_for("freeze", FreezeParams))}
    lost = {dest: flag for dest, flag in getattr(args, "explicit", {}).items() if dest not in known}
    if lost:
        verb, it = ("is", "it") if len(lost) == 1 else ("are", "them")
        steps = [name for name in ("import", "solve", "train") if lost.keys() & _dests_of(name)]
        raise JobError(
            f"{_listed([*lost.values()])} {verb} for a clip, but {args.clip} is a shot folder, which only runs the "
            "freeze.",
            f"Leave {it} out" + (f", or pass {it} to {_listed([f'`{name}`' for name in steps])}." if steps else "."),
            ExitCode.USAGE,
        )


def _dests_of(name: str) -> set[str]:
    """Names, among parsed arguments, of the options for the jobs of a verb."""
    return {spec.dest for cls in VERBS[name].jobs.values() for _, spec in options_for(name, cls)}


def trains_anew(args: argparse.Namespace) -> bool:
    """True if an option was passed that only applies to training, so that a finished run is not enough."""
    dests = {spec.dest for _, spec in options_for(args.command, TrainParams)} - {"run", "device"}
    return bool(dests & set(getattr(args, "explicit", {})))


def notes(args: argparse.Namespace) -> list[str]:
    """Notes on options without effect, and on a deprecated verb."""
    verb, explicit = VERBS[args.command], getattr(args, "explicit", {})
    found: list[str] = []
    if verb.now:
        found.append(f"`{args.command} SHOT` is now called `{verb.now} SHOT`. The next version removes the old name.")
    for cls in (verb.words, *verb.jobs.values()):
        dests = {one.name: spec.dest for one, spec in options_for(args.command, cls)}
        for one, spec in options_for(args.command, cls):
            if spec.effective_with is None or dests[one.name] not in explicit:
                continue
            field, values = spec.effective_with
            if getattr(args, dests[field]) not in values:
                required = _listed([f"--{field.replace('_', '-')} {value}" for value in values])
                found.append(f"{spec.flag} is ignored: it only works with {required}.")
    if "extend" in explicit:
        lost = [flag for dest, flag in explicit.items() if dest not in ("extend", "run", "device")]
        if lost:
            found.append(f"{_listed(lost)}: ignored with --extend, because a finished run keeps its settings.")
    return found


def _listed(words: Sequence[str]) -> str:
    """["a", "b", "c"] as "a, b and c"."""
    return " and ".join(filter(None, (", ".join(words[:-1]), words[-1])))


def _parser_of(spec: Option, hint: Any) -> Callable[[str], Any]:
    """Function that converts the text of an option to its value."""
    if spec.parse is not None:
        return _in_words(spec.parse)
    return next(kind for kind in (int, float, str) if kind is hint or kind in typing.get_args(hint))


def _in_words(parse: Callable[[str], Any]) -> Callable[[str], Any]:
    """`parse` with its ValueError as an ArgumentTypeError, the only error whose message argparse shows."""

    def wrapped(text: str) -> Any:
        try:
            return parse(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return wrapped
