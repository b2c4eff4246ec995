"""Makes the small shot that all fault cases copy, and runs each kind of job on it undisturbed."""

from __future__ import annotations

import dataclasses
import json
import shutil
import subprocess
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from tests.backend.conftest import Quiet, build_world, paint_motion
from tests.backend.solved_room import handheld, write_clip
from torch_backend.contract import FreezeParams, ImportParams, MatteParams, SolveParams, TrainParams
from torch_backend.footage import FootageConfig, import_footage
from torch_backend.footage.images import write_png
from torch_backend.freeze import freeze_shot, open_take
from torch_backend.freeze.mattes.job import make_mattes
from torch_backend.shot import Shot, write_json
from torch_backend.train import train_shot

from .harness import KINDS, TAKE, Prepared, begun, blender_python, complaints_about, copy_of, snapshot, start


def make_shot(root: Path) -> Prepared:
    """Write the shot, and footage and lassos for jobs."""
    world = build_world(root)
    paint_motion(world)
    shot, files = world.shot, root / "files"
    train_shot(shot, TrainParams(iterations=120, holdout=8, max_gaussians=900, device="cpu"), Quiet())
    freeze_shot(
        shot,
        FreezeParams(take="base", t_star=108, first=104, last=107, detail="off", develop="off", device="cpu"),
        Quiet(),
    )
    (files / "clip").mkdir(parents=True)
    for n in range(8):
        pixels = (world.image(n, n / 15) * 255 + 0.5).byte().numpy()
        write_png(files / "clip" / f"{n + 1:04d}.png", pixels.repeat(3, 0).repeat(3, 1))
    _write_lassos(files / "drawn.json", "drawn", 30)
    _write_lassos(files / "lassos.json", "more", 10)
    make_mattes(shot, MatteParams(take="base", polygons=str(files / "drawn.json"), device="cpu"), Quiet())
    stations = {"import": ImportParams(source=str(files / "clip")), "solve": SolveParams()}
    request = {"version": 1, "name": "tiny", "amounts": {}}
    requests = {
        "stations": {step: dataclasses.asdict(params) for step, params in stations.items()},
        "take": {"takes": {"108": "new", "1": "base"}, "freeze": PARTS, "first": 104, "last": 107},
    }
    for name, more in requests.items():
        write_json(files / f"{name}.json", request | more)
    return Prepared(shot.root, files)


def _room(prepared: Prepared, folder: Path) -> None:
    clip = prepared.files / "room"
    clip.mkdir()
    write_clip(clip, handheld(9))
    import_footage(Shot.create(folder / SHOT), str(clip), FootageConfig(), Quiet())


def _opened(prepared: Prepared, folder: Path) -> None:
    shutil.copytree(prepared.shot, folder / SHOT)
    open_take(Shot(folder / SHOT), FreezeParams(take="new", only_missing=True, **PARTS), Quiet())


def _artist(prepared: Prepared, folder: Path) -> None:
    """Write a shot for Blender: with a lens, and an artist's file next to it."""
    shutil.copytree(prepared.shot, folder / SHOT)
    lens = {"camera_model": "SIMPLE_RADIAL", "distortion": [0.0], "focal_px": 60.0}
    write_json(folder / SHOT / "solve" / "solve.json", {"version": 1, "quality": "Known by construction.", **lens})
    command = [blender_python(), "-P", "-c", ARTIST, str(folder / "artist.blend")]
    subprocess.run(command, check=True, capture_output=True)


SHOT = "shot.splannequin"
PARTS: dict[str, Any] = {**TAKE, "detail": "off"}
ARTIST = """
import sys, bpy
render = bpy.context.scene.render
render.resolution_x, render.resolution_y, render.filepath = 64, 48, "//renders/"
bpy.context.scene.frame_start, bpy.context.scene.frame_end = 104, 107
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[-1])
"""
BASES: dict[str, Callable[[Prepared, Path], object]] = {
    "shot": lambda prepared, folder: shutil.copytree(prepared.shot, folder / SHOT),
    "empty": lambda _, folder: Shot.create(folder / SHOT, "empty"),
    "nothing": lambda *_: None,
    "room": _room,
    "opened": _opened,
    "artist": _artist,
}
"""Map from name to a function that writes the start folder of kinds.

The folders are: the prepared shot; an empty shot; nothing; a shot with frames to solve; the prepared shot with a take
that a farm opened; the prepared shot with a lens and an artist's .blend.
"""


def run_undisturbed(prepared: Prepared, root: Path, kinds: set[str]) -> None:
    """Run the kinds of jobs, and keep their files as the expected results."""
    for name in sorted({KINDS[kind].base for kind in kinds}):
        prepared.bases[name] = root / "bases" / name
        prepared.bases[name].mkdir(parents=True)
        BASES[name](prepared, prepared.bases[name])
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda kind: _undisturbed(prepared, root, kind), sorted(kinds)))


def _write_lassos(path: Path, name: str, left: int) -> None:
    polygon = [[left, 10], [left + 15, 10], [left + 15, 35], [left, 35]]
    path.write_text(json.dumps({"mattes": [{"name": name, "frame": 106, "polygon": polygon}]}), encoding="utf-8")


def _undisturbed(prepared: Prepared, root: Path, kind: str) -> None:
    folder = copy_of(prepared, kind, root / "undisturbed" / kind)
    child = start(folder, kind, prepared)
    before = begun(child)
    code = child.wait()
    assert code == 0, f"{kind} undisturbed: {code} {child.printed()} {complaints_about(child, code, folder)}"
    prepared.spans[kind] = before, max(0.2, time.monotonic() - child.began - before)
    prepared.finished[kind] = folder
    prepared.expected[kind] = snapshot(folder)
