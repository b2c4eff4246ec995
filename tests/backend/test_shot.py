"""The shot folder: atomic writes, versions, names, disk space."""

import errno
import json
import os
import time

import pytest

from torch_backend.contract import Cancelled, ExitCode, JobError, SolveParams, sweep_half_written
from torch_backend.contract.files import patiently
from torch_backend.farm import records
from torch_backend.job import new_job
from torch_backend.shot import Shot, atomic_path, checked_name, content_key, need_disk, write_atomic, write_json


def test_create_open_update(tmp_path):
    root = tmp_path / "Ünï cödé.splannequin"
    Shot.create(root)
    shot = Shot.open(root)
    assert shot.info().name == "Ünï cödé"
    shot.update(first=3, last=9, t_star=5)
    assert Shot.open(root).info().t_star == 5


def test_open_says_what_is_missing(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"shot\.json"):
        Shot.open(tmp_path)


def test_newer_shot_is_refused(tmp_path):
    shot = Shot.create(tmp_path / "a")
    data = json.loads(shot.info_path.read_text())
    shot.info_path.write_text(json.dumps({**data, "version": 99}))
    with pytest.raises(ValueError, match="version 99"):
        Shot.open(shot.root)


def test_failed_write_leaves_the_old_file_and_no_debris(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, {"a": 1})
    with pytest.raises(OSError, match="full"), atomic_path(path) as partial:
        partial.write_bytes(b"half")
        raise OSError(errno.ENOSPC, "full")
    assert json.loads(path.read_text()) == {"a": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_a_file_that_is_being_written_has_hardly_a_longer_path(tmp_path):
    """Windows limits paths to 260 characters, and artists' projects have long paths."""
    names = set()
    for _ in range(100):
        with atomic_path(tmp_path / "checkpoint.safetensors") as partial:
            partial.touch()
            names.add(partial.name)
    assert len(names) == 100 and max(map(len, names)) <= len("checkpoint.safetensors") + 20


def test_write_error_is_reported_even_if_cleanup_fails(tmp_path):
    """On Windows, the writer of a picture may still have its file open."""
    with pytest.raises(Cancelled), atomic_path(tmp_path / "a.mp4") as partial:
        partial.mkdir()
        raise Cancelled


@pytest.mark.parametrize("refusals, windows, done", [(3, True, True), (4, True, False), (1, False, False)])
def test_what_windows_refuses_for_a_moment_is_tried_anew(refusals, windows, done):
    """On other systems, a refusal is final."""
    left = [PermissionError(errno.EACCES, "held")] * refusals

    def act() -> str:
        if left:
            raise left.pop()
        return "done"

    if done:
        assert patiently(act, 4, 0.0, windows) == "done"
    else:
        with pytest.raises(PermissionError):
            patiently(act, 4, 0.0, windows)
        assert len(left) == (0 if windows else refusals - 1)


def test_json_refuses_nan(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "a.json", {"x": float("nan")})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "name", ["../up", "a/b", "", ".", "x" * 65, "dot.", "end ", "main\n", "CON", "nul.take", "Com1", "lpt9 .x", "COM²"]
)
def test_names_cannot_leave_the_shot(name):
    with pytest.raises(ValueError, match="name"):
        checked_name(name, "run")


@pytest.mark.parametrize("name", ["main", "CONtact", "com10", "a b.c-d_e", "Träume", "auxiliary"])
def test_names_of_people_are_taken(name):
    assert checked_name(name, "run") == name


def test_need_disk_says_how_much(tmp_path):
    with pytest.raises(JobError, match="No space left") as caught:
        need_disk(tmp_path / "not" / "yet", 1e18, "the take")
    assert caught.value.exit_code == ExitCode.DISK


def test_content_key_follows_files(tmp_path):
    path = tmp_path / "a"
    write_atomic(path, b"1")
    before = content_key(path, {"a": 1})
    write_atomic(path, b"12")
    assert content_key(path, {"a": 1}) != before


def test_linked_folder_is_not_part_of_the_shot(tmp_path):
    shot = Shot.create(tmp_path / "a.splannequin")
    assert shot.own(shot.take("wide") / "preview") == shot.take("wide") / "preview"
    (tmp_path / "theirs").mkdir()
    (shot.root / "takes").symlink_to(tmp_path / "theirs", target_is_directory=True)
    (shot.root / "frames").write_text("")
    with pytest.raises(JobError, match=r"takes is a link to .*theirs"):
        shot.own(shot.take("wide") / "preview")
    with pytest.raises(JobError, match="frames is not a folder"):
        shot.own(shot.frames)


def test_two_hosts_with_one_process_number_do_not_meet(tmp_path):
    """Containers of a farm often have small process ids, and parts of a job may run twice at once."""
    path = tmp_path / "000001.exr"
    with atomic_path(path) as first, atomic_path(path) as second:
        first.write_bytes(b"1")
        second.write_bytes(b"2")
    assert path.read_bytes() == b"1" and [p.name for p in tmp_path.iterdir()] == ["000001.exr"]


@pytest.mark.parametrize("hours", [-3, 3])
def test_files_are_swept_by_the_clock_of_their_disk(tmp_path, monkeypatch, hours):
    """This computer's clock may differ by hours from that of the file server."""
    names = {age: f".{age}.{'a' * 12}.tmp.exr" for age in (0, 30, 90)}
    for minutes, name in names.items():
        (tmp_path / name).write_bytes(b"half")
        written = (tmp_path / name).stat().st_mtime - 60 * minutes
        os.utime(tmp_path / name, (written, written))
    now = time.time
    monkeypatch.setattr(time, "time", lambda: now() + 3600 * hours)
    sweep_half_written(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([names[0], names[30]])


@pytest.mark.skipif(os.name == "nt", reason="a link needs a privilege there")
def test_nothing_is_written_through_links_of_a_shot_from_anywhere(tmp_path):
    shot = Shot.create(tmp_path / "a.splannequin")
    (tmp_path / "elsewhere").mkdir()
    for folder in (shot.jobs, shot.farm):
        folder.symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    with pytest.raises(JobError, match="jobs is a link to .*elsewhere"):
        new_job(shot, "solve", SolveParams())
    records.write(shot.root, "solve", "", 0, 0, 1.0, 0.0)
    assert not list((tmp_path / "elsewhere").iterdir())
    os.remove(shot.farm)
    records.write(shot.root, "solve", "", 0, 0, 1.0, 0.0)
    assert [p.name for p in shot.farm.iterdir()] == ["solve.json"]


def test_what_killed_writers_leave_is_swept_and_nothing_else(tmp_path):
    """Covers this version and earlier ones, which named temporary files by process id. Files younger than an hour
    stay."""
    names = [".checkpoint.4711.tmp.safetensors", f".000001.{'a' * 32}.tmp.exr"]
    kept = [".mine.tmp.png", "checkpoint.tmp.safetensors", ".notes.tmp", f".young.{'b' * 32}.tmp.exr"]
    for name in names + kept:
        (tmp_path / name).write_bytes(b"half")
        if "young" not in name:
            os.utime(tmp_path / name, (0, 0))
    sweep_half_written(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(kept)
