"""Proofs that a test needs what it stands for: something is taken out of a copy of the code, and the test has to fail.

What is taken out is named by the symbol that it stands in and quoted from there, so that a proof outlives a move to
another file, a rename of the file, and another line break. `backend/raster/remedies.py` and `addon/complaints.py` are
made of these; both are run by hand, and the suite checks that what they quote is there. Standard library only.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

KERNELS = (".cpp", ".cu")


@dataclass(frozen=True)
class Change:
    """A text within a symbol, and what stands there without it."""

    package: str
    """Folder of the repository that the symbol is searched in, with all below it; or one file."""
    symbol: str
    """function, CONSTANT, Class, Class.method; kernel.cpp, or kernel.cpp::function for one within. Empty: the file."""
    old: str
    """The text, once in all that is called so. How it is broken into lines does not matter."""
    new: str
    """What stands there without it."""

    @property
    def pattern(self) -> re.Pattern[str]:
        """What finds the text."""
        return re.compile(r"\s+".join(re.escape(part) for part in self.old.split()))

    def made(self, root: Path, who: str, done: Mapping[Path, str] | None = None) -> tuple[Path, str]:
        """(file, its text with the change made). LookupError, in a sentence that begins with `who`, if it cannot be.

        Args:
            root: of the repository.
            who: what the change is for, in words.
            done: file -> text of it that other changes have made already.
        """
        base = root / self.package
        files = _files(base, self.symbol) if base.is_dir() else [base]
        texts = {path: (done or {}).get(path) or path.read_text(encoding="utf-8") for path in files}
        places = [(path, *span) for path, text in texts.items() for span in spans(path.suffix, text, self.symbol)]
        found = [(path, at.span()) for path, *span in places for at in self.pattern.finditer(texts[path], *span)]
        if len(found) == 1:
            path, (start, end) = found[0]
            return path, texts[path][:start] + self.new.strip() + texts[path][end:]
        where = " and ".join(sorted({path.relative_to(root).as_posix() for path, *_ in found or places}))
        if not places:
            raise LookupError(
                f"{who} looks into {self.symbol} of {self.package}, and nothing there is called so any more: name the "
                "function, class, constant or kernel that does it now"
            )
        missing = "which is not there any more: if the code does the same another way, quote that"
        often = f"which is there {len(found)} times: quote more of it, or name what it is in more closely"
        told = f"{self.old.strip()!r} in {self.symbol or 'all'} ({where})"
        raise LookupError(f"{who} looks for {told}, {often if found else missing}")


def _files(base: Path, symbol: str) -> list[Path]:
    name = symbol.partition("::")[0]
    return sorted(base.rglob(name if name.endswith(KERNELS) else "*.py"))


def spans(kind: str, text: str, symbol: str) -> Iterator[tuple[int, int]]:
    """(start, end) of every symbol of a name in a file's text, in characters; `kind`: how the file's name ends."""
    function = symbol.partition("::")[2]
    if not symbol or (kind in KERNELS and not function):
        yield 0, len(text)
        return
    if kind in KERNELS:
        yield from kernel_spans(text, function)
        return
    first, _, rest = symbol.partition(".")
    if first not in text:
        return
    starts = [0]
    for line in text.split("\n"):
        starts.append(starts[-1] + len(line) + 1)
    for node in _named(ast.parse(text).body, first):
        for found in _named(node.body, rest) if rest and isinstance(node, ast.ClassDef) else [node] * (not rest):
            above = getattr(found, "decorator_list", None) or [found]
            yield starts[above[0].lineno - 1], starts[found.end_lineno or found.lineno]


def _named(body: list[ast.stmt], name: str) -> Iterator[ast.stmt]:
    """Functions, classes and constants of a name among statements."""
    for node in body:
        targets = getattr(node, "targets", None) or [getattr(node, "target", None)]
        names = {part.id for t in targets if t is not None for part in ast.walk(t) if isinstance(part, ast.Name)}
        if getattr(node, "name", None) == name or (name in names and isinstance(node, (ast.Assign, ast.AnnAssign))):
            yield node


def kernel_spans(text: str, function: str) -> Iterator[tuple[int, int]]:
    """(start, end) of `auto FUNCTION = ... { ... };` in a kernel."""
    for begun in re.finditer(rf"\bauto {re.escape(function)} = ", text):
        depth = 0
        for at in range(begun.end(), len(text)):
            depth += {"{": 1, "}": -1}.get(text[at], 0)
            if depth == 0 and text[at] == "}":
                yield begun.start(), at + 1
                break
