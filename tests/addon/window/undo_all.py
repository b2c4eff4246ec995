"""Undoes and redoes every operator that changes the scene, in a real Blender window, and compares the whole file.

    python tests/addon/window/undo_all.py --blender BLENDER --shot SHOT.splannequin [--output DIR]

BLENDER has the extension installed, as for press_steps.py; the shot has a run and a take. All of the file's data is
listed before and after each operator: undone, the list must be as before, and done again as after. Then a second shot
joins the file, is chosen and removed: the first must be whole. Prints what differs. Exit status 0 if nothing does.
"""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import press_steps as press

_SPARED = {"window_managers", "workspaces", "screens", "libraries", "brushes", "palettes", "paint_curves"}
"""What is no part of an undo step, or is loaded by Blender itself when an editor is opened."""
_UNREAD = {"pixels", "rna_type", "session_uid", "original", "id_data", "users", "tag", "is_evaluated", "bindcode"}
_DEPTH = 5


def file_state() -> dict[str, Any]:
    """Every data-block of the file -> its properties."""
    import bpy

    found: dict[str, Any] = {}
    for name in sorted(dir(bpy.data)):
        blocks = getattr(bpy.data, name)
        if isinstance(blocks, bpy.types.bpy_prop_collection) and name not in _SPARED:
            for block in blocks:
                _read(block, f"{name}[{block.name}]", found, _DEPTH)
                for key in block.keys():  # noqa: SIM118, not a dict
                    found[f"{name}[{block.name}][{key}]"] = str(block[key])
    return found


def _read(thing: Any, path: str, found: dict[str, Any], depth: int) -> None:
    """Properties of a struct and of what it holds, down to other data-blocks, which are named."""
    import bpy

    found[path] = type(thing).__name__
    for rna in thing.bl_rna.properties:
        name = rna.identifier
        if name in _UNREAD or name.startswith("is_") or depth == 0:
            continue
        value = getattr(thing, name, None)
        if rna.type == "COLLECTION":
            long = len(value) > 400  # vertices, points: their number and what Blender sums up of them must do
            found[f"{path}.{name}"] = len(value)
            for n, item in enumerate(() if long else value):
                if isinstance(item, bpy.types.ID):
                    found[f"{path}.{name}[{n}]"] = item.name
                else:
                    _read(item, f"{path}.{name}[{n}]", found, depth - 1)
        elif rna.type == "POINTER":
            embedded = isinstance(value, bpy.types.NodeTree) and value.name not in bpy.data.node_groups
            if isinstance(value, bpy.types.ID) and not embedded:
                found[f"{path}.{name}"] = value.name
            elif value is not None:
                _read(value, f"{path}.{name}", found, depth - 1)
        elif getattr(rna, "is_array", False):
            found[f"{path}.{name}"] = [round(v, 5) if isinstance(v, float) else v for v in _flat(value)]
        else:
            found[f"{path}.{name}"] = round(value, 5) if isinstance(value, float) else value


def _flat(value: Any) -> list[Any]:
    return [one for row in value for one in (_flat(row) if hasattr(row, "__len__") else [row])]


def difference(one: dict[str, Any], other: dict[str, Any]) -> list[str]:
    """What two states do not share, in words."""
    keys = sorted({*one, *other})
    return [f"{k}: {one.get(k)} -> {other.get(k)}" for k in keys if one.get(k) != other.get(k)]


def _scene() -> Any:
    """The window's scene: undo makes another one of it."""
    import bpy

    return bpy.context.window_manager.windows[0].scene


def play(plan: dict[str, Any], told: dict[str, Any]) -> Iterator[float]:
    """The artist: yields seconds to wait between what it does."""
    import bpy

    work = Path(plan["work"])
    shot, clip, second = work / "sitting.splannequin", work / "other.mp4", work / "second.splannequin"
    for folder in (shot, second):
        shutil.copytree(plan["shot"], folder, ignore=shutil.ignore_patterns("jobs", "lock.json"))
    clip.touch()
    told.update(differs={}, tried=[])
    yield from press._arrange()
    bpy.ops.wm.save_as_mainfile(filepath=str(work / "project.blend"))
    settings = _scene().splannequin
    settings.shot_path = str(shot)
    settings.take_name = sorted(path.name for path in (shot / "takes").iterdir() if (path / "take.json").is_file())[0]
    yield 2.0
    for name, act in (*_OPERATORS, *_of_two_shots(clip)):
        yield from _undone(told, name, act)
    yield from press._shoot(work, "undo-all")
    yield from _two_shots(shot, second, told, work)
    told["good"] = not told["differs"]


def _undone(told: dict[str, Any], name: str, act: Callable[[Any], Any]) -> Iterator[float]:
    """Does it, undoes it, does it again; notes what differs."""
    import bpy

    window = bpy.context.window_manager.windows[0]

    def step(how: Callable[[], Any]) -> None:
        area = press._view(window)
        region = next(r for r in area.regions if r.type == "WINDOW")
        with bpy.context.temp_override(window=window, area=area, region=region):
            how()

    step(lambda: bpy.ops.ed.undo_push(message="before"))
    yield 0.6
    before = file_state()
    try:
        step(lambda: act(bpy.ops.splannequin))
    except Exception as error:
        told["differs"][name] = [f"{type(error).__name__}: {error}"]
        return
    until = time.monotonic() + 60
    yield 0.6
    watch = press._supervisor().watch_of(Path(bpy.path.abspath(_scene().splannequin.shot_path or "//none")))
    while watch.running() and time.monotonic() < until:
        yield 0.2
    yield 0.6
    after = file_state()
    changed = difference(before, after)
    wrong = [] if changed else ["nothing was changed"]
    step(bpy.ops.ed.undo)
    yield 0.8
    if name in _IN_TURNS:  # the operator's own step, before that of what the timer did
        step(bpy.ops.ed.undo)
        yield 0.8
    wrong += [f"undone: {line}" for line in difference(before, file_state())]
    for _ in range(2 if name in _IN_TURNS else 1):
        step(bpy.ops.ed.redo)
        yield 0.8
    wrong += [f"redone: {line}" for line in difference(after, file_state())]
    told["tried"].append(f"{name} ({len(changed)})")
    if wrong:
        told["differs"][name] = wrong[:12]


_IN_TURNS = ("motion_over_plate",)
_SQUARE = [0.3, 0.3, 0.6, 0.3, 0.6, 0.7]


def _two(ops: Any) -> Any:
    """Two points of the solve, a metre apart."""
    return ops.align_scale("EXEC_DEFAULT", True, selected=False)


_OPERATORS: tuple[tuple[str, Callable[[Any], Any]], ...] = (
    ("load_camera", lambda ops: ops.load_camera("EXEC_DEFAULT", True)),
    ("t_star_marker", lambda ops: ops.t_star_marker("EXEC_DEFAULT", True)),
    ("t_star_here", lambda ops: (setattr(_scene(), "frame_current", 9), ops.t_star_here("EXEC_DEFAULT", True))),
    ("show_motion", lambda ops: ops.show_motion("EXEC_DEFAULT", True)),
    ("motion_over_plate", lambda ops: ops.motion_over_plate("EXEC_DEFAULT", True)),
    ("paint_motion", lambda ops: ops.paint_motion("EXEC_DEFAULT", True)),
    ("save_motion", lambda ops: ops.save_motion("EXEC_DEFAULT", True)),
    ("draw_matte", lambda ops: ops.draw_matte("EXEC_DEFAULT", True)),
    ("move_smooth", lambda ops: ops.move_smooth("EXEC_DEFAULT", True)),
    ("move_retime", lambda ops: ops.move_retime("EXEC_DEFAULT", True)),
    ("move_hold", lambda ops: ops.move_hold("EXEC_DEFAULT", True)),
    ("move_orbit", lambda ops: ops.move_orbit("EXEC_DEFAULT", True)),
    ("pick_take", lambda ops: ops.pick_take("EXEC_DEFAULT", True, name="new44")),
    ("insert_freeze", lambda ops: ops.insert_freeze("EXEC_DEFAULT", True)),
    ("combine_cg", lambda ops: ops.combine_cg("EXEC_DEFAULT", True)),
    ("freeze_as_warp", lambda ops: ops.freeze_as_warp("EXEC_DEFAULT", True)),
    ("add_splats", lambda ops: ops.add_splats("EXEC_DEFAULT", True)),
    ("remove_shot", lambda ops: ops.remove_shot("EXEC_DEFAULT", True)),
)


def _of_two_shots(clip: Path) -> tuple[tuple[str, Callable[[Any], Any]], ...]:
    return (
        ("shot_add", lambda ops: ops.shot_add("EXEC_DEFAULT", True)),
        ("use_clip", lambda ops: ops.use_clip("EXEC_DEFAULT", True, filepath=str(clip))),
        ("shot_remove", lambda ops: ops.shot_remove("EXEC_DEFAULT", True)),
        (
            "locate_shot",
            lambda ops: ops.locate_shot("EXEC_DEFAULT", True, directory=str(clip.with_name("second.splannequin"))),
        ),
    )


def _two_shots(shot: Path, second: Path, told: dict[str, Any], work: Path) -> Iterator[float]:
    """Both shots in the file, each with its camera and one with the compositor; the second goes again."""
    import bpy

    window = bpy.context.window_manager.windows[0]

    def press_all(*names: str, **facts: Any) -> None:
        with bpy.context.temp_override(window=window, area=press._view(window)):
            for name in names:
                getattr(bpy.ops.splannequin, name)("EXEC_DEFAULT", True, **facts)

    settings = _scene().splannequin
    settings.shot_path = str(shot)
    yield 1.0
    press_all("load_camera", "insert_freeze")
    yield 1.0
    alone = file_state()
    press_all("shot_add")
    _scene().splannequin.shot_path = str(second)
    yield 1.5
    press_all("load_camera")
    yield 1.0
    yield from press._shoot(work, "two-shots-second")
    cameras = [_scene().camera.name]
    for index in (0, 1, 0):
        _scene().splannequin.active_shot = index
        yield 1.0
        cameras.append(_scene().camera.name)
    told["cameras"] = cameras
    if not cameras[0] == cameras[2] != cameras[1] == cameras[3]:
        told["differs"]["switching"] = cameras
    yield from press._shoot(work, "two-shots-first")
    _scene().splannequin.active_shot = 1
    yield 0.5
    press_all("shot_remove", things=True)
    yield 1.0
    left = [line for line in difference(alone, file_state()) if ".splannequin.made" not in line]
    if left:
        told["differs"]["a second shot came and went"] = left[:30]
    yield from press._shoot(work, "two-shots-removed")


if __name__ == "__main__":
    status = press.on_a_shot(
        __file__, __doc__ or "", play, "shot folder with a take", ":94", good=lambda told: bool(told.get("good"))
    )
    if "bpy" not in sys.modules:
        sys.exit(status)
