"""Combined takes, compared with the world's truth: an object at another instant, and an object that keeps moving."""

import dataclasses
import json

import cv2
import numpy as np
import pytest
import torch

from tests.backend.conftest import outline
from torch_backend.contract import (
    CameraFrame,
    CameraPath,
    CombineParams,
    FreezeParams,
    JobError,
    MatteParams,
    SurfaceParams,
    TakeFolder,
)
from torch_backend.footage.color import srgb_to_linear
from torch_backend.footage.images import read_png
from torch_backend.freeze import freeze_shot
from torch_backend.freeze.exr import read_frozen_exr
from torch_backend.freeze.mattes.combined import Source, combine, combined, dilated, with_motion
from torch_backend.freeze.mattes.job import make_mattes
from torch_backend.freeze.surface.job import make_surface
from torch_backend.shot import write_json

FIRST, LAST = 104, 109
INSTANTS = {"early": 105, "late": 113}
"""Instants of the two takes; the patch's places differ."""


def covered(world, pose, t):
    """[H, W] bool: pixels that the patch covers from a pose at the time of frame `t`."""
    return world.patch(pose - 101, (t - 101) / 15) > 0.5


@pytest.fixture(scope="module")
def world(trained_copy, quiet, tmp_path_factory):
    """The tiny world with a take at each instant, and mattes of the patch in both takes."""
    world = trained_copy
    for name, t_star in INSTANTS.items():
        params = FreezeParams(take=name, t_star=t_star, first=FIRST, last=LAST, passes=True, develop="off")
        freeze_shot(world.shot, params, quiet())
        row = {"name": "patch", "frame": 107, "polygon": outline(covered(world, 107, t_star))}
        path = tmp_path_factory.mktemp("lassos") / "lassos.json"
        path.write_text(json.dumps({"mattes": [row]}), encoding="utf-8")
        make_mattes(world.shot, MatteParams(take=name, polygons=str(path)), quiet())
    return world


def frame_of(world, take, number):
    return read_frozen_exr(world.shot.take(take) / f"{number:06d}.exr")


def error(world, take, number, t, where):
    """Mean squared error in linear light against the world from a frame's pose at the time of frame `t`."""
    truth = srgb_to_linear(world.image(number - 101, (t - 101) / 15).numpy())
    return float(np.square(frame_of(world, take, number).rgba[..., :3] - truth)[where].mean())


def test_object_can_come_from_a_second_instant(world, quiet):
    result = combine(world.shot, CombineParams(take="both", base="early", things="patch=late"), quiet())
    assert result["frames"] == LAST - FIRST + 1 and result["combined"]["things"] == {"patch": "late"}
    everywhere = np.ones((48, 64), bool)
    ours, takes, uncombined = [], [], []
    for n in range(FIRST, LAST + 1):
        ours.append(error(world, "both", n, INSTANTS["late"], everywhere))
        takes.append(error(world, "late", n, INSTANTS["late"], everywhere))
        uncombined.append(error(world, "early", n, INSTANTS["late"], everywhere))
        combined_frame, early = frame_of(world, "both", n), frame_of(world, "early", n)
        near = cv2.dilate(np.float32(covered(world, n, 105) | covered(world, n, 113)), np.ones((15, 15))) > 0
        for layer in ("rgba", "depth", "support"):
            np.testing.assert_array_equal(getattr(combined_frame, layer)[~near], getattr(early, layer)[~near])
        late = covered(world, n, 113) & ~covered(world, n, 105)
        assert np.mean(combined_frame.depth[late] == frame_of(world, "late", n).depth[late]) > 0.5
        assert combined_frame.more.keys() == early.more.keys() >= {"Vector", "Normal", "Position", "DepthSigma"}
    # At most half a dB worse than the take of that instant alone, whose other pixels show the same world. Mattes at 64
    # pixels have errors of one pixel.
    assert np.mean(ours) <= np.mean(takes) * 10**0.05 and np.mean(ours) < 0.5 * np.mean(uncombined)
    preview = read_png(TakeFolder(world.shot.take("both")).preview(107)).astype(int)
    late_preview = read_png(TakeFolder(world.shot.take("late")).preview(107)).astype(int)
    assert np.abs(preview - late_preview)[covered(world, 107, 113)].mean() < 3


def test_live_object_moves_while_the_rest_is_frozen(world, quiet):
    combine(world.shot, CombineParams(take="alive", base="early", things="patch=live"), quiet())
    for n in (104, 107, 109):
        frame, now = frame_of(world, "alive", n), covered(world, n, n)
        inside = cv2.erode(np.uint8(now), np.ones((3, 3))) > 0
        assert error(world, "alive", n, n, inside) < 1e-3
        assert (frame.detail.source[inside] == n).mean() > 0.95 and (frame.detail.plate[inside] > 0.95).mean() > 0.95


def test_unchanged_frames_are_kept_and_changed_ones_recomputed(world, quiet):
    params = CombineParams(take="again", base="early", things="patch=late")
    combine(world.shot, params, quiet())
    folder = TakeFolder(world.shot.take("again"))
    before = {n: folder.frame(n).stat().st_mtime_ns for n in range(FIRST, LAST + 1)}
    folder.frame(106).write_bytes(b"cut off")
    combine(world.shot, params, quiet())
    after = {n: folder.frame(n).stat().st_mtime_ns for n in before}
    assert {n for n in before if before[n] != after[n]} == {106}
    combine(world.shot, CombineParams(take="again", base="late", things="patch=early"), quiet())
    assert all(folder.frame(n).stat().st_mtime_ns != after[n] for n in before)


def test_what_cannot_be_combined_is_said(world, quiet):
    def refused(match, **changes):
        with pytest.raises(JobError, match=match):
            combine(
                world.shot, CombineParams(**{"take": "x", "base": "early", "things": "patch=late", **changes}), quiet()
            )
        assert not world.shot.take("x").exists()

    refused("no matte 'dog'", things="dog=late")
    refused("no finished take 'never'", base="never")
    refused("names no matte and no take", things="patch")
    refused("Nothing says which thing", things="")
    with pytest.raises(JobError, match="contains frozen frames"):
        combine(world.shot, CombineParams(take="late", base="early", things="patch=late"), quiet())
    combine(world.shot, CombineParams(take="mine", base="early", things="patch=late"), quiet())
    with pytest.raises(JobError, match="combined from others"):
        freeze_shot(world.shot, FreezeParams(take="mine", t_star=105, first=FIRST, last=LAST), quiet())
    with pytest.raises(JobError, match="combined from others"):
        make_mattes(world.shot, MatteParams(take="mine"), quiet())
    combine(world.shot, CombineParams(take="mine", base="early", things="patch=live"), quiet())
    with pytest.raises(JobError, match="keeps moving"):
        make_surface(world.shot, SurfaceParams(take="mine"), quiet())
    freeze_shot(world.shot, FreezeParams(take="wide", t_star=105, last=102, detail="off", develop="off"), quiet())
    refused("has no matte", base="wide")


def from_path(world, quiet, tmp_path, take, t_star, shift=0.0):
    """A take of splats from a camera path of its own, with the patch's matte."""
    frames = []
    for n in (106, 107, 108):
        viewmat = world.viewmats[n - 101].clone()
        viewmat[0, 3] += shift
        frames.append(CameraFrame(n, viewmat.flatten().tolist(), [60.0, 60.0, 32.0, 24.0], "blender"))
    file = tmp_path / f"{take}.json"
    write_json(file, CameraPath(64, 48, frames).to_json())
    params = FreezeParams(take=take, t_star=t_star, camera_path=str(file), detail="off", develop="off")
    freeze_shot(world.shot, params, quiet())
    row = {"name": "patch", "frame": 107, "polygon": outline(covered(world, 107, t_star))}
    (tmp_path / "lassos.json").write_text(json.dumps({"mattes": [row]}), encoding="utf-8")
    make_mattes(world.shot, MatteParams(take=take, polygons=str(tmp_path / "lassos.json")), quiet())


def test_takes_combine_if_their_cameras_are_the_same_whatever_the_files_are_called(world, quiet, tmp_path):
    from_path(world, quiet, tmp_path, "one", 105)
    from_path(world, quiet, tmp_path, "two", 113)
    params = CombineParams(take="own", base="one", things="patch=two")
    assert combine(world.shot, params, quiet())["frames"] == 3
    from_path(world, quiet, tmp_path, "two", 113, shift=0.2)
    with pytest.raises(JobError, match="one and two differ in camera"):
        combine(world.shot, params, quiet())


def test_mattes_of_frames_that_were_frozen_again_are_refused(world, quiet):
    """The old matte shows where the patch stood at the old instant."""
    ask = {"take": "early", "first": FIRST, "last": LAST, "passes": True}
    params = CombineParams(take="stale", base="early", things="patch=late")
    freeze_shot(world.shot, FreezeParams(**ask, t_star=109), quiet())
    try:
        with pytest.raises(JobError, match="mattes of take early were made for other frames"):
            combine(world.shot, params, quiet())
        make_mattes(world.shot, MatteParams(take="early"), quiet())
        combine(world.shot, params, quiet())
    finally:
        freeze_shot(world.shot, FreezeParams(**ask, t_star=INSTANTS["early"]), quiet())
        make_mattes(world.shot, MatteParams(take="early"), quiet())


def test_a_live_object_is_left_out_of_frames_without_a_plate(world, quiet):
    record = json.loads(world.shot.listing.read_text())
    kept = {**record, "frames": [row for row in record["frames"] if row["frame"] != 107]}
    report = quiet()
    try:
        world.shot.listing.write_text(json.dumps(kept))
        combine(world.shot, CombineParams(take="gap", base="early", things="patch=live"), report)
    finally:
        world.shot.listing.write_text(json.dumps(record))
    assert any(event[0] == "warning" and "107" in event[1] for event in report.events)
    for layer in ("rgba", "depth", "support", "motion"):
        np.testing.assert_array_equal(*(getattr(frame_of(world, take, 107), layer) for take in ("gap", "early")))


def test_mask_selects_between_two_layers():
    base = frame_like(1.0)
    result = combined(base, frame_like(3.0), np.float32([[0.0, 0.25], [0.75, 1.0]]))
    np.testing.assert_allclose(result.rgba[..., 0], [[1.0, 1.5], [2.5, 3.0]])
    np.testing.assert_array_equal(result.depth, [[1.0, 1.0], [3.0, 3.0]])
    np.testing.assert_array_equal(result.more["Position"][..., 2], [[1.0, 1.0], [3.0, 3.0]])


def frame_like(value):
    from torch_backend.freeze.exr import FrameMetadata, FrozenFrame

    flat, meta = np.full((2, 2), value, np.float32), FrameMetadata(1, 1.0, np.eye(4, dtype="f4"), np.eye(3, dtype="f4"))
    more = {"Position": np.repeat(flat[..., None], 3, 2)}
    return FrozenFrame(np.repeat(flat[..., None], 4, 2), flat, flat, flat, meta, (0, 0), None, None, more)


class Lone(Source):
    """A take with one matte in memory."""

    def __init__(self, matte):
        super().__init__("take", TakeFolder("."), {}, {"it": ""}, "exr")
        object.__setattr__(self, "kept", matte)

    def matte(self, name, frame):
        return self.kept


def test_live_matte_includes_touching_pixels_with_soft_borders():
    matte, motion = np.zeros((40, 60), np.float32), np.zeros((40, 60), np.float32)
    matte[10:20, 10:20], motion[15:30, 18:25], motion[5:10, 50:55] = 1.0, 1.0, 1.0
    alive = with_motion(matte, np.zeros_like(matte), motion)
    assert alive[25, 22] == 1.0 and alive[7, 52] == 0.0 and alive[12, 12] == 1.0
    behind = np.zeros_like(matte)
    behind[18:34, 22:28] = 1.0  # another moving object, which is touched
    parted = with_motion(matte, behind, motion)
    assert parted[15, 19] == 1.0 and parted[25, 22] == 0.0 and np.array_equal(parted[matte > 0.5], matte[matte > 0.5])
    depth = np.where(motion > 0.5, 5.0, 2.0).astype(np.float32)  # all moving and touched pixels are far behind
    frame = dataclasses.replace(frame_like(0.0), motion=motion, depth=depth)
    lone = Lone(matte)
    assert lone.shows("it", 1, frame, is_live=False)[2, 25, 22] == 0.0
    assert lone.shows("it", 1, frame, is_live=True)[2, 25, 22] == 1.0
    soft = dilated(matte, 640)
    assert soft[15, 15] == pytest.approx(1.0, abs=1e-3) and 0.2 < soft[15, 23] < 1.0 and soft[15, 32] == 0.0
    assert torch.from_numpy(soft).isfinite().all()
