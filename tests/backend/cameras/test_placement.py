"""Points, cameras and lenses placed in a scene, compared with float64 projections; choice of a shot's placement."""

import json

import numpy as np
import pytest

from torch_backend.cameras.placement import (
    SENSOR_MM,
    Similarity,
    camera_to_world,
    lens_of,
    path_viewmats,
    placement_for,
)
from torch_backend.contract import CameraFrame, CameraPath, Placement, file_digest, placement_of, write_json
from torch_backend.shot import Shot

SCENE = [0.0, -2.5, 0.0, 4.0, 0.0, 0.0, 2.5, 1.0, -2.5, 0.0, 0.0, 7.0, 0.0, 0.0, 0.0, 1.0]
"""Rotation, scale of 2.5 and translation."""


def project(viewmats, K, points):
    """Pixels [F, P, 2] and depths [F, P] of points [P, 3], OpenCV, float64."""
    seen = np.einsum("fij,pj->fpi", viewmats[:, :3, :3], points) + viewmats[:, None, :3, 3]
    fx, fy, cx, cy = K
    return np.stack([fx * seen[..., 0] / seen[..., 2] + cx, fy * seen[..., 1] / seen[..., 2] + cy], -1), seen[..., 2]


@pytest.fixture
def path() -> CameraPath:
    chance = np.random.default_rng(0)
    frames = []
    for n in range(5):
        turn, _ = np.linalg.qr(np.eye(3) + 0.1 * chance.standard_normal((3, 3)))
        turn *= np.sign(np.diag(turn))
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = turn * np.linalg.det(turn), chance.standard_normal(3)
        frames.append(CameraFrame(101 + n, viewmat.ravel().tolist(), [900.0 + n, 880.0, 610.0, 350.0]))
    return CameraPath(1280, 720, frames)


def test_placed_cameras_see_placed_points_in_the_same_pixels(path):
    where = Similarity.of(Placement(list(SCENE)))
    points = np.random.default_rng(1).normal([0, 0, 9], 1.0, (50, 3))
    before, depth = project(path_viewmats(path), path.frames[0].K, points)
    moved = where.viewmats(path_viewmats(path))
    after, scaled = project(moved, path.frames[0].K, where.points(points))
    np.testing.assert_allclose(after, before, atol=1e-9)
    np.testing.assert_allclose(scaled, 2.5 * depth, rtol=1e-12)
    np.testing.assert_allclose(
        moved[:, :3, :3] @ moved[:, :3, :3].transpose(0, 2, 1), np.eye(3)[None].repeat(5, 0), atol=1e-12
    )


def test_upright_is_blenders_world():
    """Down in the solve (y) is -z in the scene; forward (z) is the scene's y."""
    where = Similarity.of(Placement())
    np.testing.assert_array_equal(where.points(np.array([[1.0, 2.0, 3.0]])), [[1.0, 3.0, -2.0]])
    to_world = camera_to_world(where.viewmats(np.eye(4)[None]))[0]
    np.testing.assert_allclose(to_world[:3, 1], [0, 0, 1], atol=1e-15), "the camera's up is the scene's"
    np.testing.assert_allclose(-to_world[:3, 2], [0, 1, 0], atol=1e-15), "it looks ahead"


def test_a_lens_is_the_intrinsics():
    """A film back of 36 mm with these lens values projects like K, also with non-square pixels."""
    K, width, height = [900.0, 880.0, 610.0, 350.0], 1280, 720
    lens = lens_of(K, width, height)
    x, y, z = 0.3, -0.2, 2.0  # OpenCV: y points down
    across = lens.focal_mm * x / z / SENSOR_MM + 0.5 - lens.shift_x
    up = lens.focal_mm * -y / z / lens.sensor_height_mm + 0.5 - lens.shift_y * SENSOR_MM / lens.sensor_height_mm
    assert across * width == pytest.approx(K[0] * x / z + K[2])
    assert (1.0 - up) * height == pytest.approx(K[1] * y / z + K[3])


@pytest.mark.parametrize(
    "matrix",
    [
        [1.0] * 15,
        [float("nan"), *SCENE[1:]],
        [*SCENE[:12], 0.0, 0.0, 1.0, 1.0],
        np.diag([1.0, 1.0, -1.0, 1.0]).ravel().tolist(),
        np.diag([1.0, 1.0, 1.1, 1.0]).ravel().tolist(),
        np.diag([0.0, 0.0, 0.0, 1.0]).ravel().tolist(),
        ["a"] * 16,
    ],
)
def test_what_is_no_similarity_is_refused(matrix):
    with pytest.raises(ValueError, match="scene_from_solve should"):
        Placement(matrix)


def test_a_placement_is_that_of_the_present_solve(tmp_path, path):
    shot = Shot.create(tmp_path / "a.splannequin")
    write_json(shot.cameras, path.to_json())
    assert placement_for(shot) == Placement(), "upright"
    stored = Placement(list(SCENE), 0.01, file_digest(shot.cameras))
    write_json(shot.placement, stored.to_json())
    assert placement_for(shot) == stored and placement_for(shot).scale == pytest.approx(2.5)
    named = tmp_path / "other.json"
    write_json(named, Placement(metres_per_unit=2.0).to_json())
    assert placement_for(shot, str(named)).metres_per_unit == 2.0
    path.frames.pop()
    write_json(shot.cameras, path.to_json())
    assert placement_for(shot) == Placement(), "of another solve"
    with pytest.raises(ValueError, match="belongs to another solve"):
        placement_for(shot, str(shot.placement))
    named.write_text(json.dumps({"scene_from_solve": [1.0]}))
    with pytest.raises(ValueError, match=r"other\.json is not a placement"):
        placement_for(shot, str(named))


def test_takes_of_before_are_in_solve_units():
    assert placement_of({}).scene_from_solve == np.eye(4).ravel().tolist()
    assert placement_of({"placement": Placement(list(SCENE)).to_json()}).scene_from_solve == SCENE
    with pytest.raises(ValueError, match="damaged"):
        placement_of({"placement": 3})
