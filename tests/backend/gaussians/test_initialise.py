"""Initial scales: the distance to the three nearest neighbours."""

import pytest
import torch

from torch_backend.gaussians.initialise import neighbour_distance


def test_root_mean_square_of_three_nearest():
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [50, 50, 50]])
    assert float(neighbour_distance(points)[0]) == pytest.approx((14 / 3) ** 0.5)
    assert neighbour_distance(points).dtype == torch.float32


def test_duplicates_are_neighbours_at_distance_zero():
    points = torch.tensor([[1.0, 2, 3]]).repeat(6, 1)
    assert neighbour_distance(points).tolist() == [0.0] * 6  # `initialise` clamps to its smallest scale


def test_fewer_points_than_neighbours():
    assert neighbour_distance(torch.zeros(0, 3)).tolist() == []
    assert neighbour_distance(torch.ones(1, 3)).tolist() == [0.0]
    assert neighbour_distance(torch.tensor([[0.0, 0, 0], [3, 4, 0]])).tolist() == [5.0, 5.0]


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_non_finite_points_are_refused(bad):
    points = torch.rand(6, 3)
    points[2, 1] = bad
    with pytest.raises(ValueError, match="finite"):
        neighbour_distance(points)
