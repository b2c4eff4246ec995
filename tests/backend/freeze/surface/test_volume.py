"""Fusion of known depth maps and surface extraction, compared with the surfaces in float64."""

import numpy as np
import pytest

from torch_backend.freeze.surface.nets import extract
from torch_backend.freeze.surface.volume import Contraction, SurfaceConfig, View, block_keys, blocks_of, fuse, resolved

WIDTH, HEIGHT, FOCAL = 160, 120, 150.0
CENTRE, RADIUS, WALL = np.array([0.1, -0.1, 2.5]), 0.4, 4.0


def seen(x: float, noise: float = 0.0) -> View:
    """A ball in front of a wall, from a camera at x that is turned slightly towards the ball."""
    turn = -0.15 * x
    rotation = np.array([[np.cos(turn), 0, -np.sin(turn)], [0, 1, 0], [np.sin(turn), 0, np.cos(turn)]])
    centre = np.array([x, 0.05 * x, 0.0])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ centre
    K = np.array([[FOCAL, 0, WIDTH / 2 + 3], [0, FOCAL, HEIGHT / 2 - 2], [0, 0, 1.0]])
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(u - K[0, 2]) / FOCAL, (v - K[1, 2]) / FOCAL, np.ones_like(u)], -1) @ rotation
    wall = (WALL - centre[2]) / rays[..., 2]
    a, b, c = (rays**2).sum(-1), rays @ (CENTRE - centre), ((CENTRE - centre) ** 2).sum() - RADIUS**2
    root = b * b - a * c
    ball = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
    depth = np.minimum(wall, ball)
    depth = depth * (1 + noise * np.random.default_rng(round(100 * x) + 500).normal(size=depth.shape))
    is_ball = (ball < wall).astype(np.float32)
    color = np.where(is_ball[..., None] > 0, [200, 40, 40], [40, 40, 200]).astype(np.uint8)
    sigma = np.full(depth.shape, max(noise, 1e-4) * 4.0, np.float32)
    return View(viewmat, K, depth.astype(np.float32), sigma, color, is_ball)


def distance_from_truth(points):
    """Distance of points [N, 3] from the true surfaces, float64."""
    points = points.astype(np.float64)
    return np.minimum(np.abs(points[:, 2] - WALL), np.abs(np.linalg.norm(points - CENTRE, axis=1) - RADIUS))


def test_a_key_is_a_block_and_keys_ascend_with_blocks():
    blocks = np.array([[-3, 5, 7], [0, 0, 0], [-1, -1, -1], [12345, -999, 4]])
    assert np.array_equal(blocks_of(block_keys(blocks)), blocks)
    assert block_keys(blocks)[2] < block_keys(blocks)[1]


def test_the_contraction_comes_back_and_leaves_what_is_near():
    space = Contraction(np.array([1.0, 2.0, 3.0]), 2.0)
    points = np.random.default_rng(1).normal(size=(500, 3)) * np.geomspace(0.1, 1000, 500)[:, None] + space.centre
    np.testing.assert_allclose(space.back(space.into(points)), points, rtol=1e-9, atol=1e-9)
    near = np.linalg.norm(points - space.centre, axis=1) < 2.0
    np.testing.assert_allclose(space.into(points)[near], points[near])
    direction = np.array([0.0, 0.6, 0.8])
    step = space.into(space.centre + 10.001 * direction) - space.into(space.centre + 10.0 * direction)
    far = float(space.scale(space.centre + 10.0 * direction))
    assert np.linalg.norm(step) == pytest.approx(0.001 / far, rel=1e-3)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_ball_before_a_wall_is_found(noise):
    views = [seen(x, noise) for x in np.linspace(-0.8, 0.8, 9)]
    volume = fuse(views)
    vertices, triangles = extract(volume)
    assert np.median(distance_from_truth(vertices)) < 0.002 * WALL
    assert np.quantile(distance_from_truth(vertices), 0.9) < 0.01 * WALL
    a, b, c = (vertices[triangles[:, n]].astype(np.float64) for n in range(3))
    normals = np.cross(b - a, c - a)
    of_wall = np.abs(a[:, 2] - WALL) < 0.04
    assert (normals[of_wall][:, 2] < 0).mean() > (0.99 if noise == 0.0 else 0.85), "triangles face the cameras"
    area = 0.5 * np.linalg.norm(normals[of_wall], axis=1).sum()
    assert area > 9.0, "the wall has no holes but the ball's shadow"


def test_a_plane_is_exact_and_whole():
    view = seen(0.0)
    view.depth[:] = 4.0
    volume = fuse([view], voxel=0.05)
    vertices, triangles = extract(volume)
    assert np.abs(vertices[:, 2] - 4.0).max() < 2e-3, "a plane bends by this within voxels of a contracted space"
    ends = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    _, often = np.unique(ends, axis=0, return_counts=True)
    assert often.max() == 2, "every edge lies between two triangles, or at the rim"
    assert len(np.unique(triangles)) - len(often) + len(triangles) == 1, "one sheet without holes (Euler)"


def test_voxel_size_matches_pixels_and_count_is_bounded():
    views = [seen(0.0, 0.0)]
    flat = Contraction(np.zeros(3), 100.0)
    assert resolved(views, flat) == pytest.approx(4.0 / FOCAL, rel=0.05)
    few = fuse(views, SurfaceConfig(voxels=100_000))
    assert few.distance.size <= 100_000 and few.voxel > fuse(views).voxel
    vertices, _ = extract(few)
    assert np.median(distance_from_truth(vertices)) < 0.01 * WALL


def test_nothing_seen_is_an_error():
    view = seen(0.0)
    view.depth[:] = 0.0
    with pytest.raises(ValueError, match="no view"):
        fuse([view])
