"""Every text that the add-on shows is translated in every shipped language, and no other text is."""

import ast
import functools
import re
from collections.abc import Iterator
from pathlib import Path

import bpy
import pytest

NOT_ON_SCREEN = {"console.py", "headless.py", "cli.py", "run_in_bpy.py"}
"""Modules that print to a console, in English."""
NOT_SHOWN = {
    "Splannequin",  # a name
    "Splannequin Freeze",  # name of the node group, equal in every file
    "t*",
    "",
}
SHOWN_ARGUMENTS = {"text", "heading", "title", "message", "confirm_text"}
"""Keyword arguments that are drawn, in any call."""
SHOWN_POSITIONS = {
    "tr": (0,), "wrap": (2,), "sub_panel": (2,), "report": (1,), "poll_message_set": (0,), "JobError": (0, 1),
    "Step": (1, 3, 4, 5), "View": (2, 3),
}  # fmt: skip
"""Positions of drawn arguments, by name of the call."""
TRANSLATED_BY_BLENDER = {"label", "operator", "prop", "row", "column", "split", "progress", "report"}
"""Calls that translate a literal by themselves, but no composed text."""
A_SENTENCE = re.compile(r"[A-Z{][^\n]* [^\n]*([.]|: \{\})")


@functools.cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def strings(node: ast.AST) -> Iterator[str]:
    """Texts that an expression may evaluate to; each inserted value is written as {}."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node.value
    elif isinstance(node, ast.JoinedStr):
        yield "".join(part.value if isinstance(part, ast.Constant) else "{}" for part in node.values)
    elif isinstance(node, ast.IfExp):
        yield from strings(node.body)
        yield from strings(node.orelse)
    elif isinstance(node, ast.BoolOp):
        for value in node.values:
            yield from strings(value)
    elif isinstance(node, ast.List | ast.Tuple):
        for value in node.elts:
            yield from strings(value)


def called(node: ast.Call) -> str:
    return ast.unparse(node.func).rpartition(".")[2]


def bare(tree: ast.AST) -> set[int]:
    """Ids of the nodes of docstrings and of the parts of f-strings, which are not texts by themselves."""
    inside = [part for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in ast.walk(node)]
    docs = [node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)]
    return {id(part) for part in [*inside, *docs] if not isinstance(part, ast.JoinedStr)}


def shown_by(path: Path) -> Iterator[tuple[str, int]]:
    """(text, line) of each text that a module shows: arguments of drawing calls, and all sentences in its source."""
    tree = parsed(path)
    skip = bare(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            drawn = [node.args[n] for n in SHOWN_POSITIONS.get(called(node), ()) if n < len(node.args)]
            drawn += [k.value for k in node.keywords if k.arg in SHOWN_ARGUMENTS]
            for value in drawn:
                yield from ((text, node.lineno) for text in strings(value))
        elif isinstance(node, ast.Constant | ast.JoinedStr) and id(node) not in skip:
            everything = path.name == "panel.py"
            for text in map(str.strip, strings(node)):
                if A_SENTENCE.fullmatch(text) or (everything and " " in text):
                    yield text, node.lineno


def worth_translating(text: str) -> bool:
    """False for texts without a word, and for names."""
    return text not in NOT_SHOWN and re.search(r"[A-Za-z]{2}", text.replace("{}", "")) is not None


def classes() -> list[type]:
    kinds = (bpy.types.Operator, bpy.types.Panel, bpy.types.Menu, bpy.types.PropertyGroup)
    kinds += (bpy.types.AddonPreferences, bpy.types.FileHandler)
    return [
        c for kind in kinds for c in kind.__subclasses__()
        if c.__module__.startswith("bl_ext.user_default.splannequin") and c.is_registered
    ]  # fmt: skip


def registered() -> Iterator[tuple[str, str]]:
    """(text, where) of registered labels, tooltips, properties and choices."""
    for cls in classes():
        for text in (getattr(cls, "bl_label", ""), getattr(cls, "bl_description", "")):
            yield text, cls.__name__
        known = cls.bl_rna
        if issubclass(cls, bpy.types.Operator):
            known = getattr(bpy.ops.splannequin, cls.bl_idname.partition(".")[2]).get_rna_type()
        base = {p.identifier for p in known.base.properties} | {"name", "rna_type"}
        for prop in known.properties:
            if prop.identifier in base:
                continue
            yield from ((text, f"{cls.__name__}.{prop.identifier}") for text in (prop.name, prop.description))
            for item in getattr(prop, "enum_items", ()):
                yield from ((text, f"{cls.__name__}.{prop.identifier}") for text in (item.name, item.description))


def sources(root: Path) -> list[Path]:
    """Source files of the add-on without its translations."""
    return [p for p in sorted((root / "splannequin_addon").rglob("*.py")) if p.parent.name != "translations"]


@pytest.fixture
def shown(package, root) -> dict[str, str]:
    """Map from each shown text to its place."""
    found: dict[str, str] = {}
    for path in sources(root):
        if path.name not in NOT_ON_SCREEN:
            for text, line in shown_by(path):
                found.setdefault(text, f"{path.name}:{line}")
    for text, where in registered():
        found.setdefault(text, where)
    return {text: where for text, where in found.items() if worth_translating(text)}


def written(root: Path) -> set[str]:
    """All texts in the sources, and the backend's stages as the panel shows them."""
    found: set[str] = set()
    for path in [*(root / "torch_backend").rglob("*.py"), *sources(root)]:
        for node in ast.walk(parsed(path)):
            found.update(map(str.strip, strings(node)))
    return found | {text[:1].upper() + text[1:] for text in found}


def languages(addon) -> dict[str, dict[str, str]]:
    return dict(addon("translations").LANGUAGES)


def test_every_language_has_what_is_shown_and_nothing_else(addon, shown, root):
    in_source = written(root)
    for locale, messages in languages(addon).items():
        missing = "\n".join(f"    {text!r}: {''!r},  # {shown[text]}" for text in shown if text not in messages)
        assert not missing, f"paste into splannequin_addon/translations/{locale}.py and translate:\n{missing}\n"
        extra = "\n".join(repr(text) for text in messages if text not in shown and text not in in_source)
        assert not extra, f"nothing shows these any more, take them out of translations/{locale}.py:\n{extra}\n"


def test_translations_are_filled_in_and_have_the_fields_of_the_original(addon):
    for messages in languages(addon).values():
        for text, said in messages.items():
            assert said.strip() == said and said, text
            fields = re.findall(r"\{(\d*)(?:![tl])?\}", said)
            count = text.count("{}")
            assert said.count("{") == len(fields), text
            assert fields in ([""] * count, sorted(fields)) or set(fields) == {str(n) for n in range(count)}, text
            assert len(fields) == count, text
            assert (text[-1] in ".:?!") == (said[-1] in ".:?!") or text[-1] == "}", text


def test_what_is_composed_is_not_left_to_blender_to_look_up(root):
    """A label translates "Import Clip" by itself, but not "74 frames": f-strings must use tr()."""
    wrong = []
    for path in sources(root):
        if path.name in NOT_ON_SCREEN:
            continue
        for node in ast.walk(parsed(path)):
            if not isinstance(node, ast.Call) or called(node) not in TRANSLATED_BY_BLENDER | {"poll_message_set"}:
                continue
            drawn = [k.value for k in node.keywords if k.arg in SHOWN_ARGUMENTS]
            drawn += [node.args[n] for n in SHOWN_POSITIONS.get(called(node), ()) if n < len(node.args)]
            composed = any(isinstance(part, ast.JoinedStr) for value in drawn for part in [value])
            if composed or (called(node) == "poll_message_set" and isinstance(drawn[0], ast.Constant)):
                wrong.append(f"{path.name}:{node.lineno}: {ast.unparse(node)}")
    assert not wrong, "write tr(...) around these texts:\n" + "\n".join(wrong)


def test_composed_sentences_are_translated_with_their_values(addon):
    said = addon("translations").translate
    german = [
        ("Import Clip", "Clip importieren"),
        ("74 frames, 1 to 74", "74 Bilder, 1 bis 74"),
        ("Run main: no held-out frames", "Lauf main: keine Bilder zurückgehalten"),
        ("Run main: 24.1 dB on held-out frames", "Lauf main: 24.1 dB auf zurückgehaltenen Bildern"),
        ("Solve: features 12 %", "Kameralösung: Merkmale 12 %"),
        ("Good: 40 of 41 frames registered, 0.52 px.", "Gut: 40 von 41 Bildern gelöst, 0.52 px."),
        (
            "Cannot write to /a b: Permission denied. Choose another shot folder.",
            "In /a b kann nicht geschrieben werden: Permission denied. Einen anderen Shot-Ordner wählen.",
        ),
        (
            "Read as 640 x 480, square pixels, 10 fps, 8 bits, video, Rec.709, matrix BT.601, full levels, no alpha.",
            "Gelesen als 640 x 480, quadratische Pixel, 10 Bilder/s, 8 Bit, Video, Rec.709, Matrix BT.601, "
            "Pegel: voll, kein Alpha.",
        ),
        (
            "Assumed, because the footage does not state it: pixel aspect, colour space, levels.",
            "Angenommen, denn das Material sagt es nicht: Pixelseitenverhältnis, Farbraum, Pegel.",
        ),
        ("An unknown sentence. Choose another shot folder.", "An unknown sentence. Einen anderen Shot-Ordner wählen."),
        ("The run {0} is called {1!t}.", "The run {0} is called {1!t}."),
        ("", ""),
    ]
    for english, expected in german:
        assert said(english, "de_DE") == expected
        assert said(english, "en_US") == english


def test_names_of_the_artist_are_no_words_to_translate(addon):
    said = addon("translations").translate
    assert said("Take Freeze: 3 frames, 16 x 12", "de_DE") == "Take Freeze: 3 Bilder, 16 x 12"
    assert said("Camera is the scene's camera, with the plate behind it.", "de_DE").startswith("Camera ist die Kamera")


def test_blender_shows_german_when_its_language_is_german(addon):
    tr, view = addon("translations").tr, bpy.context.preferences.view
    if "de_DE" not in bpy.app.translations.locales:
        pytest.skip("this bpy has no languages: checked inside a real Blender (.ci/blender_tests.py)")
    before = view.language, view.use_translate_interface, view.use_translate_tooltips
    try:
        view.language, view.use_translate_interface, view.use_translate_tooltips = "de_DE", True, True
        look_up = bpy.app.translations.pgettext_iface
        assert look_up("Import Clip", "Operator") == look_up("Import Clip") == "Clip importieren"
        tip = bpy.app.translations.pgettext_tip("Learn the scene and what moves in it from the clip")
        assert tip == "Die Szene und was sich darin bewegt aus dem Clip lernen"
        assert tr("74 frames, 1 to 74") == "74 Bilder, 1 bis 74"
        view.use_translate_interface = False
        assert look_up("Import Clip") == "Import Clip" and tr("74 frames, 1 to 74") == "74 frames, 1 to 74"
    finally:
        view.language, view.use_translate_interface, view.use_translate_tooltips = before
    assert tr("74 frames, 1 to 74") == "74 frames, 1 to 74"
