"""Reading a shot every second: unchanged files are not opened again, and changes are noticed."""

import json
import os
import sys
from pathlib import Path

import pytest

_opened: list[str] = []
_listening = [False]


def _note(event: str, arguments: tuple) -> None:
    # `open` with an opener is audited twice: by itself, and by `os.open`, whose event has no mode.
    if _listening[0] and event == "open" and arguments[1] is not None and isinstance(arguments[0], str | os.PathLike):
        _opened.append(os.fsdecode(arguments[0]))


@pytest.fixture
def opened():
    """opened(call): (result of the call, names of the files that it opened).

    An audit hook cannot be removed, so it is installed only once.
    """
    if "hooked" not in sys.modules[__name__].__dict__:
        sys.addaudithook(_note)
        sys.modules[__name__].__dict__["hooked"] = True

    def call(function, *arguments):
        _opened.clear()
        _listening[0] = True
        try:
            return function(*arguments), [Path(name).name for name in _opened]
        finally:
            _listening[0] = False

    return call


@pytest.fixture
def long_shot(shot) -> Path:
    """Shot with every file that is read: a run with a history, and a solve that is newer than the run."""
    run = shot / "runs" / "main"
    (run / "metrics.jsonl").write_text('{"seconds": 1.0, "heldout_psnr_db": 20.0}\n')
    (run / "config.json").write_text('{"solve": "another"}')
    (run / "checkpoint.safetensors").write_bytes(b"\0" * 16)
    os.utime(run / "checkpoint.safetensors", (1, 1))
    return shot


def test_what_did_not_change_is_not_opened_again(addon, long_shot, opened):
    read = addon("shot.inventory").read
    first, names = opened(read, long_shot)
    assert {"shot.json", "frames.json", "cameras.json", "solve.json", "summary.json", "take.json"} <= set(names)
    again, names = opened(read, long_shot)
    assert names == [] and again == first
    assert first.runs["main"]["has_new_cameras"] and first.runs["main"]["history"] == [(1.0, 20.0)]


def test_what_changed_is_seen_where_folders_have_no_date(addon, long_shot):
    """FAT and exFAT folders under Windows keep their creation date as modification date."""
    inventory = addon("shot.inventory")
    for name in ("runs/main/summary.json", "takes/freeze/take.json"):
        file = long_shot / name
        inventory.read(long_shot)
        stamp, dated = inventory.stamp(long_shot), file.parent.stat()
        file.write_text(json.dumps(json.loads(file.read_text()) | {"first": 2}))
        os.utime(file, ns=(0, file.stat().st_mtime_ns + 10**9))
        os.utime(file.parent, ns=(dated.st_atime_ns, dated.st_mtime_ns))
        assert inventory.stamp(long_shot) != stamp


def test_what_changed_is_read_again_and_only_that(addon, contract, long_shot, opened):
    read = addon("shot.inventory").read
    read(long_shot)
    (long_shot / "takes" / "freeze" / "000008.exr").touch()
    grown, names = opened(read, long_shot)
    assert grown.takes["freeze"]["frame_count"] == 4 and names == []
    info = json.loads((long_shot / "shot.json").read_text())
    contract.write_json(long_shot / "shot.json", info | {"name": "renamed"})
    with open(long_shot / "runs" / "main" / "metrics.jsonl", "a") as more:
        more.write('{"seconds": 2.0, "heldout_psnr_db": 21.0}\n')
    changed, names = opened(read, long_shot)
    assert changed.info["name"] == "renamed" and changed.runs["main"]["history"][-1] == (2.0, 21.0)
    assert sorted(names) == ["metrics.jsonl", "shot.json"]


def test_what_a_reader_adds_is_not_remembered(addon, long_shot):
    shots = addon("shot.inventory")
    shots.read(long_shot).takes["freeze"]["mine"] = True
    shots.read(long_shot).info["mine"] = True
    assert "mine" not in shots.read(long_shot).takes["freeze"] and "mine" not in shots.read(long_shot).info


def test_cache_size_is_bounded(addon, tmp_path, monkeypatch):
    kept = addon("shot.file_cache")
    monkeypatch.setattr(kept, "_MOST", 3)
    for n in range(6):
        (tmp_path / str(n)).write_text(str(n))
        assert kept.of(tmp_path / str(n), Path.read_text) == str(n)
    assert len(kept._known) == 3
    with pytest.raises(FileNotFoundError):
        kept.of(tmp_path / "gone", Path.read_text)
