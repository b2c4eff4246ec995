"""References of the documents exist, and their tables equal those of the code."""

import re
from pathlib import Path

import pytest

from tools import reference
from torch_backend.contract import FRAME_LAYERS

ROOT = Path(__file__).resolve().parent.parent
PAGES = [
    ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "CODE_OF_CONDUCT.md", "examples/README.md")
]
PAGES += sorted((ROOT / "docs").rglob("*.md"))
MANUAL = ROOT / "docs" / "manual"
STEPS = ("import", "solve", "train", "freeze", "bake")
ROOMS = ("footage", "solve", "train", "freeze", "bake")


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub creates them."""
    headings = re.findall(r"^#+ (.+)$", text_of(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_and_pictures_exist(page: Path):
    broken = []
    for target in re.findall(r"\]\(([^)\s]+)\)", text_of(page)):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        if not file.exists() or (anchor and anchor not in anchors(file)):
            broken.append(target)
    assert not broken


def test_contributor_links_exist():
    """Every file and folder between backticks; `NAME` stands for the reader's own name."""
    page = text_of(ROOT / "CONTRIBUTING.md")
    named = [word for word in re.findall(r"`([^`\n]+)`", page) if "NAME" not in word]
    paths = {word for word in named if re.fullmatch(r"[\w.-]+(/[\w.-]+)+/?|\w+\.(py|toml)", word)}
    run = re.findall(r"pytest -q (\S+)", page)
    assert len(paths) > 30 and len(run) == 4
    assert not sorted(path for path in {*paths, *run} if not (ROOT / path).exists())


def test_every_documented_test_exists():
    """Notations: `file.py::test`, `::test` of the previous file in the row, or `test` alone."""
    tests = "".join(text_of(path) for path in (ROOT / "tests").rglob("test_*.py"))
    for page in PAGES:
        for file, name in re.findall(
            r"`(?:([\w/]*test_\w+\.py)(?:::)?|::)?(test_\w+)?`", text_of(page).replace("test_NAME", "")
        ):
            assert not file or list((ROOT / "tests").rglob(Path(file).name)), f"{page.name}: {file}"
            assert f"def {name}" in tests, f"{page.name}: {name}"


def test_reference_matches_the_option_tables():
    page = reference.PAGE.read_text(encoding="utf-8")
    assert page == reference.text(), "run `python3 tools/reference.py`"


def test_every_layer_of_a_frame_has_a_use_in_the_manual():
    page = text_of(MANUAL / "layers.md").split("## In another compositor")[0]
    page = re.findall(r"^\| `([^`]+)` \| ([\w, ]+) \|", page, re.MULTILINE)
    assert dict(page) == {one.shown: "Combined, Alpha" if one.name == "Combined" else one.name for one in FRAME_LAYERS}
