"""Checks disabled buttons and truncated texts that stopped artists, in a real Blender window, with pictures.

    python tests/addon/window/stuck.py --blender BLENDER --backend PYTHON [--output docs/images]

BLENDER is any Blender: the extension is built from this checkout and installed into a separate home folder. PYTHON is
the backend's. The states, in this order: no backend, and the button that sets it up; the preferences at Blender's
default width; the clip after its import; presets with pixels and minutes, and the request for the scale; a suggested
t*; scrubbing stopped during a training; a moved project folder; a renamed shot folder, reported and located. Exit
status is 0 if all checks passed. Needs what press_steps.py needs.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import press_steps as press

ROOT = Path(__file__).resolve().parents[3]
WORLD = "from pathlib import Path; from tests.backend.conftest import build_world; build_world(Path({!r}))"
CHECKS = {
    "set_up_offered", "plate_seen", "scene_camera_kept", "scale_asked_for", "scale_known", "suggested",
    "stopped_at_work", "moved", "missed", "located",
}  # fmt: skip
"""Results that must be true."""


def main() -> int:
    """Run the host's side: a trained tiny world, an installed extension, and Blender on a display."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--blender", required=True)
    parser.add_argument("--backend", required=True, help="Python of the backend's environment")
    parser.add_argument("--output", default=str(ROOT / "docs" / "images"))
    parser.add_argument("--display", default=":93")
    parser.add_argument("--limit", type=float, default=900.0)
    args = parser.parse_args()

    def prepare(work: Path) -> dict[str, str]:
        _write_projects(work, args.backend)
        environ = {k: v for k, v in os.environ.items() if not k.startswith("SPLANNEQUIN_")}
        environ["HOME"] = str(work / "home")
        _install(args.blender, work, environ)
        return environ

    results = press._host(__file__, {"backend": args.backend}, args, prepare)
    lacking = sorted(name for name in CHECKS if results.get(name) is not True)
    print("did not hold: " + ", ".join(lacking) if lacking else "all of it held")
    return 1 if lacking or "error" in results else 0


def _write_projects(work: Path, backend: str) -> None:
    """Write a project with a clip to import, and one with a solved and trained shot."""
    (work / "home").mkdir()
    (work / "clip").mkdir()
    shutil.copy(ROOT / "examples" / "sitting.mp4", work / "clip" / "people.mp4")
    (work / "project").mkdir()
    shot = work / "project" / "tiny.splannequin"
    subprocess.run([backend, "-P", "-c", WORLD.format(str(shot.parent))], cwd=ROOT, check=True,
                   env={**os.environ, "PYTHONPATH": str(ROOT)})  # fmt: skip
    (shot / "solve" / "solve.json").write_text('{"version": 1, "quality": "Known by construction."}')
    flags = ["--iterations", "150", "--max-gaussians", "1500"]
    subprocess.run([backend, "-m", "torch_backend", "train", str(shot), *flags], cwd=ROOT, check=True)


def _install(blender: str, work: Path, environ: dict[str, str]) -> None:
    """Build the extension and install it as an artist does."""
    run = [blender, "--background", "--command", "extension"]
    subprocess.run([*run, "build", "--output-dir", str(work)], cwd=ROOT, env=environ, check=True)
    zips = [str(path) for path in work.glob("*.zip")]
    subprocess.run([*run, "install-file", "-r", "user_default", "-e", *zips], cwd=ROOT, env=environ, check=True)


# ------------------------------------------------------------------------------------------------- inside Blender


def _play(plan: dict[str, Any], results: dict[str, Any]) -> Iterator[float]:
    """Play the artist; yield the seconds to wait between actions."""
    import bpy

    work = Path(plan["work"])
    yield from press._arrange()
    bpy.context.preferences.view.filebrowser_display_type = "SCREEN"
    bpy.context.preferences.system.use_online_access = True
    yield from _no_backend(work, results)
    os.environ["SPLANNEQUIN_BACKEND_PYTHON"] = plan["backend"]
    press._supervisor()._backend = (None, 0.0)
    yield from _imported(work, results)
    yield from _solved(work, results)
    yield from _scrubbed(work, results)
    yield from _moved(work, results)
    yield from _renamed(work, results)
    yield from _preferences(work)


def _no_backend(work: Path, results: dict[str, Any]) -> Iterator[float]:
    """The red box contains the button that helps; the button asks before it downloads."""
    import bpy

    yield from press._shoot(work, "11-no-backend")
    yield from press._click("splannequin.set_up")
    results["set_up_offered"] = True
    window = bpy.context.window_manager.windows[0]
    for value in ("PRESS", "RELEASE"):
        window.event_simulate(type="ESC", value=value, x=300, y=500)
    yield 1.0


def _imported(work: Path, results: dict[str, Any]) -> Iterator[float]:
    """The clip is visible after its import; the cube and the scene's camera are unchanged."""
    import bpy

    bpy.ops.mesh.primitive_cube_add()
    scene, mine = bpy.context.scene, bpy.context.scene.camera
    props = scene.splannequin
    props.clip, props.use_range, props.first, props.last = str(work / "clip" / "people.mp4"), True, 1, 12
    yield 0.5
    yield from press._click("splannequin.import_clip")
    shot = work / "clip" / "people.splannequin"
    yield from _ended(shot)
    camera = press.addon_module("footage.plate").find(scene, shot)
    space = press._view(bpy.context.window_manager.windows[0]).spaces.active
    results["plate_seen"] = (
        camera is not None and space.camera == camera and space.region_3d.view_perspective == "CAMERA"
    )
    results["scene_camera_kept"] = scene.camera == mine
    yield from press._shoot(work, "11-imported", settle=0)


def _solved(work: Path, results: dict[str, Any]) -> Iterator[float]:
    """Open a solved and trained shot: the costs of the presets, and the request for the scale."""
    import bpy

    shot, scene = work / "project" / "tiny.splannequin", bpy.context.scene
    scene.splannequin.clip, scene.splannequin.shot_path = "", str(shot)
    yield 1.0
    yield from press._click("splannequin.load_camera")
    yield 1.0
    scaled = press.addon_module("solve.scale").scaled
    results["scale_asked_for"] = not scaled(scene, shot)
    yield from press._shoot(work, "11-presets-and-scale", settle=0)
    for name, x in (("one", 0.0), ("other", 1.0)):
        bpy.context.view_layer.objects.active = None
        empty = bpy.data.objects.new(name, None)
        empty.location = (x, 0.0, 0.0)
        scene.collection.objects.link(empty)
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
        bpy.ops.splannequin.align_scale(places=(0, 0, 0, 1, 0, 0), distance=1.0)
    yield 1.0
    results["scale_known"] = scaled(scene, shot)


def _scrubbed(work: Path, results: dict[str, Any]) -> Iterator[float]:
    """An unset t* uses the suggested instant and says so; scrubbing stops during a training."""
    import bpy

    shot, scene = work / "project" / "tiny.splannequin", bpy.context.scene
    props, viewport = scene.splannequin, press.addon_module("freeze.viewport")
    yield from press._click("splannequin.live")
    yield from _until(lambda: viewport.session() is not None and viewport.session().facts, 90, "the session")
    yield 2.0
    results["suggested"] = not props.choose_t_star and props.t_star == viewport.instant(scene)
    results["t_star"] = props.t_star
    yield from press._scroll_down()
    yield from press._shoot(work, "11-suggested")
    props.extend_steps = 30000  # long enough that the training still runs when the pause button is found
    yield from _scroll_up()
    yield from press._click("splannequin.train")
    watch = press._supervisor().watch_of(shot)
    yield from _until(lambda: (watch.jobs["train"].status or None) is not None, 60, "the training")
    yield 2.0
    yield from press._shoot(work, "11-stop-scrubbing", settle=0)
    yield from press._click("splannequin.live")
    yield 1.0
    results["stopped_at_work"] = viewport.session() is None and watch.running() == "train"
    yield from _scroll_up()
    yield from press._click("splannequin.cancel")
    press._move(bpy.context.window_manager.windows[0], 400, 300)  # the sidebar is laid out without the mouse over it
    yield from _ended(shot, failed=True)
    yield from press._shoot(work, "11-laid-out", settle=0)


def _moved(work: Path, results: dict[str, Any]) -> Iterator[float]:
    """Move the whole project folder."""
    import bpy

    bpy.ops.wm.save_as_mainfile(filepath=str(work / "project" / "work.blend"))
    yield 0.5
    destination = (work / "project").rename(work / "moved")
    yield from _opened(destination / "work.blend")
    scene = bpy.context.scene
    folder = press.addon_module("shot.selection").shot_folder(scene)
    camera = press.addon_module("solve.cameras").find(scene, folder, "CAMERA")
    results["moved"] = folder == destination / "tiny.splannequin" and camera is not None and scene.camera == camera
    yield from press._shoot(work, "11-moved")


def _renamed(work: Path, results: dict[str, Any]) -> Iterator[float]:
    """Rename only the shot folder: the panel reports it missing, and Locate finds it."""
    import bpy

    before, destination = work / "moved" / "tiny.splannequin", work / "moved" / "renamed.splannequin"
    before.rename(destination)
    watch = press._supervisor().watch_of(before)
    yield from _until(
        lambda: press.addon_module("shot.selection").missing(bpy.context.scene, watch.state),
        10,
        "the shot to be missed",
    )
    yield 1.0
    results["missed"] = not before.exists()
    yield from press._shoot(work, "11-missing")
    yield from press._click("splannequin.locate_shot")
    yield 1.5
    window = bpy.context.window_manager.windows[0]
    area = next(a for a in window.screen.areas if a.type == "FILE_BROWSER")
    area.spaces.active.params.directory = os.fsencode(f"{destination}/")
    yield 1.5
    region = next(r for r in area.regions if r.type == "WINDOW")
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.file.execute("INVOKE_DEFAULT")
    yield 2.0
    scene = bpy.context.scene
    camera = press.addon_module("solve.cameras").find(scene, destination, "CAMERA")
    results["located"] = (
        press.addon_module("shot.selection").shot_folder(scene) == destination and camera == scene.camera
    )
    yield from press._shoot(work, "11-located")


def _preferences(work: Path) -> Iterator[float]:
    """Show the add-on's page in the preferences window at the size that Blender gives the window."""
    import bpy

    module = press._supervisor().__name__.rpartition(".splannequin_addon")[0]
    bpy.context.preferences.active_section = "ADDONS"
    bpy.context.window_manager.addon_search = "Splannequin"
    bpy.ops.screen.userpref_show()
    yield 2.0
    bpy.ops.preferences.addon_expand(module=module)
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            area.tag_redraw()
    yield 2.0
    yield from press._shoot(work, "11-preferences", settle=0)


def _opened(file: Path) -> Iterator[float]:
    """Open another file, with the sidebar on the extension's tab."""
    import bpy

    bpy.ops.wm.open_mainfile(filepath=str(file))
    yield 2.0
    area = press._view(bpy.context.window_manager.windows[0])
    area.spaces.active.show_region_ui = True
    yield 0.5
    press._sidebar(area).active_panel_category = "Splannequin"
    yield 1.5


def _ended(shot: Path, failed: bool = False) -> Iterator[float]:
    """Wait until the shot's step ends. Raises RuntimeError with its message if it failed."""
    watch = press._supervisor().watch_of(shot)
    yield 1.0
    while watch.running() is not None:
        yield 0.2
    yield 1.5
    bad = [j.status.message for j in watch.jobs.values() if j.state == "failed" and j.status is not None]
    if (bad or watch.failures) and not failed:
        raise RuntimeError(" ".join([*bad, *(sentence for sentence, _ in watch.failures.values())]))


def _scroll_up() -> Iterator[float]:
    """Turn the mouse wheel over the sidebar until its first button is visible."""
    import bpy

    window = bpy.context.window_manager.windows[0]
    region = press._sidebar(press._view(window))
    x, y = region.x + region.width // 3, region.y + region.height // 2
    press._move(window, x, y)
    yield 0.1
    for _ in range(40):
        window.event_simulate(type="WHEELUPMOUSE", value="PRESS", x=x, y=y)
    yield 0.5


def _until(condition: Callable[[], Any], seconds: float, what: str) -> Iterator[float]:
    until = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > until:
            raise RuntimeError(f"waited {seconds:.0f} s for {what}")
        yield 0.2


if __name__ == "__main__":
    if press.PLAN in os.environ and "bpy" in sys.modules:
        import bpy

        plan = json.loads(os.environ[press.PLAN])
        results: dict[str, Any] = {"blender": bpy.app.version_string}
        press.act(_play(plan, results), Path(plan["work"]), results)
    else:
        sys.exit(main())
