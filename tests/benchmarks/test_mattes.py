"""The benchmark of mattes: its lassos are as sloppy as they say, and people are found in the scene's triangles."""

import json

import numpy as np

from benchmarks.mattes import faces_of_people, lasso, overlap, table


def disc(radius=20.0, size=64):
    y, x = np.mgrid[:size, :size] + 0.5
    return np.hypot(x - size / 2, y - size / 2) < radius


def test_a_lassos_corners_are_no_farther_off_than_it_is_sloppy():
    mask = disc()
    corners = np.array(lasso(mask, 4.0, 3.0, seed=1))
    off = np.abs(np.hypot(*(corners - 32.0).T) - 20.0)
    assert len(corners) > 20 and 1.0 < off.max() <= 3.0 + 1.2  # an outline of pixels is up to 1.2 inside of the circle
    exact = np.array(lasso(mask, 4.0, 0.0, seed=1))
    assert np.abs(np.hypot(*(exact - 32.0).T) - 20.0).max() <= 1.2


def test_people_are_found_by_the_order_of_the_movers(tmp_path):
    (tmp_path / "geometry").mkdir()
    movers = [("person0", True, 5), ("panel", True, 3), ("person1", False, 9), ("person2", True, 4)]
    np.savez(tmp_path / "geometry" / "static.npz", triangles=np.zeros((7, 3), int))
    for name, _, count in movers:
        np.savez(tmp_path / "geometry" / f"{name}.npz", triangles=np.zeros((count, 3), int))
    plan = {"movers": [{"name": name, "in_view": seen} for name, seen, _ in movers]}
    (tmp_path / "plan.json").write_text(json.dumps(plan), encoding="utf-8")
    assert faces_of_people(tmp_path) == {"person0": (7, 12), "person2": (15, 19)}


def test_overlap_and_table():
    one, two = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    one[:2], two[1:3] = True, True
    assert overlap(one, two) == 1 / 3 and overlap(~one, ~one) == 1.0
    rows = [{"person": "person0", "iou": iou, "first": 2.0, "others": 0.5} for iou in (0.9, 0.8)]
    assert table({"quick arm": rows})[2:] == [
        "| quick arm | person0 | 2 | 0.850 | 0.800 | 2.0 | 0.50 |",
        "| all | | 2 | 0.850 | 0.800 | 2.0 | 0.50 |",
    ]
