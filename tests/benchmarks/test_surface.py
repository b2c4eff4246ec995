"""Distances of known points from a true surface."""

import numpy as np

from benchmarks.surface import distance_from_truth, figures
from benchmarks.synthetic.rays import RayScene
from benchmarks.synthetic.regions import View


def square(z, half):
    """(vertices [4, 3], triangles [2, 3]) of a square that faces along z."""
    corners = [(-half, -half, z), (half, -half, z), (half, half, z), (-half, half, z)]
    return np.array(corners, np.float32), np.array([[0, 1, 2], [0, 2, 3]])


def camera(x):
    """Camera at (x, 0, 0), looking along z."""
    viewmat = np.eye(4)
    viewmat[0, 3] = -x
    return View(viewmat, np.array([[60.0, 0, 32], [0, 60.0, 24], [0, 0, 1]]), 64, 48)


def test_distance_is_to_the_nearest_surface_seen_by_two_plates():
    (wall, faces), (card, _) = square(5.0, 9.0), square(2.0, 0.5)
    truth = RayScene(np.concatenate([wall, card]), np.concatenate([faces, faces + 4]))
    views = [camera(-0.1), camera(0.0), camera(0.1)]
    places = np.array([[1.8, 0, 5.05], [1.8, 0, 4.5], [0.1, 0, 2.04], [0.3, 0, 4.9], [-2.85, 0, 5.0], [2.0, 1.0, 5.0]])
    errors = distance_from_truth(places, truth, views)
    np.testing.assert_allclose(errors[[0, 1, 2, 5]], [0.01, 0.1, 0.02, 0.0], atol=1e-6)
    assert errors[3] == np.inf, "the card hides the wall there"
    assert errors[4] == np.inf, "one camera sees it"
    result = figures(errors)
    assert result["seen"] == 4 / 6 and np.isclose(result["median"], 0.015) and result["beyond"] in (0.5, 0.75)
