"""A purely rotating camera is distinguished from one that passes a wall, with known homographies."""

import numpy as np
import pytest

from torch_backend.sfm.pure_rotation import is_pure_rotation

SIZE, FOCAL = (640, 480), 600.0
LENS = np.array([[FOCAL, 0.0, 320.0], [0.0, FOCAL, 240.0], [0.0, 0.0, 1.0]])


def turn(yaw, pitch=0.0):
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    return np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]]) @ np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])


def pairs(moved):
    """(homographies, shifts of the picture's centre) of pairs whose second camera is transformed by `moved` [3, 3]."""
    homographies = np.array([LENS @ m @ np.linalg.inv(LENS) for m in moved])
    middle = np.array([320.0, 240.0, 1.0])
    mapped = homographies @ middle
    shifts = np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - middle[:2], axis=1)
    return homographies, shifts


TURNS = [turn(0.02 * n, 0.01 * n) for n in range(1, 12)]
FACING = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("focal", [0.0, FOCAL, 1.15 * FOCAL])
def test_rotations_are_turning_whether_the_focal_length_is_known_or_not(focal):
    assert is_pure_rotation(*pairs(TURNS), SIZE, focal)


def test_a_sway_of_a_hundredth_of_the_distance_is_turning_still():
    moved = [r + np.outer([0.01, 0.005, 0.0], FACING) for r in TURNS]
    assert is_pure_rotation(*pairs(moved), SIZE)


@pytest.mark.parametrize("normal", [FACING, np.array([0.6, 0.0, 0.8])])
def test_walking_past_a_wall_is_not(normal):
    """Homographies explain a wall as well as a rotation; seen frontally, both shift the picture's centre alike."""
    moved = [np.eye(3) + np.outer([0.02 * n, 0.0, 0.0], normal) for n in range(1, 12)]
    assert not is_pure_rotation(*pairs(moved), SIZE)
    turned = [r + np.outer([0.02 * n, 0.0, 0.0], normal) for n, r in enumerate(TURNS, 1)]
    assert not is_pure_rotation(*pairs(turned), SIZE)


def test_the_scale_of_a_homography_does_not_matter_and_none_at_all_is_no_turn():
    homographies, shifts = pairs(TURNS)
    assert is_pure_rotation(-3.0 * homographies, shifts, SIZE)
    assert not is_pure_rotation(np.zeros((0, 3, 3)), np.zeros(0), SIZE)
