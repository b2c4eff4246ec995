"""Frames rendered by several processes equal those of one, also if one is killed; no process is left behind."""

import dataclasses
import io
import os
import shutil
import signal
from pathlib import Path

import pytest

from torch_backend.contract import Cancelled, FreezeParams, JobError, TakeFolder, working_on
from torch_backend.freeze.take import frame_process
from torch_backend.freeze.take import frames as take_frames
from torch_backend.freeze.take.cameras import in_range
from torch_backend.freeze.take.folder import make_folders
from torch_backend.freeze.take.frames import render_frames
from torch_backend.freeze.take.plan import planned
from torch_backend.freeze.take.side_by_side import processes_for, render_side_by_side
from torch_backend.native import default_threads

needs_proc = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="only Linux lists processes there")


def opened(shot, take, report):
    """A take that is ready for rendering: (params, take, frames)."""
    params = FreezeParams(take=take, t_star=105, first=103, last=106)
    plan = planned(shot, params, report)
    make_folders(plan.folder, plan.spec)
    return params, plan, in_range(plan.whole, params)


def files(folder: TakeFolder):
    found = [p for p in folder.root.rglob("*") if p.suffix in (".exr", ".png") and p.stem.isdecimal()]
    return {p.relative_to(folder.root).as_posix(): p.read_bytes() for p in found}


def helpers():
    """Process ids of child processes that render frames."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            words = (entry / "cmdline").read_bytes()
        except OSError:
            continue
        if parent == os.getpid() and b"frame_process" in words:
            found.append(int(entry.name))
    return found


@pytest.fixture(scope="module")
def frozen_shot(trained_copy):
    return trained_copy.shot


@pytest.fixture(scope="module")
def one_process(frozen_shot, quiet):
    """(files, plate shares) of a take that one process rendered."""
    _, take, frames = opened(frozen_shot, "one-process", quiet())
    shares = render_frames(take, frames, set(), quiet())
    return files(take.folder), shares


@needs_proc
def test_what_a_killed_process_leaves_is_rendered_by_its_starter(frozen_shot, quiet, one_process):
    params, take, frames = opened(frozen_shot, "one-killed", quiet())

    class Killer(type(quiet())):
        killed = 0

        def check_cancelled(self):
            if not self.killed and (found := helpers()):
                os.kill(found[0], signal.SIGKILL)
                self.killed = found[0]

    report = Killer()
    shares = render_side_by_side(frozen_shot, params, take, frames, {103}, report, 2)
    expected = {name: data for name, data in one_process[0].items() if "000103" not in name}
    assert report.killed and files(take.folder) == expected and not helpers()
    assert sorted(shares) == [104, 105, 106] and all(shares[n].equal(one_process[1][n]) for n in shares)


@needs_proc
def test_a_cancel_ends_all_of_them_and_keeps_whole_frames(frozen_shot, quiet, one_process):
    params, take, frames = opened(frozen_shot, "all-cancelled", quiet())

    class Stop(type(quiet())):
        heard = 0

        def progress(self, stage, done, total, message=""):
            self.heard += done > 0

        def check_cancelled(self):
            if self.heard:
                raise Cancelled

    with pytest.raises(Cancelled):
        render_side_by_side(frozen_shot, params, take, frames, set(), Stop(), 2)
    assert not helpers()
    left = files(take.folder)
    assert len(left) < len(one_process[0]) and all(one_process[0][name] == data for name, data in left.items())


def test_error_in_one_process_is_reported_like_a_single_process(frozen_shot, quiet):
    """An unreadable plate ends the take with the same message."""
    params, take, frames = opened(frozen_shot, "one-unreadable", quiet())
    plate = frozen_shot.plate(104)
    data = plate.read_bytes()
    plate.write_bytes(data[:100])
    try:
        with pytest.raises(JobError) as by_one:
            render_frames(take, frames, set(), quiet())
        with pytest.raises(JobError) as by_two:
            render_side_by_side(frozen_shot, params, take, frames, set(), quiet(), 2)
    finally:
        plate.write_bytes(data)
    errors = [(error.value.message, error.value.hint, error.value.exit_code) for error in (by_one, by_two)]
    assert errors[0] == errors[1]


def test_nothing_is_written_under_the_former_name_of_a_shot_that_was_renamed(frozen_shot, quiet, monkeypatch):
    """What a process renders, in this process."""
    params, take, _ = opened(frozen_shot, "renamed", quiet())
    moved, write = frozen_shot.root.with_name("renamed.splannequin"), take_frames._write
    request = {
        "shot": str(frozen_shot.root), "folder": str(take.folder.root), "t_star": take.t_star, "keys": take.all_keys,
        "params": dataclasses.asdict(params), "frames": [103, 104],
    }  # fmt: skip

    def rename_and_write(*of):
        if frozen_shot.root.exists():
            frozen_shot.root.rename(moved)
        write(*of)

    monkeypatch.setattr(take_frames, "_write", rename_and_write)
    try:
        with pytest.raises((JobError, OSError)), working_on(frozen_shot.root):
            frame_process._render(request, io.BytesIO())
        assert moved.exists() and not frozen_shot.root.exists()
    finally:
        shutil.rmtree(frozen_shot.root, ignore_errors=True)
        moved.rename(frozen_shot.root)


def test_process_count_is_limited_by_cores_frames_and_memory():
    assert processes_for(300, 640 * 480, 16, 64e9) == 8
    assert processes_for(300, 640 * 480, 1, 64e9) == 1
    assert processes_for(30, 640 * 480, 16, 64e9) == 2
    assert processes_for(300, 3840 * 2160, 16, 8e9) == 2
    assert processes_for(300, 640 * 480, 16, 0.0) == 1


def test_thread_count_follows_torch(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert default_threads() == 1
