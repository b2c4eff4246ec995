"""Presses the five buttons of the panel in a real Blender window, in order, on a small clip; a picture of each state.

    python tests/addon/window/press_steps.py --blender BLENDER [--clip CLIP] [--last 24] [--output docs/images]

BLENDER is a Blender that has the extension installed (`--command extension install-file -r user_default -e ZIP`). Needs
Xvfb, xwd (x11-apps) and convert (imagemagick). This file is also the script that runs inside Blender. The script moves
the mouse over the sidebar with simulated events until it points at the wanted button, and clicks.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path

# With Mesa's shader cache, Blender 5.2 crashed with SIGBUS in a thread that compiles shaders.
os.environ.setdefault("MESA_SHADER_CACHE_DISABLE", "true")

STEPS = (
    ("1-import", "splannequin.import_clip"),
    ("2-solve", "splannequin.solve_camera"),
    ("3-train", "splannequin.train"),
    ("4-freeze", "splannequin.freeze"),
    ("5-bake", "splannequin.bake"),
)
WINDOW = tuple(int(n) for n in os.environ.get("SPLANNEQUIN_WINDOW", "1600x1000").split("x"))
"""Window size in pixels; change it with, for example, SPLANNEQUIN_WINDOW=960x600."""
PICTURE = os.environ.get("SPLANNEQUIN_PICTURE", "1280x")
"""Size of the window pictures, in ImageMagick's syntax."""
PLAN = "SPLANNEQUIN_PRESS_PLAN"
"""Environment variable with the plan of the script inside Blender, as JSON."""


def main() -> int:
    """Run the host's side: a display, Blender, and requested pictures. Exit status is 0 if all five steps ended."""
    args = _arguments()
    plan = {"clip": str(Path(args.clip).absolute()), "last": args.last, "t_star": args.t_star}
    results = _host(__file__, plan | {"stop_train": args.cancel_once}, args)
    return 0 if results.get("ended") == [name for name, _ in STEPS] else 1


def _host(
    script: str, plan: dict, args: argparse.Namespace, prepare: Callable[[Path], dict[str, str]] | None = None
) -> dict:
    """Run a script in Blender on a display and take the pictures that it requests; print and return its results.

    `prepare` fills the work folder, and returns the environment of Blender.
    """
    output = Path(args.output).absolute()
    output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="splannequin-window-") as work:
        environ = dict(os.environ) if prepare is None else prepare(Path(work))
        environ |= {"DISPLAY": args.display, PLAN: json.dumps({**plan, "work": work})}
        with screen(args.display):
            blender = subprocess.Popen(command(args.blender, script), env=environ)
            _serve(blender, Path(work), output, environ, args.limit)
        results_file = Path(work) / "told.json"
        lacking = {"error": "Blender ended without telling how it went."}
        results = json.loads(results_file.read_text()) if results_file.is_file() else lacking
    print(json.dumps(results, indent=1))
    return results


def on_a_shot(
    script: str,
    text: str,
    play: Callable[[dict, dict], Iterator[float]],
    needs: str,
    display: str,
    good: Callable[[dict], bool] = lambda results: True,
) -> int:
    """Run either side of a script on one shot: the host, or, inside Blender, `play(plan, results)`.

    Args:
        script: file of the script that Blender runs.
        text: description of the script, for --help.
        play: script of the artist; `plan` holds the shot's folder and a work folder, and `results` are printed last.
        needs: requirements on the shot, for --help.
        display: X display to open.
        good: whether the results are a success, provided that nothing failed.

    Returns:
        Exit status.
    """
    if PLAN in os.environ and "bpy" in sys.modules:
        import bpy

        plan = json.loads(os.environ[PLAN])
        report = {"blender": bpy.app.version_string}
        act(play(plan, report), Path(plan["work"]), report)
        return 0
    parser = argparse.ArgumentParser(description=text.partition("\n")[0])
    parser.add_argument("--blender", required=True, help="Blender with the extension installed")
    parser.add_argument("--shot", required=True, help=needs)
    parser.add_argument("--output", default="docs/images", help="folder for the pictures")
    parser.add_argument("--display", default=display, help="X display to open")
    parser.add_argument("--limit", type=float, default=300.0, help="seconds until Blender is ended")
    args = parser.parse_args()
    results = _host(script, {"shot": str(Path(args.shot).absolute())}, args)
    return 0 if "error" not in results and good(results) else 1


@contextlib.contextmanager
def screen(display: str) -> Iterator[None]:
    """Open a virtual X display of the window's size."""
    child = subprocess.Popen(["Xvfb", display, "-screen", "0", f"{WINDOW[0]}x{WINDOW[1]}x24"])
    try:
        time.sleep(2.0)
        yield
    finally:
        child.terminate()
        child.wait()


def command(blender: str, script: str, *files: str) -> list[str]:
    """Command line of a Blender whose window fills the display; it accepts simulated events and runs a script."""
    size = [str(n) for n in WINDOW]
    window = ["--gpu-backend", "opengl", "--enable-event-simulate", "--window-geometry", "0", "0", *size]
    return [blender, *files, *window, "--python", script]


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--blender", required=True, help="Blender with the extension installed")
    root = Path(__file__).resolve().parents[3]
    parser.add_argument("--clip", default=str(root / "examples" / "sitting.mp4"))
    parser.add_argument("--last", type=int, default=24, help="last frame of the clip to use")
    parser.add_argument("--t-star", type=int, default=12)
    parser.add_argument("--output", default=str(root / "docs" / "images"), help="folder for the pictures")
    parser.add_argument("--display", default=":99", help="X display to open")
    parser.add_argument("--limit", type=float, default=1500.0, help="seconds until Blender is ended")
    parser.add_argument("--cancel-once", action="store_true", help="cancel the training once before it may finish")
    return parser.parse_args()


def _serve(blender: subprocess.Popen[bytes], work: Path, output: Path, environ: dict[str, str], limit: float) -> None:
    """Take the pictures that the script inside Blender requests, until Blender ends."""
    until = time.monotonic() + limit
    while blender.poll() is None and time.monotonic() < until:
        _photograph(work, output, environ)
        time.sleep(0.1)
    if blender.poll() is None:
        blender.kill()


def _photograph(work: Path, output: Path, environ: dict[str, str]) -> None:
    """Take the requested pictures."""
    for request in sorted(work.glob("*.shoot")):
        picture = output / f"window-{request.stem}.jpg"
        dump = subprocess.run(["xwd", "-root", "-silent"], env=environ, capture_output=True, check=True).stdout
        convert = ["convert", "xwd:-", "-strip", "-resize", PICTURE, "-quality", "85", str(picture)]
        subprocess.run(convert, input=dump, check=True)
        request.unlink()


# ------------------------------------------------------------------------------------------------- inside Blender


def inside() -> None:
    """Start the script as a timer that advances `_play`."""
    plan = json.loads(os.environ[PLAN])
    act(_play(plan), Path(plan["work"]), None)


def act(play: Iterator[float], work: Path, results: dict | None) -> None:
    """Advance a script, which yields the seconds to wait; write `results` to the work folder and quit Blender."""
    import bpy

    def turn() -> float | None:
        try:
            return next(play)
        except StopIteration:
            pass
        except Exception as error:  # any error is reported, and Blender must not stay open until the time limit
            traceback.print_exc()
            if results is not None:
                results["error"] = f"{type(error).__name__}: {error}"
        if results is not None:
            (work / "told.json").write_text(json.dumps(results))
        bpy.ops.wm.quit_blender()
        return None

    bpy.app.timers.register(turn, first_interval=2.0, persistent=True)


def _play(plan: dict) -> Iterator[float]:
    """Play the artist; yield the seconds to wait between actions."""
    import bpy

    work = Path(plan["work"])
    results: dict = {"blender": bpy.app.version_string, "ended": [], "longest_tick_ms": 0.0}
    _time_ticks(results)
    yield from _arrange()
    scene = bpy.context.scene
    props = scene.splannequin
    yield from _shoot(work, "0-start")
    props.clip = plan["clip"]
    props.shot_path = str(work / "sitting.splannequin")
    props.use_range, props.first, props.last = True, 1, plan["last"]
    yield 0.5
    for name, operator in STEPS:
        if name == "4-freeze":
            bpy.context.scene.splannequin.choose_t_star = True
            bpy.context.scene.splannequin.t_star = plan["t_star"]
            yield 0.5
        for attempt in range(2 if plan["stop_train"] and name == "3-train" else 1):
            yield from _click(operator)
            yield from _watch(work, name, results, cancel=plan["stop_train"] and name == "3-train" and attempt == 0)
        (work / "told.json").write_text(json.dumps(results))
        if results["ended"][-1:] != [name]:
            return
    yield from _show_results(work)


def _time_ticks(results: dict) -> None:
    """Record the longest time for which the add-on's timer blocks Blender's main thread."""
    import bpy

    tick = _supervisor().tick
    bpy.app.timers.unregister(tick)

    def timed() -> float:
        began = time.perf_counter()
        pause = tick()
        results["longest_tick_ms"] = max(results["longest_tick_ms"], round(1000 * (time.perf_counter() - began), 1))
        return pause

    bpy.app.timers.register(timed, persistent=True)


def _show_results(work: Path) -> Iterator[float]:
    """Show the compositor's nodes and the picture, as an artist would look at them."""
    import bpy

    window = bpy.context.window_manager.windows[0]
    window.workspace = bpy.data.workspaces["Compositing"]
    yield 2.0
    area = next(a for a in window.screen.areas if a.type == "NODE_EDITOR")
    if hasattr(area.spaces.active, "show_region_asset_shelf"):  # it would cover the lower half of the group
        area.spaces.active.show_region_asset_shelf = False
    yield 0.5
    region = next(r for r in area.regions if r.type == "WINDOW")
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.node.view_all()
    yield 1.5
    yield from _shoot(work, "6-compositor")
    window.workspace = bpy.data.workspaces["Rendering"]
    yield 2.0
    yield from _shoot(work, "7-result")


def _arrange() -> Iterator[float]:
    """Show a 3D view with the sidebar open on the extension's tab, and close the splash screen."""
    import bpy

    window = bpy.context.window_manager.windows[0]
    preferences = bpy.context.preferences
    preferences.use_preferences_save = False
    preferences.view.show_splash = False
    preferences.view.render_display_type = "NONE"  # a render window would cover the panel
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    _move(window, 300, 500)
    window.event_simulate(type="ESC", value="PRESS", x=300, y=500)
    window.event_simulate(type="ESC", value="RELEASE", x=300, y=500)
    yield 0.5
    area = _view(window)
    area.spaces.active.show_region_ui = True
    yield 0.5
    region = _sidebar(area)
    region.active_panel_category = "Splannequin"
    region.tag_redraw()
    yield 1.0


def _view(window):
    return next(a for a in window.screen.areas if a.type == "VIEW_3D")


def _sidebar(area):
    return next(r for r in area.regions if r.type == "UI")


def _move(window, x: int, y: int) -> None:
    window.event_simulate(type="MOUSEMOVE", value="NOTHING", x=x, y=y)


def _click(operator: str, kind: str = "VIEW_3D") -> Iterator[float]:
    """Find the operator's button with the mouse, scrolling if necessary, and click it.

    The button is searched in the sidebar of the 3D view, or in the window region of another kind of area.
    """
    import bpy

    window = bpy.context.window_manager.windows[0]
    wanted = f"bpy.ops.{operator}("
    for look in range(12):
        area, region = _place(window, kind)
        shares = (0.8,) if operator.endswith(".cancel") else (0.33, 0.745, 0.85)  # small buttons are at the right
        rows = range(region.y + region.height - 8, region.y + 4, -9)
        for x, y in ((region.x + int(region.width * share), y) for share in shares for y in rows):
            _move(window, x + (y % 2), y)
            yield 0.03
            if not _under_mouse(window, area, region).startswith(wanted):
                continue
            window.event_simulate(type="LEFTMOUSE", value="PRESS", x=x, y=y)
            window.event_simulate(type="LEFTMOUSE", value="RELEASE", x=x, y=y)
            yield 0.5
            if kind == "VIEW_3D":  # in other areas, the opened dialog would close
                _move(window, region.x - 200, y)
                yield 0.3
            return
        if look == 0 and kind == "VIEW_3D":
            yield from _unfold()
        else:
            yield from _scroll_down(kind)
    raise RuntimeError(f"no button of {operator} was found in {kind}")


def _place(window, kind: str):
    """(area, region) in which a button is searched."""
    if kind == "VIEW_3D":
        return _view(window), _sidebar(_view(window))
    area = next(a for a in window.screen.areas if a.type == kind)
    return area, next(r for r in area.regions if r.type == "WINDOW")


def _unfold() -> Iterator[float]:
    """Open every step of the panel; by default only the current step is open."""
    import bpy

    for name, _ in STEPS:
        setattr(bpy.context.scene.splannequin, f"is_{name[2:]}_open", True)
    yield 0.5


def _scroll_down(kind: str = "VIEW_3D") -> Iterator[float]:
    """Turn the mouse wheel over the buttons."""
    import bpy

    window = bpy.context.window_manager.windows[0]
    _, region = _place(window, kind)
    x, y = region.x + region.width // 3, region.y + region.height // 2
    _move(window, x, y)
    yield 0.1
    for _ in range(4):
        window.event_simulate(type="WHEELDOWNMOUSE", value="PRESS", x=x, y=y)
    yield 0.5


def _under_mouse(window, area, region) -> str:
    """Python call of the operator button under the mouse, as Ctrl-C copies it; empty over anything else."""
    import bpy

    manager = bpy.context.window_manager
    manager.clipboard = ""
    with bpy.context.temp_override(window=window, area=area, region=region):
        if bpy.ops.ui.copy_python_command_button.poll():
            bpy.ops.ui.copy_python_command_button()
    return manager.clipboard


def _watch(work: Path, name: str, results: dict, cancel: bool) -> Iterator[float]:
    """Wait until the step ends; take a picture during it and one after. Record the outcome in `results`."""
    import bpy

    watch = _supervisor().watch_of(work / "sitting.splannequin")
    began, taken = time.monotonic(), False
    stage = "training" if name == "3-train" else ""
    share = {"2-solve": 0.3, "3-train": 0.3 if cancel else 0.6}.get(name, 0.05)  # the other steps end soon
    yield 1.0
    while watch.running() is not None:
        job = next((j for j in watch.jobs.values() if not j.ended), None)
        status = job.status if job is not None else None
        far = status is not None and status.fraction > share and status.stage.startswith(stage)
        drawn = watch.work is not None and watch.work.progress is not None and watch.work.progress.done > 0
        if not taken and (drawn if name == "5-bake" else far):
            yield from _shoot(work, f"{name}-running", settle=2)
            taken = True
            if cancel:
                yield from _click("splannequin.cancel")
        yield 0.2
    yield 1.5
    yield from _shoot(work, f"{name}-{'cancelled' if cancel else 'done'}")
    if cancel:
        return
    bad = [j.status.message for j in watch.jobs.values() if j.state != "done" and j.status is not None]
    failures = [sentence for sentence, _ in watch.failures.values()]
    if bad or failures:
        results.setdefault("failed", []).extend([*bad, *failures])
    else:
        results["ended"].append(name)
    results.setdefault("seconds", {})[name] = round(time.monotonic() - began, 1)
    results["frame"] = bpy.context.scene.frame_current


def _supervisor():
    return addon_module("process.job_timer")


def addon_module(name: str):
    """Module of the installed extension. Raises RuntimeError if the extension is not enabled."""
    found = [m for n, m in sys.modules.items() if n.endswith(f".splannequin.splannequin_addon.{name}")]
    if not found:
        raise RuntimeError("the extension is not enabled in this Blender")
    return found[0]


def _shoot(work: Path, name: str, settle: int = 12) -> Iterator[float]:
    """Request a picture from the host and wait until it is taken."""
    import bpy

    window = bpy.context.window_manager.windows[0]
    for step in range(settle):  # panels change size over several redraws, which mouse moves trigger
        _move(window, 400 + 5 * step, 300)
        for area in window.screen.areas:
            area.tag_redraw()
        yield 0.15
    request = work / f"{name}.shoot"
    request.touch()
    for _ in range(100):
        yield 0.2
        if not request.exists():
            return


if __name__ == "__main__":
    if PLAN in os.environ and "bpy" in sys.modules:
        inside()
    else:
        sys.exit(main())
