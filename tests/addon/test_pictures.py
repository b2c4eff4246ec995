"""The curve of the error and the source of its points."""

import json

import numpy as np


def test_the_curve_goes_from_corner_to_corner(addon):
    curve = addon("train.pictures").curve([(0.0, 20.0), (10.0, 24.0)], (64, 32))
    assert curve.shape == (32, 64, 4)
    drawn = curve[..., 0] > 0.9
    columns = drawn.argmax(0)
    assert drawn.any(0).all(), "every column has the line"
    assert columns[0] < 8 and columns[-1] > 22, "low on the left, high on the right (the first row is at the bottom)"
    assert (np.diff(columns) >= 0).all()


def test_points_come_from_the_runs_metrics(addon, shot):
    lines = [{"seconds": 1.0, "heldout_psnr_db": 20.0}, {"seconds": 2.0, "heldout_psnr_db": None}, {"other": 1}]
    text = "\n".join(json.dumps(line) for line in [*lines, {"seconds": 3.0, "heldout_psnr_db": 22.5}])
    (shot / "runs" / "main" / "metrics.jsonl").write_text(text + '\n{"seconds": 4')
    run = addon("shot.inventory").read(shot).runs["main"]
    assert run["history"] == [(1.0, 20.0), (3.0, 22.5)]
    assert run["preview"] is None


def test_icons_are_not_loaded_without_a_window(addon, tmp_path):
    assert addon("train.pictures").icon_of(tmp_path / "none.png") == 0
    assert addon("train.pictures").plot([(0.0, 1.0), (1.0, 2.0)]) == 0


def test_names_of_runs_and_takes_are_offered(addon, scene, shot):
    scene.splannequin.shot_path = str(shot)
    assert addon("train.settings").runs_of(scene.splannequin) == [("main", "24.0 dB, 12,345 Gaussians")]
    assert addon("freeze.settings").takes_of(scene.splannequin) == [("freeze", "t* 6, run main")]
