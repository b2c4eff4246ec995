"""Visibility of points in a plate, compared with float64: hidden, behind, outside, ignored, and NaN."""

import math

import numpy as np
import pytest
import torch

from torch_backend.freeze.views.visibility import visible_by_operators, visible_pixels

WIDTH, HEIGHT, TOLERANCE, SOFT = 37, 21, 0.03, 2.0


def reference(points, viewmat, K, surface, ignored):
    """Reference in float64: (pixels, depth, visible, moving, explained) of points [N, 3]."""
    local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    z = local[:, 2]
    front = z > 1e-6
    safe = np.where(front, z, 1.0)
    at = np.stack([local[:, 0] / safe * K[0, 0] + K[0, 2], local[:, 1] / safe * K[1, 1] + K[1, 2]], 1)
    at = np.where(front[:, None], at, -1e6)
    x, y = np.clip(at[:, 0] - 0.5, 0, WIDTH - 1), np.clip(at[:, 1] - 0.5, 0, HEIGHT - 1)
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    right, bottom = np.minimum(left + 1, WIDTH - 1), np.minimum(top + 1, HEIGHT - 1)
    a, b = (x - left)[:, None], (y - top)[:, None]

    def look_up(picture):
        upper = picture[top, left] * (1 - a) + picture[top, right] * a
        return upper * (1 - b) + (picture[bottom, left] * (1 - a) + picture[bottom, right] * a) * b

    shown = look_up(surface)
    border = np.minimum(at, np.array([WIDTH, HEIGHT]) - at).min(1)
    visible = np.exp(-np.square((z - shown[:, 0]) / (TOLERANCE * np.maximum(z, 1e-6)))) * np.clip(border / SOFT, 0, 1)
    visible *= 1 - look_up(ignored)[:, 0]
    return at, z, visible, shown[:, 1], shown[:, 2]


@pytest.fixture(scope="module")
def plate():
    """(points [N, 3], viewmat, K, surface, ignored) in float64; N is no multiple of a SIMD vector and exceeds two
    chunks."""
    rng = np.random.default_rng(3)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = turn * np.sign(np.linalg.det(turn)), [0.3, -0.2, 0.5]
    K = np.array([[30.0, 0, 18.2], [0, 31.0, 10.4], [0, 0, 1]])
    surface = np.stack([rng.uniform(2, 3, (HEIGHT, WIDTH)), *rng.uniform(0, 1, (2, HEIGHT, WIDTH))], -1)
    ignored = rng.uniform(0, 1, (HEIGHT, WIDTH, 1)) * (rng.uniform(size=(HEIGHT, WIDTH, 1)) > 0.7)
    local = rng.uniform([-4, -2, -1], [4, 2, 4], (10007, 3))
    # Half of the points are near the surface, visible or just hidden.
    near = np.arange(0, 10007, 2)
    pixels = rng.uniform([-3, -3], [WIDTH + 3, HEIGHT + 3], (len(near), 2))
    z = rng.uniform(1.9, 3.1, len(near))
    local[near] = np.stack([(pixels[:, 0] - K[0, 2]) / K[0, 0] * z, (pixels[:, 1] - K[1, 2]) / K[1, 1] * z, z], 1)
    points = (local - viewmat[:3, 3]) @ viewmat[:3, :3]
    return points, viewmat, K, surface, ignored


def single(*values):
    return [torch.from_numpy(np.asarray(value)).float() for value in values]


BOTH = pytest.mark.parametrize("visible", [visible_pixels, visible_by_operators], ids=["processor", "card"])


@BOTH
@pytest.mark.parametrize("with_ignored", [False, True])
def test_it_is_what_float64_says(plate, with_ignored, visible):
    points, viewmat, K, surface, ignored = plate
    ignored = ignored if with_ignored else np.zeros_like(ignored)
    inputs = single(points, viewmat, K, surface, ignored)
    inputs = inputs if with_ignored else [*inputs[:-1], None]
    # Inputs are rounded to float32 first, so that only the arithmetic is tested.
    rounded = [np.asarray(v, np.float32).astype(float) for v in (points, viewmat, K, surface, ignored)]
    found, expected = visible(*inputs, TOLERANCE, SOFT), reference(*rounded)
    clear = np.abs(expected[1]) > 1e-3  # near the camera's plane, rounding decides which points are in front
    assert (expected[2] > 0.5).sum() > 100 and (expected[1] < 0).sum() > 500
    for name, mine, theirs in zip(("depth", "moving", "explained"), (found.depth, found.moving, found.explained),
                                  (expected[1], expected[3], expected[4]), strict=True):  # fmt: skip
        assert np.abs(mine.numpy() - theirs)[clear].max() < 1e-4, name
    assert np.abs(found.visible.numpy() - expected[2])[clear].max() < 1e-3
    inside = clear & (np.abs(expected[0]) < 1e3).all(1)
    assert np.abs(found.pixels.numpy() - expected[0])[inside].max() < 2e-3
    assert (found.pixels.numpy()[expected[1] < -1e-3] == -1e6).all()


def test_result_is_independent_of_threads_and_shape(plate):
    points, *camera = single(*plate)
    whole = visible_pixels(points, *camera, TOLERANCE, SOFT)
    for part in (slice(0, 1), slice(5, 22), slice(8000, 10007)):
        some = visible_pixels(points[part], *camera, TOLERANCE, SOFT)
        assert torch.equal(some.visible, whole.visible[part]) and torch.equal(some.pixels, whole.pixels[part])
    square = visible_pixels(points[:10000].reshape(100, 100, 3)[::2, ::3], *camera, TOLERANCE, SOFT)
    assert square.pixels.shape == (50, 34, 2)
    assert torch.equal(square.depth, whole.depth[:10000].reshape(100, 100)[::2, ::3])
    assert visible_pixels(points[:0], *camera, TOLERANCE, SOFT).depth.shape == (0,)


@BOTH
def test_non_finite_points_are_invisible_and_read_in_bounds(plate, visible):
    _, *camera = single(*plate)
    odd = torch.tensor([[math.nan, 0.0, 0.0], [math.inf, 0.0, 0.0], [0.0, -math.inf, 1.0], [1e30, 1e30, 1e30]])
    found = visible(odd, *camera, TOLERANCE, SOFT)
    assert not bool((found.visible > 0.0).any())
    assert bool(found.moving.isfinite().all()) and bool(found.explained.isfinite().all())


def test_inputs_other_than_float32_are_refused(plate):
    points, *camera = single(*plate)
    with pytest.raises(ValueError, match="float32"):
        visible_pixels(points.double(), *camera, TOLERANCE, SOFT)
