"""Presses Import Clip, then Solve, Train and Freeze, in a real Blender window; takes a picture of each state.

    python tests/addon/window/all_steps.py --blender BLENDER [--last 24] [--output docs/images]

Needs what press_steps.py needs. Fails unless the two presses lead to a frozen take and the progress bar never went
back.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

import press_steps as press


def main() -> int:
    """Run the host's side."""
    args = press._arguments()
    plan = {"clip": str(Path(args.clip).absolute()), "last": args.last, "t_star": args.t_star}
    results = press._host(__file__, plan, args)
    shares = [share for _, share, _ in results.get("bar", [])]
    return 0 if results.get("frames") == args.last and shares == sorted(shares) and not results["failures"] else 1


def play(plan: dict, results: dict) -> Iterator[float]:
    """Play the artist; yield the seconds to wait between actions."""
    import bpy

    press._time_ticks(results)
    yield from press._arrange()
    props, shot = bpy.context.scene.splannequin, Path(plan["work"]) / "sitting.splannequin"
    props.clip, props.shot_path = plan["clip"], str(shot)
    props.use_range, props.first, props.last = True, 1, plan["last"]
    props.choose_t_star, props.t_star = True, plan["t_star"]
    yield 0.5
    yield from press._click("splannequin.import_clip")
    watch, chain = press._supervisor().watch_of(shot), press.addon_module("process.all_steps")
    while watch.running() is not None:
        yield 0.2
    yield from press._shoot(Path(plan["work"]), "13-all-steps-ready")
    yield from press._click("splannequin.all_steps")
    results["bar"], taken = [], set()
    while (now := chain.progress(shot)) is not None:
        step = chain._chains[shot].step
        results["bar"].append((step, *now))
        if step not in taken and now[0] > {"solve": 0.1, "train": 0.4, "freeze": 0.8}[step]:
            taken.add(step)
            yield from press._shoot(Path(plan["work"]), f"14-all-steps-{step}", settle=2)
        yield 0.5
    yield from press._shoot(Path(plan["work"]), "15-all-steps-done")
    results["failures"] = {step: list(failure) for step, failure in watch.failures.items()}
    take = watch.state.takes.get(props.take_name, {})
    results["frames"], results["t_star"] = take.get("frame_count"), take.get("t_star_frame")


if __name__ == "__main__":
    if press.PLAN in os.environ and "bpy" in sys.modules:
        import bpy

        plan = json.loads(os.environ[press.PLAN])
        results = {"blender": bpy.app.version_string, "longest_tick_ms": 0.0}
        press.act(play(plan, results), Path(plan["work"]), results)
    else:
        sys.exit(main())
