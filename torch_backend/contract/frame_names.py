"""Finds frame numbers in file names, for footage, masks and cameras alike.

The frame number is the run of digits that varies between otherwise equal names. A version or a date is constant, so it
is not the frame number. A dash before a number is a separator, not a minus sign.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

_RUN = re.compile(r"[0-9]+")
_ENDING = re.compile(r"\.[A-Za-z][A-Za-z0-9]*$")
_MARK = re.compile(r"#+|@+|%0?[0-9]*d(?![A-Za-z])")
"""Placeholder of the number in a pattern: `####`, `@@@@`, `%04d`, `%d`."""
_WILDCARD = {"*": ".*", "?": "."}
_SAME_FORMAT = {".jpeg": ".jpg", ".tiff": ".tif"}
"""Alternative ending of a format -> its usual ending."""
Item = TypeVar("Item")


@dataclass(frozen=True)
class NumberedFiles:
    """Names that differ in their frame number."""

    pattern: str
    """Pattern as users write it, such as `shot_v2.####.exr`; `*` for other numbers that vary."""
    files: dict[int, str]
    """Frame number -> name, ascending."""
    twice: tuple[str, str] | None = None
    """Two names with the same number (`f_1.png`, `f_01.png`), if there are any."""
    has_second_number: bool = False
    """True if another number in the names varies too, such as a time."""


def numbered_files(names: Iterable[str]) -> list[NumberedFiles]:
    """The sequences among names, sorted by pattern. A single name can be a sequence.

    Names without digits are left out. If two numbers could be the frame number and order the names differently, the
    names are returned for both.
    """
    shapes = _grouped(names, lambda name: (ending(name), *_RUN.split(_stem(name))))
    found = [s for members in shapes for part in _by_exact_ending(members) for s in _sequences(part)]
    return sorted(found, key=lambda s: s.pattern)


def matching_files(names: Iterable[str], pattern: str) -> list[NumberedFiles]:
    """The sequences among names that match a pattern: `shot.####.exr`, `shot.%04d.png`, `*_left.jpg`.

    A placeholder matches a number of any width. `*` and `?` are wildcards. A pattern without a placeholder only filters
    names.
    """
    names, suffix = list(names), ending(pattern)
    stem = _stem(pattern)
    if suffix:
        names = [name for name in names if ending(name) == suffix]
    marks = list(_MARK.finditer(stem))
    if not marks:
        rule = re.compile(_rule(stem))
        return numbered_files(name for name in names if rule.fullmatch(_stem(name)))
    for wildcard in (None, "[0-9]+"):  # a second placeholder is literal (`take#2.####`), else a number
        for mark in reversed(marks):
            rule = _marked_rule(stem, marks, mark, wildcard)
            found = [(match, name) for name in names if (match := rule.fullmatch(_stem(name)))]
            if found:
                return _by_mark(found, pattern)
    return []


def is_pattern(name: str) -> bool:
    """True if a file name that does not exist may be a pattern."""
    return bool(_MARK.search(name)) or any(mark in name for mark in _WILDCARD)


def ending(name: str) -> str:
    """Lower-case ending of a name, with `.jpeg` as `.jpg` and `.tiff` as `.tif`; empty if it has none."""
    found = _ENDING.search(name)
    text = found[0].lower() if found else ""
    return _SAME_FORMAT.get(text, text)


def file_as_blender_counts(name: str, number: int) -> str:
    """File that Blender shows at frame `number` of the image sequence of the file `name`.

    Blender replaces the last digits before the ending, and keeps their width.
    """
    runs = list(_RUN.finditer(_stem(name)))
    if not runs:
        return name
    last = runs[-1]
    return f"{name[: last.start()]}{number:0{len(last[0])}d}{name[last.end() :]}"


def _stem(name: str) -> str:
    return _ENDING.sub("", name)


def _grouped(items: Iterable[Item], key: Callable[[Item], object]) -> list[list[Item]]:
    groups: dict[object, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return list(groups.values())


def _by_exact_ending(names: list[str]) -> list[list[str]]:
    """`names` as one group; grouped by exact ending if some names differ only in that (`f_1.jpg`, `f_1.JPG`)."""
    if len({_stem(name) for name in names}) == len(names):
        return [names]
    return _grouped(names, lambda name: name[len(_stem(name)) :])


def _sequences(names: list[str]) -> list[NumberedFiles]:
    """The sequences among names that differ only in their digits."""
    columns = list(zip(*([int(run) for run in _RUN.findall(_stem(name))] for name in names), strict=True))
    if not columns:
        return []
    varying = [n for n, column in enumerate(columns) if len(set(column)) > 1]
    telling = [n for n in varying if len(set(columns[n])) == len(names)]
    if telling:  # of an index and a time, take the index, which has the fewest gaps
        spans = [max(columns[n]) - min(columns[n]) for n in telling]
        closest = [n for n, span in zip(telling, spans, strict=True) if span == min(spans)]
        orders = {tuple(sorted(range(len(names)), key=columns[n].__getitem__)) for n in closest}
        places = closest if len(orders) > 1 else closest[-1:]
    else:  # several versions, eyes or cameras: the number that varies most is the frame
        places = [max(varying, key=lambda n: (len(set(columns[n])), n))] if varying else [len(columns) - 1]
    return [s for place in places for s in _counted(names, columns, place, telling)]


def _counted(names: list[str], columns: list[tuple[int, ...]], place: int, telling: list[int]) -> list[NumberedFiles]:
    """The sequences among names with the frame number in the column `place` of their numbers."""
    order = sorted(range(len(names)), key=columns[place].__getitem__)
    # A time or a date that rises or falls with the frame number does not split a sequence; a version does.
    parting = [
        n
        for n, column in enumerate(columns)
        if n != place and not (place in telling and (n in telling or _is_steady([column[i] for i in order])))
    ]
    groups = _grouped(order, lambda i: tuple(columns[n][i] for n in parting))
    return [_numbered([names[i] for i in rows], [columns[place][i] for i in rows], place) for rows in groups]


def _is_steady(values: Sequence[int]) -> bool:
    """True if values only rise or only fall."""
    return list(values) in (sorted(values), sorted(values, reverse=True))


def _numbered(names: list[str], numbers: list[int], place: int) -> NumberedFiles:
    runs = [_RUN.findall(_stem(name)) for name in names]
    texts = _RUN.split(_stem(names[0]))
    words: list[str] = []
    for n, column in enumerate(zip(*runs, strict=True)):
        widths = {len(run) for run in column}
        hashes = "#" * (min(widths) if len(widths) == 1 else 1)
        words += [texts[n], hashes if n == place else column[0] if len(set(column)) == 1 else "*"]
    pattern = "".join([*words, texts[-1]]) + names[0][len(_stem(names[0])) :]
    varies = any(len(set(column)) > 1 for n, column in enumerate(zip(*runs, strict=True)) if n != place)
    return NumberedFiles(pattern, *_table(names, numbers), has_second_number=varies)


def _table(names: list[str], numbers: list[int]) -> tuple[dict[int, str], tuple[str, str] | None]:
    """Number -> name, ascending, and two names with the same number, if there are any."""
    files: dict[int, str] = {}
    twice = None
    for number, name in sorted(zip(numbers, names, strict=True)):
        if number in files:
            twice = twice or (files[number], name)
        files.setdefault(number, name)
    return files, twice


def _rule(text: str) -> str:
    """Regular expression for a part of a pattern without placeholders."""
    return "".join(_WILDCARD.get(letter) or re.escape(letter) for letter in text)


def _marked_rule(stem: str, marks: list[re.Match[str]], number: re.Match[str], wildcard: str | None) -> re.Pattern[str]:
    """Regular expression for stems of names, with `number` as a group. `wildcard`: expression for the remaining
    placeholders, None: literal."""
    parts: list[str] = []
    at = 0
    for mark in marks:
        parts.append(_rule(stem[at : mark.start()]))
        parts.append("([0-9]+)" if mark is number else wildcard or re.escape(mark[0]))
        at = mark.end()
    return re.compile("".join([*parts, _rule(stem[at:])]))


def _by_mark(found: list[tuple[re.Match[str], str]], pattern: str) -> list[NumberedFiles]:
    """The sequences among names that match a pattern; several if different names have the same number."""
    groups = _grouped(found, lambda one: (one[0].string[: one[0].start(1)], one[0].string[one[0].end(1) :]))
    numbers = [int(match[1]) for match, _ in found]
    if len(groups) > 1 and len(set(numbers)) == len(numbers):
        return [NumberedFiles(pattern, *_table([name for _, name in found], numbers), has_second_number=True)]
    return [s for members in groups for s in _of_mark(members)]


def _of_mark(members: list[tuple[re.Match[str], str]]) -> list[NumberedFiles]:
    """The sequences among names that differ only in the number of the placeholder."""
    found: list[NumberedFiles] = []
    of_name = {name: match for match, name in members}
    for names in _by_exact_ending(list(of_name)):
        match = of_name[names[0]]
        widths = {len(of_name[name][1]) for name in names}
        hashes = "#" * (min(widths) if len(widths) == 1 else 1)
        shown = f"{names[0][: match.start(1)]}{hashes}{names[0][match.end(1) :]}"
        found.append(NumberedFiles(shown, *_table(names, [int(of_name[name][1]) for name in names])))
    return found
