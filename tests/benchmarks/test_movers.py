"""Counts of the benchmark of motion mattes."""

import numpy as np
import pytest

from benchmarks.movers import frame_row, summary
from torch_backend.motion.mattes import MOVING, STILL, UNKNOWN


def test_recall_precision_and_the_worst_frames() -> None:
    rows, right = [], []
    for share in (1.0, 0.5):  # detected fraction of the arm, which is a fifth of the moving area
        moving, arm = np.zeros((40, 50), bool), np.zeros((40, 50), bool)
        moving[10:30, 10:35], arm[10:30, 10:15] = True, True
        matte = np.full((40, 50), UNKNOWN, np.uint8)
        matte[10 : 10 + round(20 * share), 10:15] = MOVING
        matte[0:5, 40:50] = MOVING  # a false detection
        rows.append(frame_row(matte, {"moving": moving, "arm": arm, "wall": arm}, 1))
        whole = np.where(moving, np.uint8(MOVING), np.uint8(STILL))
        whole[9, 10:35] = MOVING  # a border of one pixel is no error
        right.append(frame_row(whole, {"moving": moving, "arm": arm, "wall": arm}, 1))
    found = summary(rows)
    assert found["arm"] == pytest.approx(0.75) and found["worst"] == pytest.approx(0.5)
    assert found["moving"] == pytest.approx(0.15) and found["precision"] == pytest.approx(150 / 250)
    assert "wall" not in found
    assert summary(right) == {"precision": 1.0, "moving": 1.0, "arm": 1.0, "worst": 1.0}


def test_mattes_that_mark_nothing_have_no_precision() -> None:
    still = np.zeros((8, 8), np.uint8)
    row = frame_row(still, {"moving": np.ones((8, 8), bool)}, 1)
    assert summary([row]) == {"precision": None, "moving": 0.0}
