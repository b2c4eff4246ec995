"""Finds a button with Blender's search (F3), then shows the panel in German, in a real Blender window.

    python tests/addon/window/search_and_language.py --blender BLENDER --shot SHOT.splannequin [--output docs/images]

BLENDER has the extension installed, as for press_steps.py; the shot has a take. Exit status is 0 if the search started
the operator and one undo reverted it. Takes pictures of the search in English, and of panel and search in German.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import press_steps as press


def _play(plan: dict[str, Any], results: dict[str, Any]) -> Iterator[float]:
    import bpy

    work = Path(plan["work"])
    yield from press._arrange()
    window = bpy.context.window_manager.windows[0]
    bpy.context.scene.splannequin.shot_path = plan["shot"]
    with bpy.context.temp_override(window=window):
        bpy.ops.ed.undo_push(message="shot chosen")
    before = len(bpy.data.cameras)
    yield from _search("freeze")
    yield from press._shoot(work, "10-search")
    yield from _press("ESC", 2)
    yield from _search("load camera")
    yield from _press("RET", 1)
    yield 2.0
    results["loaded"] = len(bpy.data.cameras) == before + 1

    view = bpy.context.preferences.view
    view.language = "de_DE"
    view.use_translate_interface = view.use_translate_tooltips = view.use_translate_reports = True
    results["german"] = bpy.app.translations.pgettext_iface("Import Clip") == "Clip importieren"
    for area in bpy.context.window_manager.windows[0].screen.areas:
        area.tag_redraw()
    yield 1.0
    yield from press._shoot(work, "10-german")
    yield from _search("frieren")
    yield from press._shoot(work, "10-german-search")
    yield from _press("ESC", 2)
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
        bpy.ops.ed.undo()
    yield 1.0
    results["undone"] = len(bpy.data.cameras) == before


def _search(text: str) -> Iterator[float]:
    """Press F3 over the 3D view and type the text."""
    import bpy

    window = bpy.context.window_manager.windows[0]
    press._move(window, 400, 500)
    yield 0.2
    yield from _press("F3", 1)
    yield 0.8
    for letter in text:
        key = "SPACE" if letter == " " else letter.upper()
        window.event_simulate(type=key, value="PRESS", unicode=letter, x=400, y=500)
        window.event_simulate(type=key, value="RELEASE", x=400, y=500)
    yield 1.2


def _press(key: str, times: int) -> Iterator[float]:
    """Press a key several times."""
    import bpy

    window = bpy.context.window_manager.windows[0]
    for _ in range(times):
        window.event_simulate(type=key, value="PRESS", x=400, y=500)
        window.event_simulate(type=key, value="RELEASE", x=400, y=500)
        yield 0.3


if __name__ == "__main__":
    status = press.on_a_shot(
        __file__,
        __doc__ or "",
        _play,
        "shot folder with a take",
        ":97",
        good=lambda results: bool(results.get("loaded") and results.get("undone") and results.get("german")),
    )
    if "bpy" not in sys.modules:
        sys.exit(status)
