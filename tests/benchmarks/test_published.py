"""Frames of a published video, and measurements of a frozen frame against the clip's own frames."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.published import compared, main, video_frames
from torch_backend.contract import JobError
from torch_backend.freeze.take.video import write_video

WIDTH, HEIGHT = 96, 64


def picture(level: int) -> np.ndarray:
    """Picture with one grey in the left half and a darker one in the right half."""
    frame = np.full((HEIGHT, WIDTH, 3), level, np.uint8)
    frame[:, WIDTH // 2 :] //= 2
    return frame


@pytest.fixture(scope="module")
def video(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("published") / "frozen.mp4"
    write_video(path, [picture(40 * n + 40) for n in range(5)], 25.0)
    return path


def test_frames_come_by_their_place_and_by_halves(video):
    found = list(video_frames(video, [1, 3], (WIDTH // 2, HEIGHT), "left"))
    assert [frame.shape for frame in found] == [(HEIGHT, WIDTH // 2, 3)] * 2
    assert [float(frame.mean()) for frame in found] == pytest.approx([80, 160], abs=6)
    (right,) = video_frames(video, [3], (WIDTH // 2, HEIGHT), "right")
    assert float(right.mean()) == pytest.approx(80, abs=6)
    with pytest.raises(JobError, match="no frame 7"):
        list(video_frames(video, [1, 7], (WIDTH, HEIGHT)))


def test_what_moves_is_left_out_of_the_best_nine_tenths_and_blur_shows_in_the_gradient():
    plate = np.random.default_rng(0).integers(60, 200, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    moved = plate.copy()
    moved[:, : WIDTH // 12] = 255 - moved[:, : WIDTH // 12]
    row = compared(moved, plate)
    assert row["whole"] < 25.0 and row["best_90"] > 60.0
    soft = plate.astype(float)
    soft[:, 1:] = 0.5 * (soft[:, 1:] + soft[:, :-1])
    assert compared(plate, plate)["gradient"] == 1.0 > 0.9 > compared(soft.astype(np.uint8), plate)["gradient"]


def test_a_shot_that_is_none_is_one_sentence(tmp_path, video, capsys):
    assert main([str(tmp_path), "take", str(video), str(video)]) == 1
    assert "is not a shot folder" in capsys.readouterr().err
