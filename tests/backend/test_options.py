"""The one table of options: every option is heard, and what it says is what both command lines and the panel say."""

import argparse
import dataclasses

import pytest

from torch_backend import cli, contract
from torch_backend.contract import option_table

NEEDED = {"import": ("s.splannequin", "a.mp4"), "freeze": ("a.mp4",)}
"""What a command cannot do without."""


def cases():
    """(command, words, fields of kinds of jobs that the words are for) of every option of every command."""
    for command, kinds in contract.COMMANDS.items():
        found: dict[tuple[str, ...], list[str]] = {}
        for kind, cls in kinds.items():
            for one, told in option_table.options_of(cls):
                if told.flag.startswith("--") and (not told.commands or command in told.commands):
                    found.setdefault(words_for(one, told), []).append(f"{kind}.{one.name}")
        for words, fields in found.items():
            yield pytest.param(command, words, fields, id=f"{command} {words[0]}")


def words_for(one, told) -> tuple[str, ...]:
    """An option with a value that is not its default."""
    if told.turns_off:
        return (told.flag,)
    if told.choices:
        return told.flag, next(choice for choice in told.choices if choice != one.default)
    return told.flag, "48" if "str" not in str(one.type) else "word"


def fields_of(args: argparse.Namespace) -> dict[str, object]:
    asked = cli.asked(args).items()
    return {f"{kind}.{name}": value for kind, params in asked for name, value in dataclasses.asdict(params).items()}


@pytest.mark.parametrize(("command", "words", "fields"), list(cases()))
def test_every_option_changes_what_it_is_for_and_nothing_else(command, words, fields):
    bare = [command, *NEEDED.get(command, ("s.splannequin",))]
    before = fields_of(cli.parser().parse_args(bare))
    after = fields_of(cli.parser().parse_args([*bare, *words]))
    assert {name for name in before if before[name] != after[name]} == set(fields)
    for kind, params in cli.asked(cli.parser().parse_args([*bare, *words])).items():
        assert isinstance(params, contract.PARAMS[kind])


def test_what_is_asked_for_without_an_option_is_each_fields_default_but_for_finished_frames():
    for command in contract.COMMANDS:
        args = cli.parser().parse_args([command, *NEEDED.get(command, ("s.splannequin",))])
        for params in cli.asked(args).values():
            plain = dataclasses.asdict(type(params)())
            other = {name for name, value in plain.items() if value != getattr(params, name)} - {"source"}
            assert other == ({"only_missing"} if isinstance(params, contract.FreezeParams) else set())


def test_an_overscan_that_cannot_be_is_refused_in_its_own_words(capsys):
    with pytest.raises(SystemExit):
        cli.parser().parse_args(["take", "s.splannequin", "--overscan", "much"])
    assert "overscan is 0 to 100 percent, or lens, got 'much'" in capsys.readouterr().err


def test_every_option_says_what_it_does():
    for cls in contract.PARAMS.values():
        for one, told in option_table.options_of(cls):
            assert not told.flag or (told.help and told.help[-1] not in ".:"), one.name
            assert bool(told.label) == bool(told.tip), one.name
            assert not told.items or set(told.items) == set(told.choices), one.name
