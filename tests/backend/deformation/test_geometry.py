"""Rotations, rigid motions and sampling, compared with closed forms, and finite at their singularities."""

import math

import pytest
import torch

from torch_backend.deformation.geometry import (
    farthest_points,
    near_identity,
    nearest,
    quat_product,
    rigid_rotations,
    screw,
)
from torch_backend.gaussians.rotations import rotation_matrices


def unit_quats(count, seed=0):
    quats = torch.randn(count, 4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.nn.functional.normalize(quats, dim=1)


def test_product_of_quaternions_is_the_product_of_rotations():
    a, b = unit_quats(20), unit_quats(20, 1)
    torch.testing.assert_close(
        rotation_matrices(quat_product(a, b)), rotation_matrices(a) @ rotation_matrices(b), atol=1e-12, rtol=0
    )
    assert torch.allclose(torch.linalg.det(rotation_matrices(a)), torch.ones(20, dtype=torch.float64))


def test_near_identity_is_finite_where_the_sum_vanishes():
    change = torch.tensor([[0.0, 0, 0, 0], [-1, 0, 0, 0], [0, 1, 0, 0]], requires_grad=True)
    quats = near_identity(change)
    half = math.sqrt(0.5)
    assert quats.tolist()[0] == [1, 0, 0, 0]
    assert quats.tolist()[1] == [1, 0, 0, 0]
    assert quats.tolist()[2] == pytest.approx([half, half, 0, 0])
    quats.square().mul(torch.arange(4.0)).sum().backward()
    assert bool(torch.isfinite(change.grad).all())


@pytest.mark.parametrize("angle", [0.0, 1e-8, 1e-4, 0.1, 0.4999, 0.5001, 2.0, 3.1, 6.0])
def test_screw_is_the_exponential_of_se3(angle):
    g = torch.Generator().manual_seed(3)
    turn = torch.nn.functional.normalize(torch.randn(5, 3, generator=g, dtype=torch.float64), dim=1) * angle
    shift = torch.randn(5, 3, generator=g, dtype=torch.float64)
    points = torch.randn(5, 3, generator=g, dtype=torch.float64)
    twist = torch.zeros(5, 4, 4, dtype=torch.float64)
    twist[:, 0, 1], twist[:, 0, 2] = -turn[:, 2], turn[:, 1]
    twist[:, 1, 0], twist[:, 1, 2] = turn[:, 2], -turn[:, 0]
    twist[:, 2, 0], twist[:, 2, 1] = -turn[:, 1], turn[:, 0]
    twist[:, :3, 3] = shift
    whole = torch.matrix_exp(twist)
    expected = (whole[:, :3, :3] @ points[..., None])[..., 0] + whole[:, :3, 3]
    torch.testing.assert_close(screw(points, turn, shift), expected, atol=1e-8, rtol=1e-8)
    single = screw(points.float(), turn.float(), shift.float())
    torch.testing.assert_close(single.double(), expected, atol=3e-6, rtol=1e-5)


def test_screw_has_gradients_at_angle_zero():
    turn = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)
    shift = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)
    points = torch.tensor([[1.0, 0, 0], [0, 0, 2]], dtype=torch.float64)
    assert torch.equal(screw(points, turn, shift), points)
    assert torch.autograd.gradcheck(lambda t, s: screw(points, t, s), (turn, shift), eps=1e-6, atol=1e-6)
    # d(exp(w) x)/dw at 0 is -[x], so the gradient of one output is known in closed form.
    screw(points, turn, shift)[0, 1].backward()
    assert turn.grad[0].tolist() == pytest.approx([0, 0, 1])


def test_farthest_points_spread_and_skip_duplicates():
    line = torch.linspace(0, 1, 11)[:, None].repeat(3, 1)
    picked = farthest_points(line, 3)
    assert sorted(line[picked, 0].tolist()) == pytest.approx([0, 0.5, 1])
    assert len(farthest_points(line, 100)) == 11
    assert len(farthest_points(torch.ones(5, 3), 4)) == 1


def test_nearest_far_from_the_origin():
    """Thousands of units away, products of coordinates lose precision, so the centre is subtracted first."""
    g = torch.Generator().manual_seed(5)
    points, queries = torch.rand(40, 3, generator=g), torch.rand(300, 3, generator=g)
    far = torch.tensor([3000.0, -2000.0, 500.0])
    expected = (queries[:, None].double() - points.double()).norm(dim=2).argsort(1)[:, :3]
    assert torch.equal(nearest(queries, points, 3), expected)
    assert float((nearest(queries + far, points + far, 3) == expected).float().mean()) > 0.99


def test_rotations_of_edges_are_found_and_never_mirror():
    g = torch.Generator().manual_seed(6)
    before = torch.randn(30, 8, 3, generator=g, dtype=torch.float64)
    truth = rotation_matrices(unit_quats(30, 7))
    valid = torch.ones(30, 8, dtype=torch.bool)
    valid[:, 6:] = False
    after = before @ truth.transpose(1, 2)
    after[:, 6:] += 10.0  # invalid edges are ignored
    found, usable = rigid_rotations(before, after, valid)
    assert bool(usable.all())
    torch.testing.assert_close(found, truth, atol=1e-10, rtol=0)
    mirrored, _ = rigid_rotations(before, before * torch.tensor([-1.0, 1, 1], dtype=torch.float64), valid)
    torch.testing.assert_close(torch.linalg.det(mirrored), torch.ones(30, dtype=torch.float64))


def test_collapsed_flat_and_bad_edges():
    edges = torch.randn(4, 5, 3, generator=torch.Generator().manual_seed(8))
    edges[0] = 0.0
    edges[1] = edges[1, :1]  # all edges are parallel
    edges[2, 0, 0] = torch.nan
    valid = torch.ones(4, 5, dtype=torch.bool)
    rotation, usable = rigid_rotations(edges, edges, valid)
    assert usable.tolist() == [False, True, False, True]
    assert bool(torch.isfinite(rotation).all())
    assert torch.linalg.det(rotation).tolist() == pytest.approx([1, 1, 1, 1], abs=1e-5)


@pytest.mark.parametrize(("dims", "points", "count"), [(3, 1, 1), (5, 37, 3), (11, 512, 3), (3, 200, 11), (3, 16, 16)])
def test_the_compiled_search_finds_what_sorting_finds(dims, points, count):
    g = torch.Generator().manual_seed(dims)
    places, queries = torch.randn(points, dims, generator=g), torch.randn(700, dims, generator=g) + 30.0
    places[: points // 2] += 30.0
    got = nearest(queries, places, count)
    want = torch.cdist(queries.double(), places.double()).sort(dim=1).values[:, :count]
    distances = (queries[:, None].double() - places[got].double()).norm(dim=2)
    torch.testing.assert_close(distances, want, rtol=1e-6, atol=1e-6)
    assert all(len(set(row)) == count for row in got.tolist())


def test_a_query_that_is_no_number_stays_inside_the_points():
    got = nearest(torch.full((2, 3), float("nan")), torch.rand(20, 3), 3)
    assert got.tolist() == [[0, 1, 2]] * 2
    assert nearest(torch.zeros(0, 3), torch.rand(20, 3), 3).shape == (0, 3)
