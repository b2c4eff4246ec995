"""Writes docs/reference.md from the program's tables: commands, options, layers of a frozen frame.

    python3 tools/reference.py

Needs only the standard library. `tests/test_docs.py` fails if the page differs from the tables.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from launcher.main import COMMANDS as LAUNCHED  # noqa: E402
from torch_backend.contract import (  # noqa: E402
    BACKEND,
    BLENDER,
    FRAME_LAYERS,
    STEP_PARAMS,
    VERBS,
    default_of,
    options_for,
)

PAGE = ROOT / "docs" / "reference.md"
INTERNAL = ("farm-task", "run-job", "live")
"""Verbs that only programs start."""
SIDES = {BACKEND: "backend", BLENDER: "Blender"}
"""Names of the command lines in the reference, by side of the table of verbs."""


def text() -> str:
    """The whole page."""
    return "\n".join([*_INTRODUCTION, *_commands(), *_step_options(), *_command_options(), *_layers()]).rstrip() + "\n"


_INTRODUCTION = [
    "# Reference",
    "",
    "`python3 tools/reference.py` writes this page from the tables of the program: do not edit it. How to do things: "
    "[manual](manual/README.md).",
    "Files: [what comes out](manual/files.md). Exit codes: [troubleshooting](manual/troubleshooting.md#exit-codes).",
    "",
]


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table, and an empty line."""
    lines = [f"| {' | '.join(cells)} |" for cells in (head, *rows)]
    return [lines[0], "|---" * len(head) + "|", *lines[1:], ""]


def _escaped(words: str) -> str:
    """`words` with asterisks escaped for Markdown, as in t*."""
    return words.replace("*", "\\*")


def _commands() -> list[str]:
    """Table of the commands and the command lines that have them."""
    sides = {name: ["launcher"] for name in LAUNCHED}
    helps = dict(LAUNCHED)
    for name, verb in VERBS.items():
        if name not in INTERNAL and not verb.now:
            sides.setdefault(name, []).extend(SIDES[side] for side in verb.sides)
            helps.setdefault(name, verb.help)
    return [
        "## Commands",
        "",
        "How to start each command line: [without a window](manual/headless.md). `--help` after a command lists its "
        "options.",
        "",
        *_table(
            ("command", "does", "command lines"),
            ([f"`{name}`", _escaped(helps[name]), ", ".join(sides[name])] for name in sides),
        ),
    ]


def _rows(command: str, classes: Iterable[type]) -> Iterator[tuple[str, list[str]]]:
    """(flag, cells of its row) for each option of a command's dataclasses. Cells: option, meaning, default, panel."""
    for cls in classes:
        for one, spec in options_for(command, cls):
            if spec.flag.startswith("--"):
                default = default_of(one, spec)
                shown = f"`{default}`" if default and default == one.default else _escaped(default)
                name = f"`{spec.flag} {spec.metavar}`" if spec.metavar else f"`{spec.flag}`"
                label = f"*{_escaped(spec.label)}*" if spec.label else ""
                yield spec.flag, [name, _escaped(spec.help), "required" if spec.required else shown, label]


def _step_options() -> list[str]:
    """Table of the options of the four steps. An option of several steps is listed with the first."""
    rows: dict[str, list[str]] = {}
    for step, cls in STEP_PARAMS.items():
        for flag, cells in _rows(step, [cls]):
            rows.setdefault(flag, [f"`{step}`", *cells])
    return [
        "## Options of the steps",
        "",
        "`freeze CLIP` and `demo` have all but `--cameras` and `--extend`. `freeze SHOT` has those of `freeze`,",
        "and `--run` and `--device`; `--first`, `--last` and `--step` then say which frames are frozen.",
        "",
        *_table(("step", "option", "meaning", "default", "in the panel"), rows.values()),
    ]


def _command_options() -> list[str]:
    """Table of the options of all other commands, and of `freeze` and `farm` without the steps' options."""
    rows: list[list[str]] = []
    for name, verb in VERBS.items():
        if name not in INTERNAL and not verb.now:
            classes = [verb.words, *({} if verb.jobs.keys() & STEP_PARAMS.keys() else verb.jobs).values()]
            rows += [[f"`{name}`", *cells[:3]] for _, cells in _rows(name, classes)]
    return [
        "## Options of other commands",
        "",
        "`farm` and `freeze` have these besides those of the steps. The launcher's own are in its `--help`.",
        "",
        *_table(("command", "option", "meaning", "default"), rows),
    ]


def _layers() -> list[str]:
    """Table of the layers of a frozen frame."""
    rows = (
        (f"`{one.shown}`", "Combined, Alpha" if one.name == "Combined" else one.name, one.stored, _escaped(one.content))
        for one in FRAME_LAYERS
    )
    return [
        "## Layers of a frozen frame",
        "",
        "In `takes/NAME/NNNNNN.exr`. What each is good for: [layers](manual/layers.md).",
        "",
        *_table(("channels", "in Blender", "type", "content"), rows),
    ]


if __name__ == "__main__":
    PAGE.write_text(text(), encoding="utf-8")
    print(f"wrote {PAGE}")
