"""Partial takes: range and step, stale frames, and the grain layer."""

import json
import shutil

import numpy as np
import OpenImageIO as oiio

from torch_backend.contract import CameraFrame, CameraPath, FreezeParams
from torch_backend.footage.images import read_png, write_png
from torch_backend.freeze import freeze_shot
from torch_backend.freeze.exr import GRAIN_CHANNELS, read_frozen_exr
from torch_backend.shot import Shot, write_json
from torch_backend.train.checkpoint import load_checkpoint, save_checkpoint


def times(folder):
    return {int(p.stem): p.stat().st_mtime_ns for p in folder.glob("*.exr")}


def test_a_range_with_a_step_then_the_rest_of_it(trained, quiet):
    folder = trained.shot.take("part")
    ask = dict(take="part", t_star=104, develop="off", detail="off", only_missing=True)
    facts = freeze_shot(trained.shot, FreezeParams(**ask, first=102, last=108, step=3), quiet())
    some = times(folder)
    assert sorted(some) == [102, 105, 108]
    assert (facts["first"], facts["last"], facts["frames"]) == (102, 108, 3)
    facts = freeze_shot(trained.shot, FreezeParams(**ask, first=104, last=106), quiet())
    more = times(folder)
    assert sorted(more) == [102, 104, 105, 106, 108], "frames outside of the range stay"
    assert all(more[n] == some[n] for n in some), "and none of them is rendered again"
    assert (facts["first"], facts["last"], facts["frames"]) == (102, 108, 5)
    same, second_report = quiet(), quiet()
    freeze_shot(trained.shot, FreezeParams(**ask, first=104, last=104), same)
    assert times(folder) == more
    freeze_shot(trained.shot, FreezeParams(**{**ask, "t_star": 110}, first=104, last=105), second_report)
    warned = [{event[1] for event in report.events if event[0] == "warning"} for report in (same, second_report)]
    assert len(warned[1] - warned[0]) == 1, "it says that three frames go"
    assert sorted(times(folder)) == [104, 105], "at another instant none of the others is right"


def test_only_frames_whose_instant_changed_are_stale(trained, quiet):
    folder = trained.shot.take("held")
    ramp = {str(101 + n): 104.0 for n in range(16)}
    ask = dict(take="held", develop="off", detail="off", first=114, only_missing=True)
    freeze_shot(trained.shot, FreezeParams(**ask, t_star_per_frame=ramp), quiet())
    before = times(folder)
    released = ramp | {"115": 105.0, "116": 106.0}
    freeze_shot(trained.shot, FreezeParams(**ask, t_star_per_frame=released), quiet())
    after = times(folder)
    assert {n for n in after if after[n] != before[n]} == {115, 116}
    assert json.loads((folder / "take.json").read_text())["t_star_per_frame"] == released


def test_only_frames_whose_camera_changed_are_stale(trained, quiet, tmp_path):
    def path(shift: float) -> str:
        frames = []
        for n in (1, 2, 3):
            viewmat = trained.viewmats[7].clone()
            viewmat[0, 3] += shift if n == 3 else 0.0
            frames.append(CameraFrame(n, viewmat.flatten().tolist(), [60.0, 60.0, 32.0, 24.0], "blender"))
        write_json(tmp_path / "path.json", CameraPath(64, 48, frames).to_json())
        return str(tmp_path / "path.json")

    folder = trained.shot.take("move")
    ask = dict(take="move", develop="off", detail="off", t_star=108, only_missing=True)
    freeze_shot(trained.shot, FreezeParams(**ask, camera_path=path(0.0)), quiet())
    before = times(folder)
    freeze_shot(trained.shot, FreezeParams(**ask, camera_path=path(0.1)), quiet())
    after = times(folder)
    assert {n for n in after if after[n] != before[n]} == {3}


def test_a_newer_run_makes_every_frame_stale(trained, quiet):
    folder = trained.shot.take("run")
    ask = FreezeParams(take="run", t_star=104, develop="off", detail="off", first=101, last=102, only_missing=True)
    freeze_shot(trained.shot, ask, quiet())
    before = times(folder)
    checkpoint = trained.shot.run("main") / "checkpoint.safetensors"
    tensors, meta = load_checkpoint(checkpoint)
    save_checkpoint(checkpoint, tensors, {**meta, "trained_seconds": meta["trained_seconds"] + 1.0})
    freeze_shot(trained.shot, ask, quiet())
    assert all(before[n] != t for n, t in times(folder).items())


def test_frames_of_an_older_version_are_rerendered_with_a_note(trained, quiet):
    """Their previews do not name the take that they belong to."""
    folder = trained.shot.take("old")
    ask = FreezeParams(
        take="old", t_star=104, develop="off", detail="off", grain=False, first=101, last=102, only_missing=True
    )
    freeze_shot(trained.shot, ask, quiet())
    for path in folder.glob("preview/*.png"):
        write_png(path, read_png(path))
    before, report = times(folder), quiet()
    freeze_shot(trained.shot, ask, report)
    assert all(before[n] != t for n, t in times(folder).items())
    assert [event for event in report.events if "written by an earlier version" in str(event)]


def test_a_frame_with_a_file_of_another_take_is_rendered_again(trained, quiet):
    ask = dict(develop="off", first=101, last=102, only_missing=True)
    for take, t_star in (("here", 104), ("there", 110)):
        freeze_shot(trained.shot, FreezeParams(take=take, t_star=t_star, **ask), quiet())
    for kind in ("preview", "warp"):
        kept, foreign = (next(trained.shot.take(take).glob(f"{kind}/000102.*")) for take in ("here", "there"))
        data = kept.read_bytes()
        assert data != foreign.read_bytes()
        kept.write_bytes(foreign.read_bytes())
        before = times(trained.shot.take("here"))
        freeze_shot(trained.shot, FreezeParams(take="here", t_star=104, **ask), quiet())
        after = times(trained.shot.take("here"))
        assert kept.read_bytes() == data and before[101] == after[101] and before[102] != after[102], kind


def test_a_copied_shot_has_the_frames_that_it_had(trained, quiet, tmp_path):
    """`cp -r` changes the modification times of run and frames."""
    ask = FreezeParams(take="copied", t_star=105, first=101, last=102, only_missing=True)
    freeze_shot(trained.shot, ask, quiet())
    copy = Shot.open(shutil.copytree(trained.shot.root, tmp_path / "tiny.splannequin", copy_function=shutil.copyfile))
    before, instants = times(copy.take("copied")), copy.run("main") / "developed"
    developed = {p.name: p.stat().st_mtime_ns for p in instants.iterdir()}
    report = quiet()
    freeze_shot(copy, ask, report)
    assert times(copy.take("copied")) == before and developed
    assert {p.name: p.stat().st_mtime_ns for p in instants.iterdir()} == developed


def test_grain_layer_does_not_change_the_picture(trained, quiet):
    part = dict(t_star=104, develop="off", first=101, last=102, detail="off")
    facts = {
        grain: freeze_shot(trained.shot, FreezeParams(take=f"grain{grain}", grain=grain, **part), quiet())["grain"]
        for grain in (True, False)
    }
    one, second, plain = (
        read_frozen_exr(trained.shot.take(take) / f"{n:06d}.exr")
        for take, n in (("grainTrue", 101), ("grainTrue", 102), ("grainFalse", 101))
    )
    np.testing.assert_array_equal(one.rgba, plain.rgba)
    assert facts[False] is None and plain.grain is None
    for grain in facts:
        names = oiio.ImageBuf(str(trained.shot.take(f"grain{grain}") / "000101.exr")).spec().channelnames
        assert set(GRAIN_CHANNELS) & set(names) == (set(GRAIN_CHANNELS) if grain else set())
    assert len(facts[True]["deviation_8bit"]) == 3 and np.max(facts[True]["deviation_8bit"]) > 0
    assert one.grain.shape == one.rgba[..., :3].shape and one.grain.any()
    assert not np.array_equal(one.grain, second.grain)


def test_plate_pixels_carry_plate_grain(trained, quiet):
    ask = dict(t_star=104, develop="off", first=112, last=112)
    facts = freeze_shot(trained.shot, FreezeParams(take="plates", **ask), quiet())
    plates = read_frozen_exr(trained.shot.take("plates") / "000112.exr")
    assert np.max(facts["grain"]["deviation_8bit"]) > 0
    assert plates.detail.plate.min() < 0.9 and (plates.detail.plate == 1.0).mean() > 0.5
    plate_grain = plates.grain[plates.detail.plate == 1.0]  # half-float rounding turns a matte of 0.9999 into 1
    assert np.abs(plate_grain).max() < 1e-4 < np.abs(plates.grain).max()
