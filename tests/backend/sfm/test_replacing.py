"""A new solve replaces a finished one only when it is complete, wherever the process is killed."""

import hashlib
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from torch_backend.cameras.stored import load_points
from torch_backend.contract import CameraPath, Cancelled
from torch_backend.scene import load_scene
from torch_backend.sfm.solving import SolveConfig, solve_shot
from torch_backend.shot import Shot

ROOT = Path(__file__).resolve().parents[3]
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


def test_a_cancelled_solve_leaves_the_one_before_it(again, tools):
    shot, cameras = again
    before = contents(shot)
    for stage in ("solve: lens", "solve: undistort"):
        with pytest.raises(Cancelled):
            solve_shot(shot, SolveConfig(), tools.recorder(cancel_at=(stage, 0.0)), cameras)
        assert contents(shot) == before


def test_a_solve_killed_while_it_writes_leaves_the_one_before_it(again, tools):
    shot, cameras = again
    before = contents(shot)
    killed(shot, cameras, stage="solve: undistort")
    assert of_old(Shot.open(shot.root), before)
    assert len(load_scene(shot).solved) == 11
    solve_shot(shot, SolveConfig(), tools.recorder(), cameras)
    assert not list(shot.solve.glob("next*")) and not (shot.solve / "scratch").exists()


@pytest.mark.parametrize("rename", [9, 26])
def test_a_solve_killed_while_it_takes_its_place_is_whole_when_the_shot_is_opened_next(again, tools, rename):
    shot, cameras = again
    whole = Shot(shutil.copytree(shot.root, shot.root.with_name("whole.splannequin")))
    solve_shot(whole, SolveConfig(), tools.recorder(), cameras)
    before = contents(shot)
    killed(shot, cameras, rename=rename)
    assert not of_old(shot, before)
    assert contents(Shot.open(shot.root)) == contents(whole) != before
    path = CameraPath.load(shot.solve / "cameras.json")
    assert len(path.frames) == 21 and len(load_points(shot)["xyz"]) > 300


def test_a_model_of_fewer_files_leaves_none_of_the_one_before_it(again, tools):
    shot, cameras = again
    (shot.solve / "colmap" / "rigs.bin").write_bytes(b"of a solve of before")
    solve_shot(shot, SolveConfig(), tools.recorder(), cameras)
    assert {p.name for p in (shot.solve / "colmap").iterdir()} == {"cameras.bin", "images.bin", "points3D.bin"}


def test_st_maps_of_the_lens_before_go_and_that_is_said(again, tools):
    shot, cameras = again
    maps = [shot.solve / name for name in ("stmap_undistort.exr", "stmap_redistort.exr")]
    for path in maps:
        path.write_bytes(b"of a solve of before")
    with pytest.raises(Cancelled):
        solve_shot(shot, SolveConfig(), tools.recorder(cancel_at=("solve: undistort", 0.0)), cameras)
    assert all(path.is_file() for path in maps)
    report = tools.recorder()
    solve_shot(shot, SolveConfig(), report, cameras)
    assert not any(path.exists() for path in maps)
    assert "The ST maps of the previous solve were for its lens and have been removed." in report.warnings
    report = tools.recorder()
    solve_shot(shot, SolveConfig(), report, cameras)
    assert not any("ST maps" in warning for warning in report.warnings)


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
