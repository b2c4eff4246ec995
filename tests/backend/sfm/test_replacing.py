"""A new solve replaces a finished one only when it is complete, wherever the process is killed."""

import hashlib
import shutil
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.backend.solved_room import to_solve_again
from torch_backend.cameras.stored import load_points
from torch_backend.contract import CameraPath, Cancelled
from torch_backend.scene import load_scene
from torch_backend.sfm.solving import SolveConfig, solve_shot
from torch_backend.shot import Shot

ROOT = Path(__file__).resolve().parents[3]
STALE = "colmap/rigs.bin", "stmap_undistort.exr", "stmap_redistort.exr"
AGAIN = """
import os, signal, sys
from torch_backend.contract import Reporter
from torch_backend.shot import Shot
from torch_backend.sfm.solving import SolveConfig, solve_shot

shot, at_stage, at_rename = Shot(sys.argv[1]), sys.argv[2], int(sys.argv[3])
renames = 0

class Report(Reporter):
    def progress(self, stage, done, total, message=""):
        if stage == at_stage and done >= 3:
            os.kill(os.getpid(), signal.SIGKILL)

def hook(event, args):
    global renames
    if event == "os.rename" and os.sep + "next" + os.sep in os.fspath(args[0]):
        renames += 1
        if renames == at_rename:
            os.kill(os.getpid(), signal.SIGKILL)

sys.addaudithook(hook)
solve_shot(shot, SolveConfig(), Report(), sys.argv[4])
"""


def contents(shot):
    """{name: hash} of the files that readers of a solved shot use; motion mattes come later and store their solve's
    key."""
    files = [p for folder in (shot.frames, shot.solve) for p in folder.rglob("*") if p.is_file()]
    read = [p for p in files if p.name != "colmap.log" and not {"scratch", "motion"} & {*p.parts}]
    return {p.relative_to(shot.root).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in read}


def of_old(shot, before):
    """True if all files that readers use are unchanged; leftovers of a killed process are ignored."""
    now = contents(shot)
    return {name: now.get(name) for name in before} == before


def killed(shot, cameras, stage="", rename=0):
    done = subprocess.run([sys.executable, "-c", AGAIN, shot.root, stage, str(rename), cameras], cwd=ROOT, check=False)
    assert done.returncode == -signal.SIGKILL


@dataclass
class Replaced:
    """A shot with stale files of the solve before, and a whole new solve of it."""

    before: dict
    cancelled: dict
    """After a new solve that was cancelled."""
    after: dict
    shot: Shot
    warnings: list


@pytest.fixture(scope="module")
def replaced(solved, tools, tmp_path_factory):
    shot, cameras = to_solve_again(solved, tmp_path_factory.mktemp("replaced"))
    for name in STALE:
        (shot.solve / name).write_bytes(b"of a solve of before")
    before, report = contents(shot), tools.recorder()
    with pytest.raises(Cancelled):
        solve_shot(shot, SolveConfig(), tools.recorder(cancel_at=("solve: undistort", 0.0)), cameras)
    cancelled = contents(shot)
    solve_shot(shot, SolveConfig(), report, cameras)
    return Replaced(before, cancelled, contents(shot), shot, report.warnings)


def test_a_cancelled_solve_leaves_the_one_before_it(replaced):
    assert replaced.cancelled == replaced.before and {f"solve/{name}" for name in STALE} <= set(replaced.before)


def test_a_new_solve_leaves_none_of_the_files_of_the_one_before_it(replaced):
    """ST maps were for the lens before. That they go is said."""
    solve = replaced.shot.solve
    assert {p.name for p in (solve / "colmap").iterdir()} == {"cameras.bin", "images.bin", "points3D.bin"}
    assert not any((solve / name).exists() for name in STALE)
    assert "The ST maps of the previous solve were for its lens and have been removed." in replaced.warnings


def test_a_killed_solve_leaves_the_one_before_it_or_is_whole_when_the_shot_is_opened_next(again, replaced):
    """It is killed while it writes, and, started again, while its files take their places: the cameras last."""
    shot, cameras = again
    before = contents(shot)
    killed(shot, cameras, stage="solve: undistort")
    assert of_old(Shot.open(shot.root), before)
    assert len(load_scene(shot).solved) == 8
    killed(shot, cameras, rename=20)
    assert not of_old(shot, before) and shot.cameras.read_bytes() != (replaced.shot.cameras).read_bytes()
    assert contents(Shot.open(shot.root)) == replaced.after != before
    assert not list(shot.solve.glob("next*"))
    path = CameraPath.load(shot.cameras)
    assert len(path.frames) == 15 and len(load_points(shot)["xyz"]) > 300


@pytest.mark.parametrize("linked", ["frames", "solve/colmap", "solve/next", "solve/next/frames", "takes"])
def test_opening_a_shot_moves_nothing_through_a_link(tmp_path, linked):
    shot, mine = Shot.create(tmp_path / "a.splannequin"), tmp_path / "mine"
    for name in ("frames/000001.png", "colmap/cameras.bin", "solve/colmap/cameras.bin", "000001.png", "cameras.bin"):
        (mine / name).parent.mkdir(parents=True, exist_ok=True)
        (mine / name).write_text("mine")
    for name in ("frames/000001.png", "solve/colmap/cameras.bin", "takes/000001.png"):
        (shot.solve / "next" / name).parent.mkdir(parents=True, exist_ok=True)
        (shot.solve / "next" / name).write_text("theirs")
    if linked.startswith("solve/next"):
        shutil.rmtree(shot.root / linked)
    (shot.root / linked).symlink_to(mine)
    Shot.open(shot.root)
    assert {p.read_text() for p in mine.rglob("*") if p.is_file()} == {"mine"}
    assert len([p for p in mine.rglob("*") if p.is_file()]) == 5
