"""Makes the small shot that all fault cases copy, and runs each kind of job on it undisturbed."""

from __future__ import annotations

import json
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.backend.conftest import Quiet, build_world, paint_motion
from torch_backend.contract import FreezeParams, MatteParams, TrainParams
from torch_backend.footage.images import write_png
from torch_backend.freeze import freeze_shot
from torch_backend.freeze.mattes.job import make_mattes
from torch_backend.shot import Shot
from torch_backend.train import train_shot

from .harness import Prepared, begun, complaints_about, copy_of, snapshot, start


def make_shot(root: Path) -> Prepared:
    """The shot, and footage and lassos for jobs."""
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
    Shot.create(root / "empty.splannequin", "empty")
    shutil.copy(root / "empty.splannequin" / "shot.json", files / "empty.json")
    return Prepared(shot.root, files)


def run_undisturbed(prepared: Prepared, root: Path, kinds: set[str]) -> None:
    """Runs the kinds of jobs, and keeps what they make as what is expected."""
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
