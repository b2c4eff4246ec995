"""A take rendered in parts equals one rendered at once, for any order, repeated, after a kill; other runs are
refused."""

import os

import pytest

from torch_backend.contract import FreezeParams, JobError
from torch_backend.freeze import finish_take, freeze_part, freeze_shot, open_take
from torch_backend.freeze.instant import instants as developed_instants
from torch_backend.freeze.instant.develop import DevelopConfig
from torch_backend.shot import write_json

ASK = dict(t_star=105, first=103, last=106, only_missing=True, deep=True)


@pytest.fixture(scope="module")
def frozen_shot(trained_copy, quiet):
    """Copy of the trained shot with a take that was rendered at once."""
    shot = trained_copy.shot
    freeze_shot(shot, FreezeParams(take="whole", **ASK), quiet())
    return shot


def files(folder):
    found = [p for p in folder.rglob("*") if p.suffix in (".exr", ".png") and p.stem.isdecimal()]
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in found}


def part(shot, take, first, last, report):
    return freeze_part(shot, FreezeParams(**{**ASK, "take": take, "first": first, "last": last}), report)


def test_frames_rendered_in_parts_equal_a_single_render(frozen_shot, quiet):
    params = FreezeParams(take="parts", **ASK)
    assert open_take(frozen_shot, params, quiet()) == {"t_star": 105, "first": 103, "last": 106, "frames": 4}
    assert part(frozen_shot, "parts", 106, 107, quiet()) == {"frames": 2, "rendered": 2}
    with pytest.raises(JobError, match=r"lacks 3 of 4 frames, the first is 103"):
        finish_take(frozen_shot, params, quiet())
    assert not (frozen_shot.take("parts") / "take.json").exists()
    assert part(frozen_shot, "parts", 103, 104, quiet()) == {"frames": 2, "rendered": 2}
    assert part(frozen_shot, "parts", 105, 105, quiet()) == {"frames": 1, "rendered": 1}
    assert part(frozen_shot, "parts", 900, 910, quiet()) == {"frames": 0, "rendered": 0}
    facts = finish_take(frozen_shot, params, quiet())
    assert (facts["first"], facts["last"], facts["frames"]) == (103, 107, 5)
    at_once, in_parts = files(frozen_shot.take("whole")), files(frozen_shot.take("parts"))
    assert len(at_once) == 16
    assert all(in_parts[name] == data for name, data in at_once.items())


def test_killed_part_is_rerendered_and_others_kept(frozen_shot, quiet):
    folder, params = frozen_shot.take("killed"), FreezeParams(take="killed", **ASK)
    open_take(frozen_shot, params, quiet())
    part(frozen_shot, "killed", 103, 104, quiet())
    before = (folder / "000103.exr").stat().st_mtime_ns
    (folder / "preview" / "000104.png").unlink()
    (folder / "000105.exr.tmp").write_bytes(b"half")
    open_take(frozen_shot, params, quiet())
    assert part(frozen_shot, "killed", 103, 105, quiet()) == {"frames": 3, "rendered": 2}
    assert (folder / "000103.exr").stat().st_mtime_ns == before
    assert part(frozen_shot, "killed", 103, 105, quiet()) == {"frames": 3, "rendered": 0}


def test_an_instant_that_two_develop_at_once_is_the_first_ones(frozen_shot, quiet, monkeypatch):
    path = frozen_shot.run("main") / "developed" / "000106.safetensors"
    make, first = developed_instants._make, []
    monkeypatch.setattr(developed_instants, "config_for", lambda run: DevelopConfig(steps=3))

    def meanwhile(*words):
        if not first:
            first.append(True)
            open_take(frozen_shot, FreezeParams(take="other", **{**ASK, "t_star": 106}), quiet())
            first.append(path.read_bytes())
        return make(*words)

    monkeypatch.setattr(developed_instants, "_make", meanwhile)
    open_take(frozen_shot, FreezeParams(take="late", **{**ASK, "t_star": 106}), quiet())
    inode = path.stat().st_ino
    assert path.read_bytes() == first[1]
    freeze_part(frozen_shot, FreezeParams(take="late", **{**ASK, "t_star": 106, "last": 103}), quiet())
    assert path.stat().st_ino == inode


def test_parts_of_what_was_not_opened_or_of_another_run_are_refused(frozen_shot, quiet):
    with pytest.raises(JobError, match="was not opened"):
        part(frozen_shot, "unopened", 103, 103, quiet())
    open_take(frozen_shot, FreezeParams(take="parts2", **ASK), quiet())
    state = frozen_shot.take("parts2") / "state.json"
    part(frozen_shot, "parts2", 103, 103, quiet())
    write_json(state, {"version": 1, "key": "other", "t_star": 105, "frames": "other"})
    with pytest.raises(JobError, match="another run, other footage"):
        part(frozen_shot, "parts2", 104, 104, quiet())
    open_take(frozen_shot, FreezeParams(take="parts2", **ASK), quiet())
    os.remove(frozen_shot.run("main") / "developed" / "000105.safetensors")
    with pytest.raises(JobError, match="is missing from the run"):
        part(frozen_shot, "parts2", 104, 104, quiet())


def test_frames_of_before_stay_until_the_take_is_finished(frozen_shot, quiet):
    params = FreezeParams(take="again", **{**ASK, "last": 104, "develop": "off"})
    freeze_shot(frozen_shot, params, quiet())
    params.t_star = 110
    open_take(frozen_shot, params, quiet())
    assert not (frozen_shot.take("again") / "take.json").exists(), "it told of another instant"
    assert (frozen_shot.take("again") / "000104.exr").is_file()
    params.last = 103
    freeze_part(frozen_shot, params, quiet())
    report = quiet()
    finish_take(frozen_shot, params, report)
    (warning,) = [event[1] for event in report.events if event[0] == "warning" and "take again" in event[1]]
    assert warning.endswith("not rendered again: 1.")
    assert sorted(p.name for p in frozen_shot.take("again").glob("*.exr")) == ["000103.exr"]
    assert not (frozen_shot.take("again") / "preview" / "000104.png").exists()


class Killed(BaseException):
    """Ends a part like a kill."""


def test_what_a_killed_part_of_another_instant_left_is_in_no_frame(frozen_shot, quiet, monkeypatch):
    params = FreezeParams(take="mixed", **{**ASK, "last": 103, "develop": "off"})
    freeze_shot(frozen_shot, params, quiet())
    folder, replace, before = frozen_shot.take("mixed"), os.replace, files(frozen_shot.take("mixed"))
    second_params = FreezeParams(take="mixed", **{**ASK, "last": 103, "t_star": 110, "develop": "off"})
    open_take(frozen_shot, second_params, quiet())

    def dies(source, target):
        replace(source, target)
        raise Killed

    with monkeypatch.context() as patched, pytest.raises(Killed):
        patched.setattr(os, "replace", dies)
        freeze_part(frozen_shot, second_params, quiet())
    assert not (folder / "take.json").exists() and files(folder) != before
    open_take(frozen_shot, params, quiet())
    freeze_part(frozen_shot, params, quiet())
    finish_take(frozen_shot, params, quiet())
    assert files(folder) == before


def test_a_part_stops_when_its_take_is_opened_with_something_else(frozen_shot, quiet):
    """A stalled host must not overwrite the new job's frames with old ones."""
    params = FreezeParams(take="straggler", **{**ASK, "last": 105, "develop": "off"})
    open_take(frozen_shot, params, quiet())
    second_params = FreezeParams(take="straggler", **{**ASK, "last": 105, "t_star": 110, "develop": "off"})

    class Meanwhile(type(quiet())):
        def check_cancelled(self):
            super().check_cancelled()
            if (frozen_shot.take("straggler") / "000103.exr").is_file() and not frames:
                frames.append(True)
                open_take(frozen_shot, second_params, quiet())
                freeze_part(frozen_shot, second_params, quiet())

    frames = []
    with pytest.raises(JobError, match="opened with other settings"):
        freeze_part(frozen_shot, params, Meanwhile())
    facts = finish_take(frozen_shot, second_params, quiet())
    assert frames and facts["frames"] == 3


def test_truncated_or_missing_file_of_a_frame_is_written_again(frozen_shot, quiet):
    params = FreezeParams(take="cut", **{**ASK, "last": 103, "deep": False})
    freeze_shot(frozen_shot, params, quiet())
    for name, share in (("000103.exr", 0.75), ("preview/000103.png", 0.75), ("warp/000103.exr", None)):
        file = frozen_shot.take("cut") / name
        data = file.read_bytes()
        file.unlink() if share is None else file.write_bytes(data[: int(len(data) * share)])
        freeze_shot(frozen_shot, params, quiet())
        assert file.read_bytes() == data, (name, share)
