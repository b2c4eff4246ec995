"""What a proof quotes is found wherever it has moved, and what is gone is told with what to do."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent))

from proofs import Change  # pyright: ignore[reportMissingImports]

CODE = """import math

LIMIT, OTHER = 3, 4
TABLE: dict[str, int] = {
    "a": 1,
}


@property
def clamp(x: float) -> float:
    return min(
        x, LIMIT,
    )


class Session:
    def close(self) -> None:
        self.closed = clamp(1.0)

    def clamp(self) -> None:
        return min(self.x, LIMIT)
"""
KERNEL = """// A head.
auto near = FN(F v) -> I { if (v > 0) { return v < LIMIT; } return 0; };
auto far = FN(F v) -> I { return v < LIMIT; };
"""


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for folder in ("package/deep", "other"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "package" / "deep" / "moved.py").write_text(CODE)
    (tmp_path / "package" / "kernel.cpp").write_text(KERNEL)
    return tmp_path


def made(root: Path, symbol: str, old: str, new: str, package: str = "package") -> str:
    return Change(package, symbol, old, new).made(root, "the remedy 'x'")[1]


@pytest.mark.parametrize(
    ("symbol", "old", "new", "stands"),
    [
        ("clamp", "min(x, LIMIT", "max(x, LIMIT", None),  # broken into lines by a formatter, but for its brackets
        ("clamp", "x, LIMIT,", "x", "return min(\n        x\n    )"),
        ("clamp", "@property\n", "", "\n\n\ndef clamp"),
        ("Session.clamp", "min(self.x, LIMIT)", "self.x", "return self.x\n"),
        ("Session", "clamp(1.0)", "1.0", "self.closed = 1.0"),
        ("LIMIT", "3, 4", "5, 4", "LIMIT, OTHER = 5, 4"),
        ("TABLE", '"a": 1,', "", "TABLE: dict[str, int] = {\n    \n}"),
        (
            "kernel.cpp::near",
            "v < LIMIT",
            "1",
            "{ return 1; } return 0; };\nauto far = FN(F v) -> I { return v < L",
        ),
        ("kernel.cpp", "auto far = FN(F v)", "auto far = FN(F w)", "FN(F w)"),
    ],
)
def test_a_text_is_found_by_what_it_stands_in(root: Path, symbol: str, old: str, new: str, stands: str | None):
    if stands is None:
        with pytest.raises(LookupError, match="not there any more"):
            made(root, symbol, old, new)
    else:
        assert stands in made(root, symbol, old, new)


def test_another_line_break_and_another_file_do_not_matter(root: Path):
    (root / "package" / "deep" / "moved.py").rename(root / "package" / "elsewhere.py")
    assert "self.closed = 2" in made(root, "Session.close", "  self.closed\n =   clamp(1.0)\n", "self.closed = 2")


@pytest.mark.parametrize(
    ("symbol", "old", "told"),
    [
        ("clamp", "gone()", "the remedy 'x' looks for 'gone()' in clamp (package/deep/moved.py), which is not there "
         "any more: if the code does the same another way, quote that"),
        ("Session", "LIMIT)", ""),
        ("Session", "self.", "which is there 2 times: quote more of it"),
        ("gone", "x", "looks into gone of package, and nothing there is called so any more: name the function"),
        ("Session.gone", "x", "looks into Session.gone of package"),
        ("gone.cpp", "x", "looks into gone.cpp of package"),
        ("kernel.cpp::gone", "x", "looks into kernel.cpp::gone of package"),
        ("kernel.cpp", "v < LIMIT", "which is there 2 times"),
    ],
)  # fmt: skip
def test_what_is_gone_is_told_with_what_to_do(root: Path, symbol: str, old: str, told: str):
    if not told:
        assert made(root, symbol, old, "1)") != CODE
        return
    with pytest.raises(LookupError) as refused:
        made(root, symbol, old, "")
    assert told in str(refused.value)


def test_of_two_that_are_called_so_the_one_that_holds_the_text_is_meant(root: Path):
    (root / "package" / "second.py").write_text("def clamp():\n    return 7\n")
    assert made(root, "clamp", "return 7", "return 8") == "def clamp():\n    return 8\n"
    with pytest.raises(LookupError, match=r"moved\.py and package/second\.py\), which is there 2 times"):
        made(root, "clamp", "def clamp(", "")
    assert made(root, "clamp", "def clamp(", "def c(", "package/second.py").startswith("def c()")


def test_changes_are_made_on_top_of_each_other(root: Path):
    path, text = Change("package", "Session.close", "clamp(1.0)", "1.0").made(root, "x")
    again = Change("package", "Session.clamp", "min(self.x, LIMIT)", "self.x").made(root, "x", {path: text})[1]
    assert "self.closed = 1.0" in again and "return self.x\n" in again
