"""What the documents refer to is there, and their tables are those of the code."""

import re
from pathlib import Path

import pytest

from torch_backend.contract import COMMANDS, FRAME_LAYERS, default_of, options_for

ROOT = Path(__file__).resolve().parent.parent
PAGES = [
    ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "CODE_OF_CONDUCT.md", "examples/README.md")
]
PAGES += sorted((ROOT / "docs").rglob("*.md"))
MANUAL = ROOT / "docs" / "manual"


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def anchors(page: Path) -> set[str]:
    """As GitHub makes them from headings."""
    headings = re.findall(r"^#+ (.+)$", text_of(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_and_pictures_are_there(page: Path):
    broken = []
    for target in re.findall(r"\]\(([^)\s]+)\)", text_of(page)):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        if not file.exists() or (anchor and anchor not in anchors(file)):
            broken.append(target)
    assert not broken


def test_what_contributors_are_sent_to_is_there():
    """Every file and folder between backticks; `NAME` stands for the reader's own."""
    page = text_of(ROOT / "CONTRIBUTING.md")
    named = [word for word in re.findall(r"`([^`\n]+)`", page) if "NAME" not in word]
    paths = {word for word in named if re.fullmatch(r"[\w.-]+(/[\w.-]+)+/?|\w+\.(py|toml)", word)}
    run = re.findall(r"pytest -q (\S+)", page)
    assert len(paths) > 30 and len(run) == 4
    assert not sorted(path for path in {*paths, *run} if not (ROOT / path).exists())


def test_every_test_that_a_page_names_is_there():
    """`file.py::test`, `::test` of the file before it in the row, or `test` alone."""
    tests = "".join(text_of(path) for path in (ROOT / "tests").rglob("test_*.py"))
    for page in PAGES:
        for file, name in re.findall(
            r"`(?:([\w/]*test_\w+\.py)(?:::)?|::)?(test_\w+)?`", text_of(page).replace("test_NAME", "")
        ):
            assert not file or list((ROOT / "tests").rglob(Path(file).name)), f"{page.name}: {file}"
            assert f"def {name}" in tests, f"{page.name}: {name}"


def option_table(command: str) -> str:
    """The options of a command as the user guide's table."""
    rows = {}
    for cls in COMMANDS[command].values():
        for one, told in options_for(command, cls):
            if told.flag.startswith("--"):
                name = f"`{told.flag} {told.metavar}`" if told.metavar else f"`{told.flag}`"
                default = default_of(one, told)
                shown = f"`{default}`" if default and default == one.default else default
                rows.setdefault(told.flag, f"| {name} | {told.help} | {shown} |".replace("t*", "t\\*"))
    return "\n".join(["| option | what it does | default |", "|---|---|---|", *rows.values()])


def test_the_user_guides_options_are_those_of_the_command_line():
    table = option_table("freeze")
    assert table in text_of(ROOT / "docs" / "user-guide.md"), f"put this table into docs/user-guide.md:\n\n{table}\n"


def test_the_layers_of_a_frame_in_the_manual_are_those_of_the_table():
    rows = [f"| `{one.shown}` | {one.stored} | {one.content} |" for one in FRAME_LAYERS]
    guide = text_of(ROOT / "docs" / "user-guide.md")
    assert "\n".join(f"  {row}" for row in rows) in guide, "put these rows into docs/user-guide.md:\n" + "\n".join(rows)
    assert f"Combined, Alpha, {', '.join(one.name for one in FRAME_LAYERS[1:])}." in guide
    page = text_of(MANUAL / "layers.md").split("## The freeze")[0]
    page = re.findall(r"^\| `([^`]+)` \| ([\w, ]+) \|", page, re.MULTILINE)
    assert dict(page) == {one.shown: "Combined, Alpha" if one.name == "Combined" else one.name for one in FRAME_LAYERS}
