"""The depth in the middle of a take's frame, from files that the backend's own writer made."""

import shutil
from pathlib import Path

import pytest

DATA = Path(__file__).resolve().parents[1] / "addon" / "data"


@pytest.fixture
def of_frame(addon):
    return addon("freeze.middle_depth").of_frame


@pytest.mark.parametrize("frame", [5, 6, 7])
def test_it_is_the_median_around_the_middle(of_frame, frame):
    # Depth is frame + x / 16 + y, but beyond reach at the first pixel: see make_frames.py.
    values = sorted(frame + x / 16 + y for y in range(12) for x in range(16) if (x, y) != (0, 0))
    assert of_frame(DATA / f"{frame:06d}.exr") == values[len(values) // 2]


def test_overscan_is_counted(of_frame):
    """Its picture is the same as that of frame 6, two pixels of which lie beyond the frame on each side."""
    assert of_frame(DATA / "overscan" / "000006.exr") == of_frame(DATA / "000006.exr")


@pytest.mark.parametrize("length", [0, 7, 100, 700, -40])
def test_a_damaged_file_tells_nothing(of_frame, tmp_path, length):
    whole = (DATA / "000006.exr").read_bytes()
    (tmp_path / "000006.exr").write_bytes(whole[:length])
    assert of_frame(tmp_path / "000006.exr") == 0.0
    shutil.copy(DATA / "make_frames.py", tmp_path / "000007.exr")
    assert of_frame(tmp_path / "000007.exr") == of_frame(tmp_path / "none.exr") == 0.0
