"""Records the first ten minutes of an artist with an empty profile: the panel's sentences, waiting times, and pictures.

    SPLANNEQUIN_WINDOW=1920x1080 python tests/addon/window/first_minutes.py --blender BLENDER --zip EXTENSION.zip
        [--clip CLIP] [--last N] [--output DIR]

The backend's environment must exist (SPLANNEQUIN_BACKEND_PYTHON); `artist.py` tests its set-up. One Blender with an
empty profile installs the zip. The clip is dropped on the 3D view, and the buttons are pressed down to the render.
Writes first_minutes.json to the folder of the pictures: for each stage its seconds and the sentences shown by the
panel. Fails unless all five steps end and every button is in sight when it is needed, at the window's height. Needs
what press_steps.py needs.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import press_steps as press

ROOT = Path(__file__).resolve().parents[3]


def main() -> int:
    """Run the host's side: a fresh profile, a display, and Blender."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--blender", required=True)
    parser.add_argument("--zip", required=True, help="the built extension")
    parser.add_argument("--clip", default=str(ROOT / "examples" / "sitting.mp4"))
    parser.add_argument("--last", type=int, default=0, help="last frame of the clip to use; 0: all of it")
    parser.add_argument("--output", default=str(ROOT / "output" / "first_minutes"))
    parser.add_argument("--display", default=":95")
    parser.add_argument("--limit", type=float, default=1500.0, help="seconds until Blender is ended")
    args = parser.parse_args()
    plan = {"zip": str(Path(args.zip).absolute()), "clip": str(Path(args.clip).absolute()), "last": args.last}
    with tempfile.TemporaryDirectory(prefix="splannequin-profile-") as profile:
        os.environ["BLENDER_USER_RESOURCES"] = profile
        results = press._host(__file__, plan, args)
    Path(args.output, "first_minutes.json").write_text(json.dumps(results, indent=1))
    good = results.get("ended") == [name for name, _ in press.STEPS] and results.get("searches") == 0
    return 0 if good and "error" not in results else 1


# ------------------------------------------------------------------------------------------------- inside Blender


class Record:
    """Records the seconds of each stage and the sentences that the panel shows in it."""

    def __init__(self, results: dict[str, Any], work: Path) -> None:
        self.results, self.work = results, work
        self.results.update(seconds={}, sentences={}, ended=[], searches=0, longest_tick_ms=0.0)
        self.stage, self.began, self.seen = "", time.monotonic(), set[str]()

    def enter(self, stage: str) -> None:
        """End the current stage and begin another."""
        now = time.monotonic()
        if self.stage:
            self.results["seconds"][self.stage] = round(now - self.began, 1)
        self.stage, self.began, self.seen = stage, now, set()
        (self.work / "told.json").write_text(json.dumps(self.results))  # partial results, in case Blender is ended

    def hear(self, text: str) -> None:
        """Record a sentence once per stage; sentences that differ only in numbers count as equal."""
        alike = re.sub(r"\d+(\.\d+)?", "0", text)
        if text and alike not in self.seen:
            self.seen.add(alike)
            self.results["sentences"].setdefault(self.stage, []).append(text)


def listen(record: Record) -> None:
    """Record all texts that the panel wraps into lines, and the texts of its progress bars."""
    sentences = press.addon_module("ui.sentences")
    wrap, panel = sentences.wrap, press.addon_module("ui.step_panel")
    tr = panel.tr

    def heard(layout: Any, context: Any, text: str, *args: Any, **kwargs: Any) -> None:
        record.hear(text)
        wrap(layout, context, text, *args, **kwargs)

    def said(text: str) -> str:
        record.hear(text)
        return tr(text)

    for name, module in list(sys.modules.items()):
        if ".splannequin_addon." in name and getattr(module, "wrap", None) is wrap:
            setattr(module, "wrap", heard)  # noqa: B010
    panel.tr = said


def count_searches(results: dict[str, Any]) -> None:
    """Count the cases in which a button was out of sight, so that a step was opened or the panel scrolled."""

    def counted(act: Callable[..., Iterator[float]]) -> Callable[..., Iterator[float]]:
        def do(*args: Any) -> Iterator[float]:
            results["searches"] += 1
            yield from act(*args)

        return do

    press._unfold, press._scroll_down = counted(press._unfold), counted(press._scroll_down)


def play(plan: dict[str, Any], results: dict[str, Any]) -> Iterator[float]:
    """Play the artist; yield the seconds to wait between actions."""
    import bpy

    work = Path(plan["work"])
    record = Record(results, work)
    clip = Path(shutil.copy(plan["clip"], work / "sitting.mp4"))
    record.enter("install")
    bpy.ops.extensions.package_install_files(filepath=plan["zip"], repo="user_default", enable_on_install=True)
    press._time_ticks(results)
    listen(record)
    count_searches(results)
    record.enter("open the tab")
    yield from press._arrange()
    yield from press._shoot(work, "01-tab")
    record.enter("drop the clip")
    window = bpy.context.window_manager.windows[0]
    with bpy.context.temp_override(window=window, area=press._view(window)):
        bpy.ops.splannequin.use_clip("INVOKE_DEFAULT", filepath=str(clip))
    props = bpy.context.scene.splannequin
    if plan["last"]:
        props.use_range, props.first, props.last = True, 1, plan["last"]
    yield from press._shoot(work, "02-dropped")
    for name, operator in press.STEPS:
        if name == "4-freeze":
            record.enter("scrub")
            yield from scrub(work, results)
        record.enter(name)
        yield from press._click(operator)
        results["seconds"][f"{name}: click"] = round(time.monotonic() - record.began, 1)
        yield from press._watch(work, name, results, cancel=False)
        if results["ended"][-1:] != [name]:
            return
        record.enter(f"{name}: done")
        yield 2.0
    record.enter("results")
    yield from press._show_results(work)
    bpy.ops.wm.save_as_mainfile(filepath=str(work / "shot.blend"))
    record.enter("")


def scrub(work: Path, results: dict[str, Any]) -> Iterator[float]:
    """Scrub from end to end, and set t* to the shown frame."""
    import bpy

    yield from press._click("splannequin.live")
    began, viewport = time.monotonic(), press.addon_module("freeze.viewport")
    while viewport.session() is None or not viewport.session().facts:
        if viewport.failure() or time.monotonic() - began > 60:
            raise RuntimeError(" ".join(viewport.failure() or ("the backend never was ready to scrub",)))
        yield 0.2
    results["seconds"]["scrub: ready"] = round(time.monotonic() - began, 1)
    yield 3.0
    yield from press._shoot(work, "3b-scrub")
    scene = bpy.context.scene
    for frame in range(scene.frame_start, scene.frame_end + 1, 6):
        scene.frame_set(frame)
        yield 0.3
    scene.frame_set((scene.frame_start + scene.frame_end) // 4)
    yield 3.0
    yield from press._click("splannequin.t_star_here")
    yield from press._shoot(work, "3c-t-star")
    yield from press._click("splannequin.live")
    yield 1.0


def inside() -> None:
    """Start the script as a timer."""
    import bpy

    plan = json.loads(os.environ[press.PLAN])
    results: dict[str, Any] = {"blender": bpy.app.version_string}
    press.act(play(plan, results), Path(plan["work"]), results)


if __name__ == "__main__":
    if press.PLAN in os.environ and "bpy" in sys.modules:
        inside()
    else:
        sys.exit(main())
