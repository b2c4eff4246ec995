"""The benchmark of mattes: lassos have the requested errors, and people are found in the scene's triangles."""

import json

import numpy as np
import pytest

from benchmarks.mattes import best_poses, faces_of_people, lassos, overlap, person_masks, table
from benchmarks.synthetic.folder import SyntheticScene
from benchmarks.two_instants import BASE, INSTANT, UNKNOWN, figures, owners


def disc(radius=20.0, size=64):
    y, x = np.mgrid[:size, :size] + 0.5
    return np.hypot(x - size / 2, y - size / 2) < radius


def test_lasso_corner_error_is_bounded_by_sloppiness():
    mask = disc()
    (drawn,), (straight,) = lassos(mask, 4.0, 3.0, seed=1), lassos(mask, 4.0, 0.0, seed=1)
    corners, exact = np.array(drawn), np.array(straight)
    error = np.abs(np.hypot(*(corners - 32.0).T) - 20.0)
    assert (
        len(corners) > 20 and 1.0 < error.max() <= 3.0 + 1.2
    )  # the outline of pixels is up to 1.2 px inside the circle
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


SIDES = {"person0": ((0, 4), (-1, 3)), "person1": ((0, 5), (-2, 6))}
"""Map from person to (x, depth in metres) at two instants; the persons are squares of 1 m that face the cameras."""


@pytest.fixture
def squares(tmp_path):
    """A wall at 8 m and two flat, square persons; cameras 1 to 3 are at x = -2, 0, 9."""
    (tmp_path / "geometry").mkdir()

    def square(x, z, half):
        return np.array([[x - half, -half, z], [x + half, -half, z], [x + half, half, z], [x - half, half, z]], "f4")

    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    np.savez(tmp_path / "geometry" / "static.npz", vertices=square(0, 8, 40), triangles=faces)
    for name, moments in SIDES.items():
        np.savez(tmp_path / "geometry" / f"{name}.npz", triangles=faces)
        np.save(tmp_path / "geometry" / f"{name}.npy", np.stack([square(*at, 0.5) for at in moments]))
    plan = {"movers": [{"name": name, "in_view": True} for name in SIDES]}
    (tmp_path / "plan.json").write_text(json.dumps(plan), encoding="utf-8")
    K = np.array([[60.0, 0.0, 60.0], [0.0, 60.0, 30.0], [0.0, 0.0, 1.0]])
    views = {n: np.eye(4) for n in (1, 2, 3)}
    for n, x in ((1, -2.0), (2, 0.0), (3, 9.0)):
        views[n][0, 3] = -x
    return SyntheticScene(tmp_path, "x", 0, "plain", "quick", 120, 60, 8.0, [1, 2], K, views, [1, 2], [1, 2, 3], {})


def test_a_lasso_is_drawn_where_most_of_a_person_is_seen(squares):
    masks = person_masks(squares, 1, [1, 2, 3])
    assert masks["person1"][2].sum() == 0 < masks["person1"][1].sum()  # hidden by person0
    assert best_poses(squares, 1, masks)["person1"] == 1


def test_a_pixel_belongs_to_the_instant_that_shows_its_surface(squares):
    owner = owners(squares, "person0", 1, 2, 2)  # person0 as at 2, all else as at 1, seen from x = 0
    assert owner[30, 40] == INSTANT, "person0 at the instant"
    assert owner[30, 60] == UNKNOWN, "person1, whom person0 hid at the base, stood elsewhere at the instant"
    assert owner[23, 60] == INSTANT, "the wall that person0 hid at the base"
    assert owner[5, 5] == BASE, "the wall, which both show"


def test_overlap_and_table():
    one, two = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    one[:2], two[1:3] = True, True
    assert overlap(one, two) == 1 / 3 and overlap(~one, ~one) == 1.0
    rows = [{"person": "person0", "iou": iou, "first": 2.0, "others": 0.5} for iou in (0.9, 0.8)]
    assert table({"quick arm": rows})[2:] == [
        "| quick arm | person0 | 2 | 0.850 | 0.800 | 2.0 | 0.50 |",
        "| all | | 2 | 0.850 | 0.800 | 2.0 | 0.50 |",
    ]


def test_what_two_instants_cost_is_counted_over_all_pixels():
    rows = [{"regions": {"whole": [10, 0.1, 0.01]}}, {"regions": {"whole": [10, 0.1, 0.19]}}]
    assert figures(rows, "whole") == pytest.approx((20.0, 20.0))
    assert figures([{"regions": {"person": [0, 0.0, 0.0]}}], "person") is None
