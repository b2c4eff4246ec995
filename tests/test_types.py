"""Parameter types of the add-on's functions; Blender's type stubs are only for the type checker."""

import ast
import importlib.util
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
MOST = 0.05
"""Largest allowed fraction of the add-on's parameters with an open type."""
RECORDS = ("dict[str, Any]", "Mapping[str, Any]")
"""Types of data read from JSON, whose values are checked when they are used."""
OPEN = {
    "bake/freeze_group.py: _factor(socket)": "Blender's types know the plain subtype of a socket alone",
    "bake/render_settings.py: _picture(value)": "the value of any setting",
    "bake/render_settings.py: _set(owner)": "whatever has settings",
    "bake/render_settings.py: set_noted(value)": "the value of any setting",
    "compat.py: _scene_node_tree(scene)": "a Blender older than its types",
    "process/children.py: start(streams)": "what Popen takes, by name",
    "scene/scene_setup.py: _neutral(view)": "Blender's types know the views of one colour configuration",
    "scene/scene_setup.py: _same(first)": "the value of any setting",
    "scene/scene_setup.py: _same(second)": "the value of any setting",
    "scene/sequences.py: show_sequence(user)": "an image user, or a node that has the same in itself",
}
"""Map from each parameter of type `Any` to the reason."""


def parameters(tree: ast.AST) -> Iterator[tuple[str, str, str]]:
    """(function, parameter, type) of every function of a file, except `self` and `cls`; the type is empty if
    missing."""
    for node in ast.walk(tree):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            arguments = node.args
            stars = [one for one in (arguments.vararg, arguments.kwarg) if one is not None]
            for one in [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs, *stars]:
                if one.arg not in ("self", "cls"):
                    yield node.name, one.arg, ast.unparse(one.annotation) if one.annotation is not None else ""


def is_open(kind: str) -> bool:
    """True if a type contains `Any` or is missing."""
    return not kind or any(isinstance(n, ast.Name) and n.id == "Any" for n in ast.walk(ast.parse(kind)))


def addon_parameters() -> list[tuple[str, str]]:
    """(parameter, type) of all parameters of the add-on."""
    folder = ROOT / "splannequin_addon"
    return [
        (f"{path.relative_to(folder).as_posix()}: {function}({name})", kind)
        for path in sorted(folder.rglob("*.py"))
        for function, name, kind in parameters(ast.parse(path.read_text(encoding="utf-8")))
    ]


def test_hardly_a_parameter_of_the_addon_has_an_open_type():
    found = addon_parameters()
    assert len(found) > 900
    assert sum(is_open(kind) for _, kind in found) < MOST * len(found)


def test_every_open_parameter_of_the_addon_has_a_reason():
    found = addon_parameters()
    assert {name for name, kind in found if is_open(kind) and kind not in RECORDS} == set(OPEN)


def annotated_calls(tree: ast.AST) -> list[int]:
    """Lines of annotations that are calls, which a type checker does not accept as types."""
    found = [n for n in ast.walk(tree) if isinstance(n, ast.AnnAssign)]
    return [n.lineno for n in found if any(isinstance(part, ast.Call) for part in ast.walk(n.annotation))]


def test_addon_properties_are_assigned_with_known_types():
    """`splannequin_addon/properties.py` explains how."""
    for path in sorted((ROOT / "splannequin_addon").rglob("*.py")):
        assert not annotated_calls(ast.parse(path.read_text(encoding="utf-8"))), path
    assert annotated_calls(ast.parse("class A:\n    name: StringProperty()")) == [2]


def test_blenders_types_are_nothing_that_this_python_can_import():
    """A package of type stubs named like bpy would be mistaken for Blender."""
    if importlib.util.find_spec("_bpy") is None:
        assert importlib.util.find_spec("bpy") is None
