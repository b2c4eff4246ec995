"""Kills Blender with SIGKILL while it trains, starts it again on the saved file, and finishes the shot there.

    python tests/addon/window/kill_and_return.py --blender BLENDER [--last 24] [--output docs/images]

BLENDER has the extension installed, as for press_steps.py. Fails unless the job went on without Blender, was found
again with its progress, and the last two steps ended well.
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

PLAN = "SPLANNEQUIN_KILL_PLAN"


def main() -> int:
    """The host's side: two Blenders, one after the other, on one display."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--blender", required=True)
    root = Path(__file__).resolve().parents[3]
    parser.add_argument("--clip", default=str(root / "examples" / "sitting.mp4"))
    parser.add_argument("--last", type=int, default=24)
    parser.add_argument("--output", default=str(root / "docs" / "images"))
    parser.add_argument("--display", default=":97")
    parser.add_argument("--limit", type=float, default=900.0)
    args = parser.parse_args()
    output = Path(args.output).absolute()
    output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="splannequin-kill-") as name:
        work = Path(name)
        environ = {**os.environ, "DISPLAY": args.display}
        results: dict[str, Any] = {}
        with press.screen(args.display):
            for turn in (1, 2):
                plan = {"turn": turn, "work": name, "clip": str(Path(args.clip).absolute()), "last": args.last}
                files = [str(work / "shot.blend")] if turn == 2 else []
                command = press.command(args.blender, __file__, *files)
                blender = subprocess.Popen(command, env={**environ, PLAN: json.dumps(plan)}, start_new_session=True)
                if turn == 2:
                    press._serve(blender, work, output, environ, args.limit)
                    continue
                _serve_until(work / "kill.me", blender, work, output, environ, args.limit)
                os.killpg(blender.pid, signal.SIGKILL)
                blender.wait()
                time.sleep(3.0)
                results["job_after_kill"] = _state(work)
        told = work / "told.json"
        results |= json.loads(told.read_text()) if told.is_file() else {"error": "the second Blender told nothing"}
        print(json.dumps(results, indent=1))
        good = results["job_after_kill"] == "running" and results.get("found") == "train"
        return 0 if good and results.get("ended") == ["3-train", "4-freeze", "5-bake"] else 1


def _serve_until(file: Path, blender: Any, work: Path, output: Path, environ: dict[str, str], limit: float) -> None:
    """Takes pictures until `file` is there; RuntimeError if Blender ends before."""
    until = time.monotonic() + limit
    while not file.exists():
        if blender.poll() is not None or time.monotonic() > until:
            raise RuntimeError("Blender ended, or the limit was reached, before the training was under way")
        press._photograph(work, output, environ)
        time.sleep(0.1)


def _state(work: Path) -> str:
    """State of the training job by its status file."""
    status = max((work / "sitting.splannequin" / "jobs").glob("*-train-*/status.json"))
    return str(json.loads(status.read_text())["state"])


# ------------------------------------------------------------------------------------------------- inside Blender


def inside() -> None:
    """Starts this turn's script as a timer."""
    import bpy

    plan = json.loads(os.environ[PLAN])
    told: dict[str, Any] = {"blender": bpy.app.version_string, "ended": [], "longest_tick_ms": 0.0}
    press.act(_first(plan) if plan["turn"] == 1 else _second(plan, told), Path(plan["work"]), told)


def _first(plan: dict[str, Any]) -> Iterator[float]:
    """Import, solve, save, train; asks to be killed once the training is under way."""
    import bpy

    work = Path(plan["work"])
    yield from press._arrange()
    props = bpy.context.scene.splannequin
    props.clip, props.shot_path = plan["clip"], str(work / "sitting.splannequin")
    props.use_range, props.first, props.last = True, 1, plan["last"]
    told: dict[str, Any] = {"ended": [], "longest_tick_ms": 0.0}
    for name, operator in press.STEPS[:2]:
        yield from press._click(operator)
        yield from press._watch(work, name, told, cancel=False)
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


def _second(plan: dict[str, Any], told: dict[str, Any]) -> Iterator[float]:
    """The file is open again: the job is found, watched to its end, and the shot is finished."""
    import bpy

    work = Path(plan["work"])
    press._time_ticks(told)
    window = bpy.context.window_manager.windows[0]
    bpy.context.preferences.use_preferences_save = False
    bpy.context.preferences.view.render_display_type = "NONE"
    area = press._view(window)
    area.spaces.active.show_region_ui = True
    yield 0.5
    press._sidebar(area).active_panel_category = "Splannequin"
    yield 1.5
    watch = press._supervisor().watch_of(work / "sitting.splannequin")
    told["found"] = watch.running()
    job = watch.jobs.get("train")
    told["found_at"] = round(job.status.fraction, 3) if job is not None and job.status is not None else None
    yield from press._shoot(work, "9-found-again", settle=2)
    yield from press._watch(work, "3-train", told, cancel=False)
    for name, operator in press.STEPS[3:]:
        if name == "4-freeze":
            bpy.context.scene.splannequin.choose_t_star = True
            bpy.context.scene.splannequin.t_star = plan["last"] // 2
            yield 0.5
        yield from press._click(operator)
        yield from press._watch(work, name, told, cancel=False)


if __name__ == "__main__":
    if PLAN in os.environ and "bpy" in sys.modules:
        inside()
    else:
        sys.exit(main())
