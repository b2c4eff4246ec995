"""Depth at the centre of a take's frame, from files of the backend's own writer."""

import shutil
from pathlib import Path

import pytest

DATA = Path(__file__).resolve().parents[1] / "addon" / "data"


@pytest.fixture
def of_frame(addon):
    return addon("freeze.middle_depth").of_frame


@pytest.mark.parametrize("frame", [5, 6, 7])
def test_it_is_the_median_around_the_middle(of_frame, frame):
    # Depth is frame + x / 16 + y, except for the first pixel, which has no depth: see make_frames.py.
    values = sorted(frame + x / 16 + y for y in range(12) for x in range(16) if (x, y) != (0, 0))
    assert of_frame(DATA / f"{frame:06d}.exr") == values[len(values) // 2]


def test_overscan_is_counted(of_frame):
    """The overscan file equals frame 6, but declares two pixels on the left and right as overscan."""
    assert of_frame(DATA / "overscan" / "000006.exr") == of_frame(DATA / "000006.exr")


@pytest.mark.parametrize("length", [0, 7, 100, 700, -40])
def test_a_damaged_file_tells_nothing(of_frame, tmp_path, length):
    whole = (DATA / "000006.exr").read_bytes()
    (tmp_path / "000006.exr").write_bytes(whole[:length])
    assert of_frame(tmp_path / "000006.exr") == 0.0
    shutil.copy(DATA / "make_frames.py", tmp_path / "000007.exr")
    assert of_frame(tmp_path / "000007.exr") == of_frame(tmp_path / "none.exr") == 0.0
