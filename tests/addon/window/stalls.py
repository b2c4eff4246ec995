"""Times the calls that block Blender's main thread: loading the camera, and a bake with its render.

    python tests/addon/window/stalls.py --blender BLENDER --shot SHOT.splannequin

BLENDER has the extension installed, as for press_steps.py. The shot has a trained run and a take, and is copied. Prints
the timer turns over 10 ms in milliseconds, with their longest calls. For comparison, also prints the start of a render
in the same scene without the extension's objects.
"""

from __future__ import annotations

import resource
import shutil
import sys
import time
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import press_steps as press

REPORTED_MS = 10.0
FRAMES = 6


def _play(plan: dict[str, Any], results: dict[str, Any]) -> Iterator[float]:
    import bpy

    shot = Path(plan["work"]) / "stalls.splannequin"
    shutil.copytree(plan["shot"], shot)
    yield from press._arrange()
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end, scene.render.resolution_percentage = 1, 1, 10
    results["blender_render_start"] = []
    for n in range(3):
        scene.render.filepath = str(shot.parent / "own" / str(n)) + "/"
        results["blender_render_start"].append(_timed(lambda: bpy.ops.render.render("INVOKE_DEFAULT", animation=True)))
        yield from _rendered()
    scene.render.filepath, scene.render.resolution_percentage = "/tmp/", 100  # noqa: S108  (what a new file has)
    scene.splannequin.shot_path = str(shot)
    scene.splannequin.take_name = sorted(p.name for p in (shot / "takes").iterdir())[0]
    (shot / "takes" / scene.splannequin.take_name / "000003.exr").unlink()  # a missing frame, so that Freeze has work
    yield 1.0
    calls: list[tuple[str, float]] = []
    results["turns"] = []
    _watch_calls(calls)
    _watch_turns(calls, results["turns"])
    results["load_camera"] = []
    for _ in range(2):
        calls.clear()
        before = _from_disk()
        with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
            spent = _timed(bpy.ops.splannequin.load_camera)
        results["load_camera"].append({"ms": spent, "from_disk": _from_disk() - before, "in": _longest(calls)})
        yield 1.0
    scene.frame_start, scene.frame_end = 1, FRAMES
    for _ in range(6):  # scrolls to the last panel; searching its button from the top takes minutes
        yield from press._scroll_down()
    yield from press._click("splannequin.bake")
    watch = press._supervisor().watch_of(shot)
    yield 1.0
    while watch.running() is not None:
        yield 0.2
    if watch.failures:
        raise RuntimeError(str(watch.failures))
    results["rendered"] = len(list((shot / "bake").rglob("*.png")))


def _rendered() -> Iterator[float]:
    import bpy

    yield 0.5
    while bpy.app.is_job_running("RENDER"):
        yield 0.2
    yield 0.5


def _from_disk() -> int:
    """Number of page faults that waited for the disk: programs and libraries are read from it when first used."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_majflt


def _timed(call: Callable[[], Any]) -> float:
    """Duration of a call in milliseconds."""
    began = time.perf_counter()
    call()
    return round(1000 * (time.perf_counter() - began), 1)


def _watch_calls(calls: list[tuple[str, float]]) -> None:
    """Time the functions behind the steps; append (name, milliseconds) when each ends."""

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **named: Any) -> Any:
            began = time.perf_counter()
            try:
                return function(*args, **named)
            finally:
                calls.append((name, round(1000 * (time.perf_counter() - began), 1)))

        return call

    for part in (
        "process.begin",
        "bake.insertion",
        "bake.group_inside",
        "scene.sequences",
        "solve.cameras",
        "compat",
        "bake.compositor",
        "solve.guesses",
        "shot.scene_objects",
        "scene.scene_setup",
        "process.job_timer",
    ):
        module = press.addon_module(part)
        for name, function in list(vars(module).items()):
            if isinstance(function, types.FunctionType) and function.__module__ == module.__name__ and name != "tick":
                setattr(module, name, timed(f"{part}.{name}", function))


def _longest(calls: list[tuple[str, float]]) -> list[str]:
    return [f"{name} {ms}" for name, ms in sorted(calls, key=lambda call: -call[1])[:5]]


def _watch_turns(calls: list[tuple[str, float]], turns: list[dict[str, Any]]) -> None:
    """Time the turns of the timer, with the calls in them."""
    import bpy

    tick = press._supervisor().tick
    bpy.app.timers.unregister(tick)

    def timed() -> float:
        calls.clear()
        before, began = _from_disk(), time.perf_counter()
        pause = tick()
        spent = 1000 * (time.perf_counter() - began)
        if spent > REPORTED_MS:
            turns.append({"ms": round(spent, 1), "from_disk": _from_disk() - before, "in": _longest(calls)})
        return pause

    bpy.app.timers.register(timed, persistent=True)


if __name__ == "__main__":
    status = press.on_a_shot(__file__, __doc__ or "", _play, "shot folder with a trained run `main` and a take", ":94")
    if "bpy" not in sys.modules:
        sys.exit(status)
