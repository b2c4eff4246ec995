"""Nearest neighbours: in order, and with too few points."""

import numpy as np

from torch_backend.gaussians.neighbours import nearest


def test_the_nearest_come_first():
    points = np.array([[0.0, 0, 0], [3, 0, 0], [1, 0, 0]])
    distance, index = nearest(points, np.array([[0.9, 0, 0], [4, 0, 0]]), 2)
    assert index.tolist() == [[2, 0], [1, 2]]
    assert np.allclose(distance, [[0.1, 0.9], [1, 3]])


def test_a_single_neighbour_keeps_its_axis():
    distance, index = nearest(np.zeros((1, 3)), np.ones((4, 3)), 1)
    assert distance.shape == index.shape == (4, 1)


def test_where_points_run_out_distances_are_infinite():
    distance, index = nearest(np.zeros((1, 3)), np.zeros((1, 3)), 3)
    assert distance.tolist() == [[0, np.inf, np.inf]] and index.tolist() == [[0, 1, 1]]
