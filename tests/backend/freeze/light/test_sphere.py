"""Panoramas: directions, assembly of cube faces, and filling, compared with closed forms in float64."""

import numpy as np
import pytest

from torch_backend.freeze.light import sphere

WIDTH = 128


def true_directions(width):
    """[H, W, 3] float64: Cycles' formula, u = 1/2 - atan2(y, x) / 2 pi, v = 1/2 + asin(z) / pi, with v from below."""
    u = (np.arange(width) + 0.5) / width
    v = 1.0 - (np.arange(width // 2) + 0.5) / (width // 2)
    longitude, latitude = 2 * np.pi * (0.5 - u), np.pi * (v - 0.5)
    cos = np.cos(latitude)[:, None]
    x, y = cos * np.cos(longitude), cos * np.sin(longitude)
    return np.stack([x, y, np.broadcast_to(np.sin(latitude)[:, None], x.shape)], -1)


def smooth(along):
    """[..., 4]: smooth colour of a direction, without sixfold symmetry, alpha 1 everywhere."""
    x, y, z = np.moveaxis(np.asarray(along, np.float64), -1, 0)
    return np.stack([0.5 + 0.4 * x + 0.1 * y * z, 0.5 + 0.4 * y, 0.5 + 0.4 * z - 0.1 * x * y, np.ones_like(x)], -1)


def test_directions_are_those_of_cycles_and_solid_angles_add_up():
    np.testing.assert_allclose(sphere.directions(WIDTH, WIDTH // 2), true_directions(WIDTH), atol=1e-6)
    assert WIDTH * sphere.solid_angles(WIDTH, WIDTH // 2).sum() == pytest.approx(1.0)


def test_faces_make_one_picture_without_seams():
    focal, side = sphere.face_camera(WIDTH)
    pixel = (np.arange(side) + 0.5 - side / 2) / focal

    def face(rotation):
        assert np.allclose(rotation @ rotation.T, np.eye(3)) and np.linalg.det(rotation) == pytest.approx(1.0)
        ray = np.stack([*np.meshgrid(pixel, pixel), np.ones((side, side))], -1)
        return smooth((ray / np.linalg.norm(ray, axis=-1, keepdims=True)) @ rotation).astype(np.float32)

    picture = sphere.panorama(WIDTH, face)
    np.testing.assert_allclose(picture, smooth(true_directions(WIDTH)), atol=2e-3)


def test_filled_cap_is_smooth_and_its_share_reported():
    along = true_directions(256)
    known = smooth(along)
    known[along[..., 0] < 0.5] = 0.0  # unknown in three quarters of the sphere, including both poles and the seam
    color, share = sphere.filled(known.astype(np.float32))
    assert share == pytest.approx(0.75, abs=0.005)
    covered = along[..., 0] >= 0.5
    np.testing.assert_allclose(color[covered], known[covered][:, :3], atol=1e-6)
    low, high = known[covered][:, :3].min(0), known[covered][:, :3].max(0)
    assert (color >= low - 1e-5).all() and (color <= high + 1e-5).all()
    around = np.abs(np.diff(np.concatenate([color, color[:, :1]], axis=1), axis=1))
    assert around.max() < 0.03 and np.abs(np.diff(color, axis=0)).max() < 0.03, "no seam, no edge"
    assert np.ptp(color[0], axis=0).max() < 0.05 and np.ptp(color[-1], axis=0).max() < 0.05, "the poles are points"


def test_half_covered_pixels_keep_half_of_their_colour():
    known = np.ones((32, 64, 4), np.float32) * np.float32([0.2, 0.4, 0.6, 1.0])
    known[10:20] *= 0.5  # premultiplied: the same colour, alpha 0.5
    color, share = sphere.filled(known)
    np.testing.assert_allclose(color, np.broadcast_to([0.2, 0.4, 0.6], color.shape), atol=1e-5)
    assert share == pytest.approx(0.5 * 64 * sphere.solid_angles(64, 32)[10:20].sum())


def test_nothing_covered_is_an_error():
    with pytest.raises(ValueError, match="nothing"):
        sphere.filled(np.zeros((32, 64, 4), np.float32))
