"""Maths of floor, origin and scale, compared with float64 ground truth."""

import numpy as np
import pytest


def turned(seed: int) -> np.ndarray:
    """Random rotation [3, 3]."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


@pytest.fixture
def maths(addon):
    return addon("solve.alignment")


@pytest.mark.parametrize("seed", range(5))
def test_three_points_lie_in_the_floor_with_the_cameras_above(maths, seed):
    rng = np.random.default_rng(seed)
    rotation, shift = turned(seed), rng.normal(size=3) * 5
    flat = np.concatenate([rng.uniform(-2, 2, (3, 2)), np.zeros((3, 1))], axis=1)
    centres = np.array([0, 0, 1.5]) + rng.normal(size=(9, 3)) * 0.2
    places, above = flat @ rotation.T + shift, centres @ rotation.T + shift
    change = maths.level(places, above, np.zeros((9, 3)))
    np.testing.assert_allclose(change[:3, :3] @ change[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(change[:3, :3]) == pytest.approx(1.0)
    laid = places @ change[:3, :3].T + change[:3, 3]
    np.testing.assert_allclose(laid[:, 2], 0.0, atol=1e-12)
    np.testing.assert_allclose(laid.mean(axis=0)[:2], places.mean(axis=0)[:2], atol=1e-12)
    assert ((above @ change[:3, :3].T + change[:3, 3])[:, 2] > 0.5).all()
    swapped = maths.level(places[[1, 0, 2]], above, np.zeros((9, 3)))
    np.testing.assert_allclose(swapped, change, atol=1e-12, err_msg="the order of the clicks says nothing")


def test_a_camera_level_with_the_points_is_turned_by_its_up(maths):
    places = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    centres, ups = np.array([[0.5, 0.5, 0.0]]), np.array([[0.1, 0.0, -1.0]])
    np.testing.assert_allclose(maths.level(places, centres, ups)[:3, :3] @ [0, 0, -1], [0, 0, 1], atol=1e-12)


@pytest.mark.parametrize(
    ("first", "second"),
    [((0, 0, 1), (0, 0, 1)), ((0, 0, -2), (0, 0, 1)), ((1, 2, 3), (-1, -2, -3)), ((1, 2, 3), (3, -1, 0))],
)
def test_the_shortest_turn(maths, first, second):
    rotation = maths.turn(np.array(first, float), np.array(second, float))
    np.testing.assert_allclose(rotation @ maths.unit(first), maths.unit(second), atol=1e-12)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    cosine = maths.unit(first) @ maths.unit(second)
    assert np.trace(rotation) == pytest.approx(1 + 2 * cosine), "no turn beyond what is needed"


def test_what_cannot_be_aligned_is_said(maths, contract):
    line, centre = np.array([[0, 0, 0], [1, 1, 1], [2, 2, 2.01]]), np.zeros((1, 3))
    with pytest.raises(contract.JobError, match="on one line"):
        maths.level(line, centre, centre)
    with pytest.raises(contract.JobError, match="on one line"):
        maths.level(np.zeros((3, 3)), centre, centre)
    with pytest.raises(contract.JobError, match="the same"):
        maths.scaled(np.ones((2, 3)), 1.0)
    for distance in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(contract.JobError, match="greater than 0"):
            maths.scaled(np.eye(3)[:2], distance)


def test_the_nearest_point_under_the_mouse(maths):
    places = np.array([[0, 0, -5], [1, 0, -5], [0, 0, 5.0]])  # the last point is behind the camera
    matrix = np.array([[1.0, 0, 0, 0], [0, 2.0, 0, 0], [0, 0, -1, -0.2], [0, 0, -1, 0]])
    at, before = maths.seen(places, matrix, (200, 100))
    np.testing.assert_allclose(at[:2], [[100, 50], [120, 50]])
    assert before.tolist() == [True, True, False]
    assert maths.nearest((103, 54), places, matrix, (200, 100), 15) == 0
    assert maths.nearest((115, 50), places, matrix, (200, 100), 15) == 1
    assert maths.nearest((150, 50), places, matrix, (200, 100), 15) == -1
    assert maths.nearest((100, 50), np.zeros((0, 3)), matrix, (200, 100), 15) == -1
