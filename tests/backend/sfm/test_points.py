"""Points of a solve that training uses, and when they constrain depth too little."""

import numpy as np
import pytest

from torch_backend.contract import ExitCode, JobError
from torch_backend.sfm.points import LEAST_ANGLE_DEG, filter_points, refuse_narrow


def test_points_are_filtered():
    points = {
        "xyz": np.array([[0, 0, 1], [0, 0, 2], [0, 0, 3], [0, 0, 4], [0, 0, 5], [0, 0, 200]], np.float32),
        "rgb": np.zeros((6, 3), np.uint8),
        "error": np.array([0.5, 2.5, 0.5, 0.5, 0.5, 0.5], np.float32),
        "track": np.array([3, 9, 2, 9, 9, 9], np.uint16),
        "depth": np.array([1, 1, 1, -1, 1, 1], np.float32),
    }
    kept = filter_points(points, np.zeros((4, 3)))
    assert kept["xyz"][:, 2].tolist() == [1, 5]


def test_points_that_are_no_numbers_are_left_out():
    points = {
        "xyz": np.array([[0, 0, 1], [0, np.nan, 1], [0, 0, np.inf]], np.float32),
        "rgb": np.zeros((3, 3), np.uint8),
        "error": np.full(3, 0.5, np.float32),
        "track": np.full(3, 9, np.uint16),
        "depth": np.ones(3, np.float32),
    }
    assert filter_points(points, np.zeros((2, 3)))["xyz"].tolist() == [[0, 0, 1]]


def test_a_camera_that_hardly_moves_is_refused_in_words():
    refuse_narrow(LEAST_ANGLE_DEG)
    with pytest.raises(JobError, match="moves too little for depth") as refused:
        refuse_narrow(LEAST_ANGLE_DEG - 0.5)
    assert refused.value.exit_code == ExitCode.SOLVE and "sideways" in refused.value.hint
