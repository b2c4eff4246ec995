"""What the documents refer to is there, and the manual says what the buttons say."""

import ast
import re
from pathlib import Path

import pytest

from torch_backend.contract import BACKEND, BLENDER, COMMANDS, FRAME_LAYERS, VERBS, default_of, options_for

ROOT = Path(__file__).resolve().parent.parent
PAGES = [
    ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "CODE_OF_CONDUCT.md", "examples/README.md")
]
PAGES += sorted((ROOT / "docs").rglob("*.md"))
MANUAL = ROOT / "docs" / "manual"
GUIDE = ROOT / "docs" / "user-guide.md"
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
        for file, name in re.findall(r"`(?:([\w/]*test_\w+\.py)(?:::)?|::)?(test_\w+)?`", text_of(page)):
            assert not file or list((ROOT / "tests").rglob(Path(file).name)), f"{page.name}: {file}"
            assert f"def {name}" in tests, f"{page.name}: {name}"


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


def test_the_user_guide_says_which_command_line_has_which_verbs():
    row = re.search(r"^\| `\.venv/bin/python -m torch_backend VERB`[^|]*\|([^|]+)", text_of(GUIDE), re.MULTILINE)
    named = {name for name, verb in VERBS.items() if BLENDER in verb.sides}
    assert row and set(re.findall(r"`([a-z]+)`", row[1])) == named - {"bake"}
    assert all(BACKEND in VERBS[name].sides for name in named - {"bake"}) and BACKEND not in VERBS["bake"].sides


def test_the_layers_of_a_frame_in_the_manual_are_those_of_the_table():
    rows = [f"| `{one.shown}` | {one.stored} | {one.content} |" for one in FRAME_LAYERS]
    guide = text_of(ROOT / "docs" / "user-guide.md")
    assert "\n".join(f"  {row}" for row in rows) in guide, "put these rows into docs/user-guide.md:\n" + "\n".join(rows)
    assert f"Combined, Alpha, {', '.join(one.name for one in FRAME_LAYERS[1:])}." in guide
    page = text_of(MANUAL / "layers.md").split("## The freeze")[0]
    page = re.findall(r"^\| `([^`]+)` \| ([\w, ]+) \|", page, re.MULTILINE)
    assert dict(page) == {one.shown: "Combined, Alpha" if one.name == "Combined" else one.name for one in FRAME_LAYERS}
