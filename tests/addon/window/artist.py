"""Walks an artist's whole workflow in real windows: install, set up, five steps, a SIGKILL, scrub, and result.

    python tests/addon/window/artist.py --blender BLENDER --zip EXTENSION.zip [--last 24] [--output docs/images]

Three Blenders run one after the other in a separate home folder. The first installs the extension and sets its backend
up from the preferences (it downloads about 1.5 GB of packages). The second imports, solves, and is killed with SIGKILL
during training. The third opens the saved file, finds the job, scrubs, freezes, bakes and renders. Every button is
pressed by simulated events. Fails unless the job continued without Blender and every step ended well. Needs what
press_steps.py needs.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import press_steps as press

PLAN = "SPLANNEQUIN_ARTIST_PLAN"


def main() -> int:
    """Run the host's side: three Blenders on one display."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--blender", required=True)
    parser.add_argument("--zip", default="", help="the built extension; without it, it is taken to be installed")
    root = Path(__file__).resolve().parents[3]
    parser.add_argument("--clip", default=str(root / "examples" / "sitting.mp4"))
    parser.add_argument("--last", type=int, default=24, help="last frame of the clip to use")
    parser.add_argument("--output", default=str(root / "docs" / "images"))
    parser.add_argument("--display", default=":97")
    parser.add_argument("--limit", type=float, default=900.0, help="seconds for each Blender")
    args = parser.parse_args()
    output = Path(args.output).absolute()
    output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="splannequin-artist-") as name:
        work = Path(name)
        environ = {**os.environ, "DISPLAY": args.display}
        if args.zip:
            (work / "home").mkdir()
            environ["HOME"] = str(work / "home")
            environ.pop("SPLANNEQUIN_BACKEND_PYTHON", None)
        results: dict[str, Any] = {}
        with press.screen(args.display):
            for turn in (0, 1, 2) if args.zip else (1, 2):
                plan = {"turn": turn, "work": name, "clip": str(Path(args.clip).absolute()), "last": args.last}
                plan["zip"] = str(Path(args.zip).absolute())
                files = [str(work / "shot.blend")] if turn == 2 else []
                command = press.command(args.blender, __file__, *files)
                blender = subprocess.Popen(command, env={**environ, PLAN: json.dumps(plan)}, start_new_session=True)
                if turn != 1:
                    press._serve(blender, work, output, environ, args.limit)
                    results |= _read_results(work)
                    if "error" in results:
                        break
                    continue
                _serve_until(work / "kill.me", blender, work, output, environ, args.limit)
                os.killpg(blender.pid, signal.SIGKILL)
                blender.wait()
                time.sleep(3.0)
                results["job_after_kill"] = _state(work)
        print(json.dumps(results, indent=1))
        good = results.get("job_after_kill") == "running" and results.get("found") == "train"
        return 0 if good and results.get("ended") == ["3-train", "4-freeze", "5-bake"] else 1


def _read_results(work: Path) -> dict[str, Any]:
    """Results written by the last Blender."""
    file = work / "told.json"
    if not file.is_file():
        return {"error": "a Blender ended without telling how it went"}
    answer = json.loads(file.read_text())
    file.unlink()
    return answer


def _serve_until(file: Path, blender: Any, work: Path, output: Path, environ: dict[str, str], limit: float) -> None:
    """Take requested pictures until `file` exists; raise RuntimeError if Blender ends before."""
    until = time.monotonic() + limit
    while not file.exists():
        if blender.poll() is not None or time.monotonic() > until:
            raise RuntimeError("Blender ended, or the limit was reached, before the training was under way")
        press._photograph(work, output, environ)
        time.sleep(0.1)


def _state(work: Path) -> str:
    """State of the training job in its status file."""
    status = max((work / "sitting.splannequin" / "jobs").glob("*-train-*/status.json"))
    return str(json.loads(status.read_text())["state"])


# ------------------------------------------------------------------------------------------------- inside Blender


def inside() -> None:
    """Start this turn's script as a timer."""
    import bpy

    plan = json.loads(os.environ[PLAN])
    results: dict[str, Any] = {"blender": bpy.app.version_string, "longest_tick_ms": 0.0}
    if plan["turn"] == 0:
        results = {}
    play = {0: _set_up, 1: _first, 2: _second}[plan["turn"]](plan, results)
    press.act(play, Path(plan["work"]), results if plan["turn"] != 1 else None)


def _set_up(plan: dict[str, Any], results: dict[str, Any]) -> Iterator[float]:
    """Install the zip, set the backend up from the preferences, and save both for the next Blender."""
    import bpy

    work = Path(plan["work"])
    window = bpy.context.window_manager.windows[0]
    press._move(window, 300, 500)
    for value in ("PRESS", "RELEASE"):
        window.event_simulate(type="ESC", value=value, x=300, y=500)
    yield 1.0
    bpy.context.preferences.view.show_splash = False
    bpy.context.preferences.system.use_online_access = True
    began = time.monotonic()
    bpy.ops.extensions.package_install_files(filepath=plan["zip"], repo="user_default", enable_on_install=True)
    results["install_seconds"] = round(time.monotonic() - began, 1)
    area = press._view(window)
    area.ui_type = "PREFERENCES"
    bpy.context.preferences.active_section = "ADDONS"
    bpy.context.window_manager.addon_search = "Splannequin"
    yield 1.0
    module = press._supervisor().__name__.rpartition(".splannequin_addon")[0]
    bpy.ops.preferences.addon_expand(module=module)
    yield 1.0
    yield from press._shoot(work, "a-installed")
    yield from press._click("splannequin.set_up", "PREFERENCES")
    yield from press._shoot(work, "b-consent", settle=0)
    for value in ("PRESS", "RELEASE"):
        window.event_simulate(type="RET", value=value, x=300, y=500)
    began = time.monotonic()
    preferences = sys.modules[f"{module}.splannequin_addon.ui.preferences"]
    yield 2.0
    if not preferences.busy():
        raise RuntimeError("the set-up did not begin")
    taken = False
    while preferences.busy():
        yield 0.5
        if not taken and time.monotonic() - began > 20:
            yield from press._shoot(work, "c-set-up-running", settle=2)
            taken = True
    results["set_up_seconds"] = round(time.monotonic() - began, 1)
    if preferences._setup is None or preferences._setup.failure:
        yield from press._shoot(work, "c-set-up-failed")
        raise RuntimeError(preferences._setup.failure if preferences._setup else "no set-up")
    while preferences._checks:
        yield 0.5
    yield 2.0
    results["backend"] = list(preferences._findings)
    yield from press._shoot(work, "d-set-up-done")
    bpy.ops.wm.save_userpref()


def _first(plan: dict[str, Any], _: dict[str, Any]) -> Iterator[float]:
    """Import, solve, save and train; request to be killed once the training runs."""
    import bpy

    work = Path(plan["work"])
    yield from press._arrange()
    yield from press._shoot(work, "0-start")
    props = bpy.context.scene.splannequin
    props.clip, props.shot_path = plan["clip"], str(work / "sitting.splannequin")
    props.use_range, props.first, props.last = True, 1, plan["last"]
    results: dict[str, Any] = {"ended": [], "longest_tick_ms": 0.0}
    for name, operator in press.STEPS[:2]:
        yield from press._click(operator)
        yield from press._watch(work, name, results, cancel=False)
    bpy.ops.wm.save_as_mainfile(filepath=str(work / "shot.blend"))
    yield from press._click("splannequin.train")
    watch = press._supervisor().watch_of(work / "sitting.splannequin")
    while True:
        job = watch.jobs.get("train")
        status = job.status if job is not None else None
        if status is not None and status.stage == "training" and status.fraction > 0.3:
            break
        yield 0.2
    (work / "kill.me").touch()
    while True:
        yield 1.0


def _second(plan: dict[str, Any], results: dict[str, Any]) -> Iterator[float]:
    """Reopen the file: find the job, watch it until it ends, and finish the shot."""
    import bpy

    work = Path(plan["work"])
    results["ended"] = []
    press._time_ticks(results)
    window = bpy.context.window_manager.windows[0]
    bpy.context.preferences.use_preferences_save = False
    bpy.context.preferences.view.render_display_type = "NONE"
    area = press._view(window)
    area.spaces.active.show_region_ui = True
    yield 0.5
    press._sidebar(area).active_panel_category = "Splannequin"
    yield 1.5
    watch = press._supervisor().watch_of(work / "sitting.splannequin")
    results["found"] = watch.running()
    job = watch.jobs.get("train")
    results["found_at"] = round(job.status.fraction, 3) if job is not None and job.status is not None else None
    yield from press._shoot(work, "9-found-again", settle=2)
    yield from press._watch(work, "3-train", results, cancel=False)
    yield from _scrub(plan, work)
    for name, operator in press.STEPS[3:]:
        yield from press._click(operator)
        yield from press._watch(work, name, results, cancel=False)
    yield from press._show_results(work)


def _scrub(plan: dict[str, Any], work: Path) -> Iterator[float]:
    """Scrub in the view, and set t* from the shown frame."""
    import bpy

    yield from press._click("splannequin.live")
    viewport = press.addon_module("freeze.viewport")
    until = time.monotonic() + 60
    while viewport.session() is None or not viewport.session().facts:
        if viewport.failure() or time.monotonic() > until:
            raise RuntimeError(" ".join(viewport.failure() or ("the backend never was ready to scrub",)))
        yield 0.2
    for frame in range(2, plan["last"] // 2 + 1):
        bpy.context.scene.frame_set(frame)
        yield 0.2
    yield from press._click("splannequin.t_star_here")
    if bpy.context.scene.splannequin.t_star != plan["last"] // 2:
        raise RuntimeError("the button did not set t* from the current frame")
    yield 2.0
    yield from press._shoot(work, "9-scrubbed")
    yield from press._click("splannequin.live")
    yield 1.0


if __name__ == "__main__":
    if PLAN in os.environ and "bpy" in sys.modules:
        inside()
    else:
        sys.exit(main())
