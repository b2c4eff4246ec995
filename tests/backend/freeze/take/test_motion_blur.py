"""Motion blur of a camera's own path: against a mean of many frames, on cameras that stand, and in keys."""

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
    """[4, 4] float64 between two world-to-camera poses: slerp of the rotation, line of centres."""
    a, b = np.linalg.inv(a), np.linalg.inv(b)
    pose = np.eye(4)
    pose[:3, :3] = Slerp([0, 1], Rotation.from_matrix([a[:3, :3], b[:3, :3]]))(share).as_matrix()
    pose[:3, 3] = (1 - share) * a[:3, 3] + share * b[:3, 3]
    return np.linalg.inv(pose)


def save_path(file, poses, first=1):
    """Writes a path of 64 x 48 pixels with these poses."""
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
    """Three poses that pan and travel, about 10 pixels a frame."""
    middle = trained_copy.viewmats[7].double().numpy()
    poses = []
    for n in (-1, 0, 1):
        shift = np.eye(4)
        shift[:3, :3] = Rotation.from_euler("yx", [6 * n + 2 * n * n, 2 * n], degrees=True).as_matrix()
        shift[:3, 3] = [0.25 * n, 0.05 * n * n, 0.1 * n]
        poses.append(shift @ middle)
    return poses


@pytest.mark.parametrize("detail", ["on", "off"])
def test_a_blurred_frame_is_the_mean_of_many(trained_copy, moves, tmp_path, quiet, detail):
    shot, ask = trained_copy.shot, dict(ASK, width=64, detail=detail)
    path = save_path(tmp_path / "path.json", moves)
    facts = freeze_shot(shot, FreezeParams(take=f"blur {detail}", camera_path=path, shutter=180.0, **ask), quiet())
    freeze_shot(shot, FreezeParams(take=f"sharp {detail}", camera_path=path, **ask), quiet())
    shares = (np.arange(32) + 0.5) / 32 - 0.5  # of a shutter that is open for half a frame
    cameras = [between(moves[1], moves[2 if s > 0 else 0], abs(s) / 2) for s in shares]
    many = save_path(tmp_path / "many.json", cameras)
    freeze_shot(shot, FreezeParams(take=f"many {detail}", camera_path=many, **ask), quiet())
    blurred, sharp = frames_of(shot, f"blur {detail}")[1], frames_of(shot, f"sharp {detail}")[1]
    mean = np.mean([each.rgba.astype(np.float64) for each in frames_of(shot, f"many {detail}")], axis=0)
    found, before = psnr(blurred.rgba[..., :3], mean[..., :3]), psnr(sharp.rgba[..., :3], mean[..., :3])
    print(detail, found, before)
    assert found > 32.0 and found > before + 3.0
    np.testing.assert_allclose(blurred.rgba[..., 3], mean[..., 3], atol=0.05)
    assert facts["shutter"] == 180.0 and "warp_dir" not in facts
    for name in ("depth", "support", "motion"):
        np.testing.assert_array_equal(getattr(blurred, name), getattr(sharp, name))
