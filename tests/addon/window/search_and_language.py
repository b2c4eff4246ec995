"""Looks for a button with Blender's search (F3), then shows the panel in German, in a real Blender window.

    python tests/addon/window/search_and_language.py --blender BLENDER --shot SHOT.splannequin [--output docs/images]

BLENDER has the extension installed, as for press_steps.py; the shot has a take. Exit status 0 if the search started
what it found and one undo took it back. Pictures: the search in English, the panel and the search in German.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import press_steps as press

PLAN = "SPLANNEQUIN_SEARCH_PLAN"


def main() -> int:
    """The host's side: a display, Blender on it, photographs when asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--blender", required=True)
    parser.add_argument("--shot", required=True, help="shot folder with a take")
    parser.add_argument("--output", default="docs/images")
    parser.add_argument("--display", default=":97")
    parser.add_argument("--limit", type=float, default=200.0)
    args = parser.parse_args()
    output = Path(args.output).absolute()
    output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="splannequin-search-") as work:
        plan = {"shot": str(Path(args.shot).absolute()), "work": work}
        environ = {**os.environ, "DISPLAY": args.display, PLAN: json.dumps(plan)}
        with press.screen(args.display):
            blender = subprocess.Popen(press.command(args.blender, __file__), env=environ)
            press._serve(blender, Path(work), output, environ, args.limit)
        told = Path(work) / "told.json"
        if not told.is_file():
            print("Error: Blender ended without telling how it went.", file=sys.stderr)
            return 1
        results = json.loads(told.read_text())
        print(json.dumps(results, indent=1))
        return 0 if results.get("loaded") and results.get("undone") and results.get("german") else 1


# ------------------------------------------------------------------------------------------------- inside Blender


def inside() -> None:
    """Starts the script as a timer that walks through `_play`."""
    import bpy

    plan, told = json.loads(os.environ[PLAN]), {"blender": bpy.app.version_string}
    press.act(_play(plan, told), Path(plan["work"]), told)


def _play(plan: dict[str, Any], told: dict[str, Any]) -> Iterator[float]:
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
    told["loaded"] = len(bpy.data.cameras) == before + 1

    view = bpy.context.preferences.view
    view.language = "de_DE"
    view.use_translate_interface = view.use_translate_tooltips = view.use_translate_reports = True
    told["german"] = bpy.app.translations.pgettext_iface("Import Clip") == "Clip importieren"
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
    told["undone"] = len(bpy.data.cameras) == before


def _search(text: str) -> Iterator[float]:
    """F3 over the 3D view, and what is typed into it."""
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
    """A key, again and again."""
    import bpy

    window = bpy.context.window_manager.windows[0]
    for _ in range(times):
        window.event_simulate(type=key, value="PRESS", x=400, y=500)
        window.event_simulate(type=key, value="RELEASE", x=400, y=500)
        yield 0.3


if __name__ == "__main__":
    if PLAN in os.environ and "bpy" in sys.modules:
        inside()
    else:
        sys.exit(main())
