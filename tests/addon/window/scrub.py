"""Scrubs t* in a real Blender window over a trained shot: frozen views per second, and stalls of the main thread.

    python tests/addon/window/scrub.py --blender BLENDER --shot SHOT.splannequin [--output docs/images]

BLENDER has the extension installed, as for press_steps.py. SPLANNEQUIN_BACKEND_PYTHON (or a checkout's .venv) names the
backend. SPLANNEQUIN_WINDOW=960x600 selects a smaller window. Prints the figures as JSON. Takes pictures of the camera's
view composited from plates, of a free view with a cube among the people, and of the guesses.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import press_steps as press

SWEEP_SECONDS = 10.0


def _play(plan: dict[str, Any], results: dict[str, Any]) -> Iterator[float]:
    import bpy

    work = Path(plan["work"])
    yield from press._arrange()
    scene = bpy.context.scene
    scene.splannequin.shot_path = plan["shot"]
    viewport = press.addon_module("freeze.viewport")
    stalls = _time(viewport, results)
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
        bpy.ops.splannequin.load_camera()
    yield 1.0
    yield from press._shoot(work, "8-points")
    yield from press._click("splannequin.live")
    since = time.monotonic()
    while viewport.session() is None or not viewport.session().facts:
        if viewport.failure():
            raise RuntimeError(" ".join(viewport.failure()))
        if time.monotonic() - since > 120:
            yield from press._shoot(work, "8-scrub-failed")
            raise RuntimeError("the backend never was ready")
        yield 0.1
    results["ready_seconds"] = round(time.monotonic() - since, 2)
    session = viewport.session()
    results["facts"] = {k: session.facts[k] for k in ("gaussians", "moving", "suggestions", "width", "height")}
    scene.splannequin.choose_t_star = True
    trained = session.facts["trained"]
    scene.splannequin.t_star = trained[len(trained) // 2]
    results["detail_seconds"] = [(yield from _detailed(session))]
    yield from press._scroll_down()  # to the part of the step that is shown while scrubbing
    yield from press._shoot(work, "8-scrub-camera")
    results["sharp_width"] = max(frame.rgba.shape[1] for frame in session.frames.values())
    results["covered"] = round(min(float(frame.rgba[..., 3].mean()) for frame in session.frames.values()), 3)
    stalls.clear()
    for name, change in _sweeps(scene, trained):
        began, drawn, n = time.monotonic(), session.drawn, 0
        while time.monotonic() - began < SWEEP_SECONDS:
            change(n)
            n += 1
            yield 0.001
        spent = time.monotonic() - began
        results[name] = {"frozen_views_per_second": round((session.drawn - drawn) / spent, 1), "asked": n}
    results["main_thread_ms"] = {name: round(1000 * max(times), 1) for name, times in stalls.items()}
    results["main_thread_mean_ms"] = {name: round(1000 * sum(t) / len(t), 2) for name, t in stalls.items()}
    results["sweep_size"] = min((f.rgba.shape[1], f.rgba.shape[0]) for f in session.frames.values())
    yield from _free_view(scene, work, session, results)
    scene.splannequin.live_show = "guesses"
    yield from _tinted(session, results["sharp_width"])
    yield from press._shoot(work, "8-scrub-guesses")
    pid = session._process.pid
    yield from press._click("splannequin.live")
    since = time.monotonic()
    while session._process.poll() is None and time.monotonic() - since < 10:
        yield 0.05
    results["ended"] = {"pid": pid, "exit_code": session._process.poll()}


def _sweeps(scene: Any, trained: list[int]) -> list[tuple[str, Callable[[int], None]]]:
    """Sweeps to time: t* over the whole clip, then the camera's pose per turn at a fixed t*."""

    def instants(n: int) -> None:
        scene.splannequin.t_star = trained[(3 * n) % len(trained)]

    def poses(n: int) -> None:
        scene.frame_set(scene.frame_start + n % (scene.frame_end - scene.frame_start + 1))

    return [("sweep_t_star", instants), ("sweep_camera", poses)]


def _detailed(session: Any) -> Generator[float, None, float]:
    """Wait until the view shows a picture composited from plates; return the seconds."""
    since, before = time.monotonic(), {frame.request.seq for frame in session.frames.values()}
    while not any(f.request.detail and f.request.seq not in before for f in session.frames.values()):
        if time.monotonic() - since > 120:
            raise RuntimeError("the view at rest never was made of plates")
        yield 0.05
    spent = time.monotonic() - since
    yield 0.5
    return round(spent, 2)


def _tinted(session: Any, width: int) -> Iterator[float]:
    """Wait until the guesses are shown as sharp as the previous picture."""
    since = time.monotonic()
    while not any(f.request.show == "guesses" and f.rgba.shape[1] >= width for f in session.frames.values()):
        if time.monotonic() - since > 120:
            raise RuntimeError("the guesses never were shown sharp")
        yield 0.05
    yield 0.5


def _free_view(scene: Any, work: Path, session: Any, results: dict[str, Any]) -> Iterator[float]:
    """Show a free view with a cube in its centre."""
    import bpy
    from mathutils import Vector

    window = bpy.context.window_manager.windows[0]
    area = press._view(window)
    region = next(r for r in area.regions if r.type == "WINDOW")
    cloud = scene.splannequin.made[0].points
    places = sorted((cloud.matrix_world @ v.co for v in cloud.data.vertices), key=lambda p: p.y)
    middle = sum(places[len(places) // 4 : len(places) // 2], Vector()) / max(1, len(places) // 2 - len(places) // 4)
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.mesh.primitive_cube_add(size=0.25 * (scene.camera.matrix_world.translation - middle).length)
        bpy.context.object.location = middle
        area.spaces.active.region_3d.view_perspective = "PERSP"
        turn = area.spaces.active.region_3d
        turn.view_location = middle
        turn.view_rotation = scene.camera.matrix_world.to_quaternion()
        turn.view_distance = 0.9 * (scene.camera.matrix_world.translation - middle).length
    results["detail_seconds"].append((yield from _detailed(session)))
    yield from press._shoot(work, "8-scrub-free")


def _time(viewport: Any, results: dict[str, Any]) -> dict[str, list[float]]:
    """Time all functions of the extension on Blender's main thread: seconds by name, filled while it runs."""
    import bpy

    stalls: dict[str, list[float]] = {}

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any) -> Any:
            began = time.perf_counter()
            try:
                return function(*args)
            finally:
                stalls.setdefault(name, []).append(time.perf_counter() - began)

        return call

    viewport._draw, viewport._tick = timed("draw", viewport._draw), timed("live tick", viewport._tick)
    supervisor = press.addon_module("process.job_timer")
    bpy.app.timers.unregister(supervisor.tick)
    supervisor.tick = timed("tick", supervisor.tick)
    bpy.app.timers.register(supervisor.tick, persistent=True)
    return stalls


if __name__ == "__main__":
    status = press.on_a_shot(__file__, __doc__ or "", _play, "shot folder with a trained run `main`", ":98")
    if "bpy" not in sys.modules:
        sys.exit(status)
