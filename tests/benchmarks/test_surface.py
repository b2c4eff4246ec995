"""Distances from a true surface, of places that are known."""

import numpy as np

from benchmarks.surface import off_truth


def view(x, wall, size=(48, 64)):
    """A camera at (x, 0, 0) that looks along z at a wall."""
    viewmat = np.eye(4)
    viewmat[0, 3] = -x
    return viewmat, np.array([[60.0, 0, 32], [0, 60.0, 24], [0, 0, 1]]), np.full(size, wall, np.float64)


def test_it_is_the_second_best_of_the_poses_that_see_a_place():
    before = view(0.2, 5.0)
    before[2][:, :40] = 2.0  # something stands in front of the wall, for this camera alone
    views = [view(-0.1, 5.0), view(0.0, 5.0), before]
    places = np.array([[0.0, 0.0, 5.05], [0.0, 0.0, 4.0], [2.7, 0.0, 5.0], [0.0, 0.0, -3.0]])
    off = off_truth(places, views)
    np.testing.assert_allclose(off[:2], [0.01, 0.2], atol=1e-9)
    assert off[2] == np.inf, "one camera sees it"
    assert off[3] == np.inf, "behind all"


def test_sky_is_no_surface():
    views = [view(0.0, np.inf), view(0.1, 5.0), view(-0.1, 5.0)]
    assert off_truth(np.array([[0.0, 0.0, 5.0]]), views[:2])[0] == np.inf
    assert off_truth(np.array([[0.0, 0.0, 5.0]]), views)[0] == 0.0
