"""Motion blur of a camera path, compared with the mean of many frames; static cameras; keyed cameras."""

import json

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation, Slerp

from torch_backend.contract import NO_DEPTH, CameraFrame, CameraPath, FreezeParams
from torch_backend.footage.color import linear_to_srgb
from torch_backend.freeze import freeze_shot
from torch_backend.freeze.exr import read_frozen_exr
from torch_backend.freeze.frozen import OutputFrame
from torch_backend.freeze.take.motion_blur import MotionBlur, kept_grain
from torch_backend.shot import write_json

ASK = dict(t_star=105, develop="off", grain=False, only_missing=True)


def between(a, b, share):
    """[4, 4] float64: interpolated world-to-camera pose, by slerp of the rotation and linear centres."""
    a, b = np.linalg.inv(a), np.linalg.inv(b)
    pose = np.eye(4)
    pose[:3, :3] = Slerp([0, 1], Rotation.from_matrix([a[:3, :3], b[:3, :3]]))(share).as_matrix()
    pose[:3, 3] = (1 - share) * a[:3, 3] + share * b[:3, 3]
    return np.linalg.inv(pose)


def save_path(file, poses, first=1):
    """Write a camera path of 64 x 48 pixels with these poses."""
    K = [60.0, 60.0, 32.0, 24.0]
    frames = [CameraFrame(first + n, np.asarray(pose).flatten().tolist(), K, "blender") for n, pose in enumerate(poses)]
    write_json(file, CameraPath(64, 48, frames).to_json())
    return str(file)


def frames_of(shot, take):
    return [read_frozen_exr(path) for path in sorted(shot.take(take).glob("*.exr"))]


def times(folder):
    return {int(path.stem): path.stat().st_mtime_ns for path in folder.glob("*.exr")}


def psnr(a, b):
    a, b = (linear_to_srgb(each.clip(0, None)).clip(0, 1) for each in (a, b))
    return -10 * np.log10(np.square(a - b).mean())


@pytest.fixture(scope="module")
def moves(trained_copy):
    """Three poses of a panning and moving camera, about 10 pixels per frame."""
    middle = trained_copy.viewmats[7].double().numpy()
    poses = []
    for n in (-1, 0, 1):
        shift = np.eye(4)
        shift[:3, :3] = Rotation.from_euler("yx", [6 * n + 2 * n * n, 2 * n], degrees=True).as_matrix()
        shift[:3, 3] = [0.25 * n, 0.05 * n * n, 0.1 * n]
        poses.append(shift @ middle)
    return poses


@pytest.mark.parametrize("detail", ["on", "off"])
def test_blurred_frame_is_the_mean_of_its_samples(trained_copy, moves, tmp_path, quiet, detail):
    shot, ask = trained_copy.shot, dict(ASK, width=64, detail=detail, grain=True, first=2, last=2)
    path = save_path(tmp_path / "path.json", moves)
    facts = freeze_shot(shot, FreezeParams(take=f"blur {detail}", camera_path=path, shutter=180.0, **ask), quiet())
    freeze_shot(shot, FreezeParams(take=f"sharp {detail}", camera_path=path, **ask), quiet())
    shares = (np.arange(16) + 0.5) / 16 - 0.5  # times of a shutter that is open for half a frame
    cameras = [between(moves[1], moves[2 if s > 0 else 0], abs(s) / 2) for s in shares]
    many = save_path(tmp_path / "many.json", cameras)
    freeze_shot(shot, FreezeParams(take=f"many {detail}", camera_path=many, **{**ask, "first": 1, "last": 16}), quiet())
    blurred, sharp = frames_of(shot, f"blur {detail}")[0], frames_of(shot, f"sharp {detail}")[0]
    mean = np.mean([each.rgba.astype(np.float64) for each in frames_of(shot, f"many {detail}")], axis=0)
    found, before = psnr(blurred.rgba[..., :3], mean[..., :3]), psnr(sharp.rgba[..., :3], mean[..., :3])
    assert found > 45.0 and found > before + 10.0, "70 and 34 dB when it was made"
    np.testing.assert_allclose(blurred.rgba[..., 3], mean[..., 3], atol=0.05)
    assert facts["shutter"] == 180.0 and "warp_dir" not in facts
    for name in ("depth", "support", "motion"):
        np.testing.assert_array_equal(getattr(blurred, name), getattr(sharp, name))
    if detail == "on":
        plates = sharp.detail.plate > 0.5
        assert plates.mean() > 0.3
        kept, drawn = (np.abs(each.grain[plates]).mean() for each in (sharp, blurred))
        assert drawn > 1.5 * kept, "what the mean took from the plates' grain is drawn"


def test_static_camera_gives_no_blur(trained_copy, moves, tmp_path, quiet):
    shot, ask = trained_copy.shot, dict(ASK, width=64, grain=True)
    path = save_path(tmp_path / "path.json", [moves[1]] * 2)
    freeze_shot(shot, FreezeParams(take="stands", camera_path=path, shutter=360.0, **ask), quiet())
    freeze_shot(shot, FreezeParams(take="stands sharp", camera_path=path, **ask), quiet())
    for blurred, sharp in zip(frames_of(shot, "stands"), frames_of(shot, "stands sharp"), strict=True):
        for name in ("rgba", "depth", "grain", "support"):
            np.testing.assert_array_equal(getattr(blurred, name), getattr(sharp, name))


def test_only_frames_with_changed_blur_are_stale(trained_copy, moves, tmp_path, quiet):
    shot, ask = trained_copy.shot, dict(ASK, take="stale", width=32, detail="off")
    path, folder = str(tmp_path / "path.json"), shot.take("stale")

    def frozen(poses, shutter):
        save_path(path, poses)
        freeze_shot(shot, FreezeParams(camera_path=path, shutter=shutter, **ask), quiet())
        return times(folder)

    poses = [moves[0], moves[0], moves[1], moves[1]]
    before = frozen(poses, 180.0)
    assert frozen(poses, 180.0) == before
    after = frozen([*poses[:3], moves[2]], 180.0)
    assert {n for n in after if after[n] != before[n]} == {3, 4}, "the frame whose pose is another, and its neighbour"
    wider = frozen([*poses[:3], moves[2]], 90.0)
    assert all(wider[n] != after[n] for n in after)
    assert json.loads((folder / "take.json").read_text())["shutter"] == 90.0


def test_clip_path_gets_no_motion_blur_and_reports_it(trained_copy, quiet):
    ask, report = dict(ASK, take="clip", first=104, last=104, detail="off"), quiet()
    shot = trained_copy.shot
    freeze_shot(shot, FreezeParams(**ask), quiet())
    before = times(shot.take("clip"))
    facts = freeze_shot(shot, FreezeParams(shutter=180.0, **ask), report)
    assert times(shot.take("clip")) == before and facts["shutter"] == 0.0
    (said,) = [event for event in report.events if event[0] == "warning"]
    assert "No motion blur is added" in said[1]


def cameras(*poses):
    K = torch.tensor([[60.0, 0.0, 32.0], [0.0, 60.0, 24.0], [0.0, 0.0, 1.0]])
    return [OutputFrame(n + 1, torch.from_numpy(pose).float(), K, 1.0, 1.0) for n, pose in enumerate(poses)]


def shifted(x):
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


def test_a_blurs_length_is_its_geometry():
    """At depth 4 the camera moves by 0.4, then 0.8 per frame: 60 * 0.4 / 4 = 6 pixels, then 12."""
    blur = MotionBlur(cameras(shifted(0.0), shifted(-0.4), shifted(-1.2)), 180.0)
    depth = torch.full((48, 64), 4.0)
    depth[:10] = NO_DEPTH
    for frame, length in zip(blur.frames, (3.0, 4.5, 6.0), strict=True):  # at the ends the motion is extrapolated
        found = blur.lengths(frame, frame.K, depth, 0)
        np.testing.assert_allclose(found[10:], length, atol=1e-3)
        assert not found[:10].any()
        lower = blur.lengths(frame, frame.K, depth[20:], 20)
        np.testing.assert_allclose(lower, found[20:], atol=1e-5)
    places = [float(camera.viewmat[0, 3]) for camera in blur.sample_cameras(blur.frames[1], blur.frames[1].K, depth)]
    steps = np.diff(sorted([*places, -0.4]))
    assert steps.max() * 60 / 4 <= 1.0 and len(places) % 2 == 0
    assert min(places) > -0.4 - 0.2 and max(places) < -0.4 + 0.1, "within the shutter: 0.1 before, 0.2 after"


def test_blur_samples_are_bounded_and_a_single_frame_is_sharp():
    far = MotionBlur(cameras(shifted(0.0), shifted(-9.0)), 360.0)
    depth = torch.full((48, 64), 4.0)
    assert len(far.sample_cameras(far.frames[0], far.frames[0].K, depth)) == far.config.most - 1
    single = MotionBlur(cameras(shifted(0.0)), 360.0)
    assert single.sample_cameras(single.frames[0], single.frames[0].K, depth) == []


@pytest.mark.parametrize("softness", [0.0, 0.7, 1.5])
def test_kept_grain_matches_blurred_noise(softness):
    """Fraction of the variance left in noise that is sampled linearly and averaged along a line."""
    rng = np.random.default_rng(4)
    x = np.arange(-12, 13)
    row = np.exp(-0.5 * (x / softness) ** 2) if softness else (x == 0).astype(float)
    noise = np.array([np.convolve(line, row / row.sum(), "same") for line in rng.normal(size=(400, 400))])
    places = np.arange(100, 300) + 0.0
    for length in (1.0, 4.0, 12.0):
        shifts = (np.arange(32) + 0.5) / 32 * length
        read = np.array([[np.interp(places + d, np.arange(400), line) for line in noise] for d in shifts])
        found, expected = read.mean(axis=0).var() / read.var(), float(kept_grain(torch.tensor(length), softness))
        assert expected == pytest.approx(found, abs=0.07)
    assert float(kept_grain(torch.tensor(0.0), softness)) == 1.0
