"""Every module has a test file of its name, or a row in `where_tested.toml`: where it is tested, and why there."""

import ast
import functools
import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
TABLE = ROOT / "tests" / "where_tested.toml"
PARTS = {"torch_backend": "backend", "splannequin_addon": "addon", "launcher": "launcher", "benchmarks": "benchmarks"}
"""Folder of code -> the folder of tests that mirrors it."""


@dataclass(frozen=True)
class Row:
    """Where a module without a test file of its name is tested."""

    module: str
    """Path of the module from the root of the repository."""
    where: tuple[str, ...]
    """Test files; for what is only run by hand, the document that says how."""
    why: str
    """The reason of its group."""


def modules() -> Iterator[Path]:
    for folder in PARTS:
        found = [p.relative_to(ROOT) for p in sorted((ROOT / folder).rglob("*.py")) if p.name != "__init__.py"]
        assert found, f"{folder} holds no modules"
        yield from found
    yield Path("splannequin.py")


def rows() -> list[Row]:
    groups = tomllib.loads(TABLE.read_text(encoding="utf-8"))["group"]
    return [
        Row(module, (where,) if isinstance(where, str) else tuple(where), group["why"])
        for group in groups
        for module, where in group["modules"].items()
    ]


@functools.cache
def text_of(path: Path) -> str:
    """A test file and the conftest.py beside it, whose fixtures it may be all about."""
    beside = path.parent / "conftest.py"
    return "\n".join(p.read_text(encoding="utf-8") for p in dict.fromkeys((path, beside)) if p.is_file())


@functools.cache
def defined(module: Path) -> tuple[str, ...]:
    """Names at the top of a module that say something, and those that Blender knows it by; without any its own."""
    source = (ROOT / module).read_text(encoding="utf-8")
    names = {node.name for node in ast.parse(source).body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    names |= set(re.findall(r"^([A-Z][A-Z_0-9]+)(?:: .*)? = ", source, re.MULTILINE))
    shown = re.findall(r'bl_idname = "([^"]+)"', source)
    return (*(n for n in names if len(n) > 3), *shown) or (module.stem,)


def imports_it(text: str, module: Path) -> bool:
    """True if a test imports a module itself, or runs it by its name or its path."""
    dotted, stem = ".".join(module.with_suffix("").parts), module.stem
    package, inside = dotted.rpartition(".")[0], dotted.partition(".")[2]
    patterns = [
        rf"\b{re.escape(dotted)}\b",
        rf"\b{re.escape(module.as_posix())}\b",
        rf"\bfrom {re.escape(package)} import (\([^)]*|[^\n(]*)\b{stem}\b",
        rf"\baddon\(\"{re.escape(inside)}\"\)",
    ]
    if stem == "__main__":
        patterns.append(rf"\"{re.escape(package)}\"")
    return any(re.search(pattern, text) for pattern in patterns)


def reaches(test: Path, text: str, module: Path) -> bool:
    """True if a test is named after a module, imports it or its room, or says a name of it."""
    room, inside = ".".join(module.parent.parts), ".".join(module.parent.parts[1:])
    from_room = rf"\b(from|import) {re.escape(room)}\b|\baddon\(\"{re.escape(inside)}[.\"]"
    return (
        test.name == f"test_{module.stem}.py"
        or imports_it(text, module)
        or any(re.search(rf"\b{re.escape(name)}\b", text) for name in defined(module))
        or (bool(inside) and bool(re.search(from_room, text)))
    )


def own_test(module: Path) -> Path | None:
    """The test file that is named after a module: in the folder that mirrors its own, or one that imports it."""
    name = f"test_{module.stem}.py"
    mirrored = ROOT / "tests" / PARTS.get(module.parts[0], "") / Path(*module.parts[1:-1]) / name
    if mirrored.is_file():
        return mirrored
    return next((t for t in sorted((ROOT / "tests").rglob(name)) if imports_it(text_of(t), module)), None)


def test_every_module_has_a_test_file_of_its_name_or_a_reason():
    listed = {row.module for row in rows()}
    lost = [m.as_posix() for m in modules() if m.as_posix() not in listed and own_test(m) is None]
    assert not lost, f"write a test file of these names, or a row with a reason in {TABLE.name}"


def test_every_row_is_needed():
    there = {m.as_posix() for m in modules()}
    found = [row.module for row in rows()]
    assert [name for name in found if name not in there] == [], "no such module"
    assert [name for name in found if found.count(name) > 1] == [], "twice"
    assert [name for name in found if own_test(Path(name))] == [], "it has a test file of its name"


@pytest.mark.parametrize("row", rows(), ids=lambda row: row.module)
def test_what_a_row_names_says_something_of_its_module(row: Row):
    assert row.where and len(row.why.split()) > 3
    for where in row.where:
        path = ROOT / where
        assert path.is_file(), f"{where} is not there"
        assert path.name.startswith("test_") or row.module.startswith("benchmarks/"), f"{where} is no test"
        assert reaches(path, text_of(path), Path(row.module)), f"{where} says nothing of {row.module}"


@pytest.mark.parametrize(
    ("text", "direct", "at_all"),
    [
        ("from torch_backend.freeze.composite.grain import draw", True, True),
        ("from torch_backend.freeze.composite import fill, grain", True, True),
        ("from torch_backend.freeze.composite import (\n    fill,\n    grain,\n)", True, True),
        ("torch_backend/freeze/composite/grain.py", True, True),
        ("from torch_backend.freeze.composite import fill", False, True),
        ("the Brush of a grain", False, True),
        ("from torch_backend.freezer import grain", False, False),
        ("from torch_backend.train import run  # Brushes", False, False),
    ],
)
def test_what_counts_as_a_test_of_a_module(text: str, direct: bool, at_all: bool):
    module = Path("torch_backend/freeze/composite/grain.py")
    assert (imports_it(text, module), reaches(Path("test_take.py"), text, module)) == (direct, at_all)
