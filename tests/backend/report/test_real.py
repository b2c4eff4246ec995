"""Regions of a real clip from its motion mattes: static, away from movers; unknown pixels belong to neither region."""

import numpy as np
import pytest
import torch

from benchmarks.report.real import far_from, motion_shares, near
from benchmarks.report.truth import RealScene
from tests.backend.conftest import build_world
from torch_backend.motion.mattes import MOVING, PAINTED, STILL, UNKNOWN, write_matte
from torch_backend.shot import Shot


@pytest.fixture(scope="module")
def shot(tmp_path_factory):
    return build_world(tmp_path_factory.mktemp("real")).shot


def painted(shot, frame: int) -> np.ndarray:
    """Paint a band of each label over the frame's matte."""
    info = shot.info()
    labels = np.full((info.height, info.width), STILL, np.uint8)
    labels[:, : info.width // 4] = MOVING
    labels[:, -info.width // 4 :] = UNKNOWN
    write_matte(shot.root / PAINTED / f"{frame:06d}.png", labels)
    return labels


def test_unknown_pixels_are_neither_moving_nor_static(shot):
    truth = RealScene(shot, instants=3)
    labels = torch.from_numpy(painted(shot, 109))
    found = truth.frame_regions(109, labels.shape[1], labels.shape[0])
    assert bool((found["moving"] == (labels == MOVING)).all())
    assert bool((found["static"] == (labels == STILL)).all())


def test_rigid_pixels_are_eight_pixels_from_movers(tmp_path):
    shot = Shot.create(tmp_path / "wide.splannequin")
    shot.update(width=640, height=12)
    labels = painted(shot, 1)
    share = motion_shares(shot, 1, 640, 12)["rigid"].numpy()
    edge = int(np.flatnonzero(labels[0] == MOVING)[-1])
    assert not share[:, : edge + 9].any() and share[:, edge + 9 : 480].all() and not share[:, 480:].any()


def test_a_repainted_matte_is_another_scene(shot):
    painted(shot, 107)
    before = RealScene(shot, instants=3).key
    labels = painted(shot, 107)
    write_matte(shot.root / PAINTED / "000107.png", np.full_like(labels, MOVING))
    assert RealScene(shot, instants=3).key != before


def test_a_frame_without_a_matte_is_refused(shot):
    with pytest.raises(ValueError, match="frame 900 .* has no motion matte"):
        motion_shares(shot, 900, 8, 8)


def test_near_is_measured_round_the_mask():
    mask = np.zeros((21, 21), bool)
    mask[10, 10] = True
    y, x = np.mgrid[-10:11, -10:11]
    assert (near(mask, 5.0) == (np.hypot(x, y) <= 5.0)).all()
    assert not near(np.zeros((4, 4), bool), 9.0).any()


def test_poses_far_from_the_instant():
    assert far_from(range(0, 40, 8), 0, 40) == [16, 24, 32]
    assert far_from([5], 10, 40) == []
