"""Lasso files: reading, scaling, and refusals with a message."""

import json

import pytest

from torch_backend.contract import JobError
from torch_backend.freeze.mattes.lassos import Lasso, lasso_of, read_lassos

TRIANGLE = [[1, 2], [30, 4], [5, 20.5]]


def written(tmp_path, data):
    path = tmp_path / "lassos.json"
    path.write_text(json.dumps(data), encoding="utf-8")
    return path


def test_a_list_and_a_single_lasso_are_read(tmp_path):
    row = {"name": "man", "frame": 7, "polygon": TRIANGLE}
    expected = Lasso("man", 7, ((1.0, 2.0), (30.0, 4.0), (5.0, 20.5)))
    assert read_lassos(written(tmp_path, {"mattes": [row, row]}), 64, 48) == [expected, expected]
    assert read_lassos(written(tmp_path, row), 64, 48) == [expected]
    assert lasso_of(expected.to_json(), "it", 64, 48) == expected


def test_pixels_of_another_picture_are_scaled(tmp_path):
    row = {"name": "man", "frame": 7, "polygon": TRIANGLE, "width": 32, "height": 96}
    (lasso,) = read_lassos(written(tmp_path, row), 64, 48)
    assert lasso.polygon == ((2.0, 1.0), (60.0, 2.0), (10.0, 10.25))


@pytest.mark.parametrize(
    "row",
    [
        [],
        {"frame": 1, "polygon": TRIANGLE},
        {"name": "../out", "frame": 1, "polygon": TRIANGLE},
        {"name": "man", "frame": "1", "polygon": TRIANGLE},
        {"name": "man", "frame": True, "polygon": TRIANGLE},
        {"name": "man", "frame": 1, "polygon": TRIANGLE[:2]},
        {"name": "man", "frame": 1, "polygon": [*TRIANGLE, [1, "2"]]},
        {"name": "man", "frame": 1, "polygon": [*TRIANGLE, [1, 1e400]]},
        {"name": "man", "frame": 1, "polygon": [*TRIANGLE, "ab"]},
        {"name": "man", "frame": 1},
    ],
)
def test_what_cannot_be_is_refused(row):
    with pytest.raises(JobError):
        lasso_of(row, "Lasso 1", 64, 48)


def test_a_file_without_a_lasso_and_a_missing_one_are_refused(tmp_path):
    with pytest.raises(JobError, match="contains no lasso"):
        read_lassos(written(tmp_path, {"mattes": []}), 64, 48)
    with pytest.raises(JobError, match="does not exist"):
        read_lassos(tmp_path / "none.json", 64, 48)
