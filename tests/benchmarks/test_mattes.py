"""The benchmark of mattes: its lassos are as sloppy as they say, and people are found in the scene's triangles."""

import json

import numpy as np
import pytest

from benchmarks.mattes import faces_of_people, lassos, overlap, table
from benchmarks.synthetic.draw import AMBIENT, LIGHT, Painter, draw
from benchmarks.synthetic.rays import RayScene
from benchmarks.synthetic.sizes import SIZES
from torch_backend.footage.images import write_png


def disc(radius=20.0, size=64):
    y, x = np.mgrid[:size, :size] + 0.5
    return np.hypot(x - size / 2, y - size / 2) < radius


def test_a_lassos_corners_are_no_farther_off_than_it_is_sloppy():
    mask = disc()
    (drawn,), (straight,) = lassos(mask, 4.0, 3.0, seed=1), lassos(mask, 4.0, 0.0, seed=1)
    corners, exact = np.array(drawn), np.array(straight)
    off = np.abs(np.hypot(*(corners - 32.0).T) - 20.0)
    assert len(corners) > 20 and 1.0 < off.max() <= 3.0 + 1.2  # an outline of pixels is up to 1.2 inside of the circle
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


def test_a_drawn_picture_has_the_texture_of_the_surface_and_the_sky(tmp_path):
    (tmp_path / "geometry").mkdir()
    (tmp_path / "textures").mkdir()
    picture = np.zeros((2, 2, 3), np.uint8)
    picture[0, 0], picture[1, 1] = (255, 0, 0), (0, 255, 0)  # top left, bottom right
    write_png(tmp_path / "textures" / "one.png", picture)
    plan = {"materials": [{"file": "one.png"}], "movers": [], "seed": 0, "kind": "plain", "key": ""}
    (tmp_path / "plan.json").write_text(json.dumps(plan), encoding="utf-8")
    corners = np.array([[-1, -1, 2], [3, -1, 2], [-1, 3, 2]], np.float32)
    uv = np.array([[[0, 1], [2, 1], [0, -1]]], np.float32)  # v goes up, y goes down: a texture is a square of 2
    material = np.zeros(1, int)
    np.savez(tmp_path / "geometry" / "static.npz", vertices=corners, triangles=[[0, 1, 2]], uv=uv, material=material)
    rays = np.array([[-0.4, -0.4, 1.0], [0.1, 0.1, 1.0], [0.0, 0.0, -1.0]])
    shown = Painter(tmp_path).paint(RayScene(corners, np.array([[0, 1, 2]])), np.zeros(3), rays)
    lit = AMBIENT + (1.0 - AMBIENT) * LIGHT[2] / np.linalg.norm(LIGHT)
    assert np.allclose(shown[:2], [[lit, 0.0, 0.0], [0.0, lit, 0.0]], atol=1e-5) and shown[2, 2] == 1.0
    with pytest.raises(ValueError, match="other frames"):
        draw(_named(tmp_path), tmp_path, SIZES["paper"])


def _named(folder):
    """A scene folder in a folder that is called like its size."""
    place = folder / "quick" / "x"
    place.mkdir(parents=True)
    (place / "plan.json").write_text((folder / "plan.json").read_text(encoding="utf-8"), encoding="utf-8")
    return place
