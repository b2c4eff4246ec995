"""Presses Train On, Pause and Resume in a real Blender window, on a tiny world trained before; pictures of each.

    python tests/addon/window/train_on.py --blender BLENDER --backend PYTHON [--output DIR]

BLENDER is any Blender: the add-on is loaded from this checkout. PYTHON is the backend's. Fails unless the panel's
preview changed during training, the paused run was complete, and the resumed run has all its steps.
"""

from __future__ import annotations

import argparse
import importlib
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

PLAN = "SPLANNEQUIN_TRAIN_ON_PLAN"
ROOT = Path(__file__).resolve().parents[3]
WORLD = "from pathlib import Path; from tests.backend.conftest import build_world; build_world(Path({!r}))"
MORE = 2500
"""Additional steps; enough that the training still runs when the pause button is found."""


def main() -> int:
    """Run the host's side: build the world, train two runs, open Blender on a display."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--blender", required=True)
    parser.add_argument("--backend", required=True, help="Python of the backend's environment")
    parser.add_argument("--output", default=str(ROOT / "docs" / "images"))
    parser.add_argument("--display", default=":96")
    parser.add_argument("--limit", type=float, default=500.0)
    args = parser.parse_args()
    output = Path(args.output).absolute()
    output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="splannequin-train-on-") as name:
        shot = Path(name) / "tiny.splannequin"
        safe = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONSAFEPATH": "1"}
        subprocess.run([args.backend, "-P", "-c", WORLD.format(name)], cwd=ROOT, env=safe, check=True)
        (shot / "solve" / "solve.json").write_text('{"version": 1, "quality": "Known by construction."}')
        for run in ("main", "static"):
            flags = ["--iterations", "150", "--max-gaussians", "1500", "--method", "auto" if run == "main" else run]
            command = [args.backend, "-P", "-m", "torch_backend", "train", str(shot), "--run", run, *flags]
            subprocess.run(command, cwd=ROOT, env=safe, check=True)
        environ = {**os.environ, "DISPLAY": args.display, PLAN: name, "SPLANNEQUIN_BACKEND_PYTHON": args.backend}
        with press.screen(args.display):
            blender = subprocess.Popen([*press.command(args.blender, __file__), "--factory-startup"], env=environ)
            press._serve(blender, Path(name), output, environ, args.limit)
        results_file = Path(name) / "told.json"
        results = json.loads(results_file.read_text()) if results_file.is_file() else {"error": "Blender told nothing"}
        print(json.dumps(results, indent=1))
        good = results.get("button_when_paused") == "Resume" and results.get("iterations_when_paused") == 150
        good = good and results.get("iterations") == 150 + MORE and results.get("previews_seen", 0) >= 3
        return 0 if good else 1


def inside() -> None:
    """Load the add-on from the checkout and start the script as a timer."""
    sys.path.insert(0, str(ROOT / "splannequin_addon"))
    package = importlib.import_module("run_in_bpy").load_package()
    package.register()
    results: dict[str, Any] = {}
    press.act(_play(package.__name__, results), Path(os.environ[PLAN]), results)


def _play(package: str, results: dict[str, Any]) -> Iterator[float]:
    """Play the artist; yield the seconds to wait between actions."""
    import bpy

    def module(name: str) -> Any:
        return importlib.import_module(f"{package}.splannequin_addon.{name}")

    work, pictures, panel = Path(os.environ[PLAN]), module("train.pictures"), module("ui.step_panel")
    yield from press._arrange()
    props = bpy.context.scene.splannequin
    props.shot_path, props.extend_steps = str(work / "tiny.splannequin"), MORE
    sub_panel = panel.sub_panel
    panel.sub_panel = lambda layout, name, label, folded=True: sub_panel(layout, name, label, name.endswith("_more"))
    yield 1.0
    yield from press._scroll_down()
    yield from press._shoot(work, "10-runs")
    watch = module("process.job_timer").watch_of(work / "tiny.splannequin")
    yield from press._click("splannequin.train")
    shown: dict[str, int] = {}
    while len(shown) < 4 and watch.running() == "train":
        path = watch.jobs["train"].images.get("preview")
        if path in (pictures._collection or {}):  # the preview is drawn, not only listed
            shown[path] = pictures.icon_of(Path(path))
        yield 0.1
    results["previews_seen"] = len(set(shown.values()))
    yield from press._shoot(work, "10-train-on-running", settle=2)
    yield from press._click("splannequin.cancel")
    while watch.running() is not None:
        yield 0.2
    yield 1.5
    plan = module("train.training").plan(watch.state, props.run_name, props.preset)
    results["button_when_paused"] = plan.button
    results["iterations_when_paused"] = watch.state.runs["main"]["iterations"]
    yield from press._shoot(work, "10-paused")
    yield from press._click("splannequin.train")
    yield 1.0
    while watch.running() is not None:
        yield 0.2
    yield 1.5
    results["iterations"] = watch.state.runs["main"]["iterations"]
    yield from press._shoot(work, "10-train-on-done")


if __name__ == "__main__":
    if PLAN in os.environ and "bpy" in sys.modules:
        inside()
    else:
        sys.exit(main())
