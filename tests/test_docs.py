"""What the documents refer to is there, and the manual says what the buttons say."""

import ast
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
    """Every file, folder and name of a test between backticks; `NAME` stands for the reader's own."""
    page = text_of(ROOT / "CONTRIBUTING.md")
    tests = "".join(text_of(path) for path in (ROOT / "tests").rglob("test_*.py"))
    named = [word for word in re.findall(r"`([^`\n]+)`", page) if "NAME" not in word]
    paths = {word for word in named if re.fullmatch(r"[\w.-]+(/[\w.-]+)+/?|\w+\.(py|toml)", word)}
    run = re.findall(r"pytest -q (\S+)", page)
    assert len(paths) > 30 and len(run) == 4
    assert not sorted(path for path in {*paths, *run} if not (ROOT / path).exists())
    assert not [word for word in named if word.startswith("test_") and f"def {word}(" not in tests]


def test_the_forge_runs_the_commands_of_the_readme():
    workflow = text_of(ROOT / ".github" / "workflows" / "two-commands.yml")
    commands = re.findall(r"^python3 (splannequin\.py .+)$", text_of(ROOT / "README.md"), re.MULTILINE)
    assert len(commands) == 2
    for command in commands:
        assert f"run: python {command.replace('CLIP.mp4', 'examples/sitting.mp4')}\n" in workflow
    for system in ("ubuntu", "windows", "macos"):
        assert f"{system}-latest" in workflow


def test_the_manual_has_a_page_per_step_with_its_picture_and_its_button():
    buttons = {}
    for room in ROOMS:
        tree = ast.parse(text_of(ROOT / "splannequin_addon" / room / "step.py"))
        step = next(n for n in tree.body if isinstance(n, ast.ClassDef) and ast.unparse(n.bases[0]) == "Step")
        told = {ast.unparse(n.targets[0]): n.value for n in step.body if isinstance(n, ast.Assign)}
        buttons[ast.literal_eval(told["name"])] = ast.literal_eval(told["button"])
    assert tuple(buttons) == STEPS
    index = text_of(MANUAL / "README.md")
    for number, step in enumerate(STEPS, 1):
        page = text_of(MANUAL / f"{step}.md")
        assert f"*{buttons[step]}*" in page and f"*{buttons[step]}*" in index
        assert f"window-{number}-{step}-done.jpg" in page
        assert f"({step}.md)" in index


def test_all_pages_of_the_manual_are_in_its_index():
    index = text_of(MANUAL / "README.md")
    assert all(f"({page.name})" in index for page in MANUAL.glob("*.md") if page.name != "README.md")


def test_what_the_manual_sets_in_italics_is_on_the_screen_or_in_a_message():
    """Labels are written *so*: a button that is renamed does not stay in the manual under its old name."""
    sources = "".join(text_of(p) for p in (ROOT / "splannequin_addon").rglob("*.py"))
    sources += "".join(text_of(p) for p in (ROOT / "torch_backend").rglob("*.py"))
    lost = []
    for page in MANUAL.glob("*.md"):
        for label in re.findall(r"(?<!\*)\*([^*\n]+)\*(?!\*)", text_of(page).replace("t\\*", "t\N{ASTERISK OPERATOR}")):
            plain = label.replace("\N{ASTERISK OPERATOR}", "*")
            if not plain.startswith(("Render >", "Splannequin")) and plain not in sources:
                lost.append(f"{page.name}: {plain}")
    assert not lost


def test_the_reference_is_made_of_the_tables():
    page = reference.PAGE.read_text(encoding="utf-8")
    assert page == reference.text(), "run `python3 tools/reference.py`"


def test_every_layer_of_a_frame_has_a_use_in_the_manual():
    page = text_of(MANUAL / "layers.md").split("## In another compositor")[0]
    page = re.findall(r"^\| `([^`]+)` \| ([\w, ]+) \|", page, re.MULTILINE)
    assert dict(page) == {one.shown: "Combined, Alpha" if one.name == "Combined" else one.name for one in FRAME_LAYERS}
