"""Points, their projections in other views, and resampled pictures, compared with float64 loops."""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter

from torch_backend.freeze.views.reproject import (
    blurred,
    dilate,
    erode,
    inside,
    look_up,
    pixel_centres,
    project,
    resized,
    unproject,
)

W, H = 37, 29


@pytest.fixture(scope="module")
def camera():
    """(viewmat, K) of a rotated and translated camera."""
    rng = np.random.default_rng(5)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = turn * np.sign(np.linalg.det(turn)), rng.normal(size=3)
    return viewmat, np.array([[31.0, 0, 17.3], [0, 33.0, 13.9], [0, 0, 1]])


@pytest.fixture(scope="module")
def picture():
    return np.random.default_rng(6).uniform(-1, 3, (H, W, 3))


def float32(values):
    return torch.from_numpy(np.asarray(values)).float()


def test_centres_of_pixels_are_at_a_half():
    centres = pixel_centres(W, H)
    assert centres.shape == (H, W, 2)
    assert centres[0, 0].tolist() == [0.5, 0.5] and centres[4, 9].tolist() == [9.5, 4.5]


def test_points_of_pixels_and_depths_and_back(camera):
    viewmat, K = camera
    pixels = np.random.default_rng(1).uniform(0, 30, (11, 7, 2))
    depth = np.random.default_rng(2).uniform(0.5, 9, (11, 7))
    found = unproject(*map(float32, (pixels, depth, viewmat, K)))
    for at in np.ndindex(11, 7):
        local = np.linalg.inv(K) @ [*pixels[at], 1.0] * depth[at]
        want = np.linalg.inv(viewmat) @ [*local, 1.0]
        np.testing.assert_allclose(found[at], want[:3], atol=2e-5)
    back, deep = project(found, *map(float32, camera))
    np.testing.assert_allclose(back, pixels, atol=2e-3)
    np.testing.assert_allclose(deep, depth, rtol=1e-5)


def test_what_lies_behind_the_camera_is_in_no_picture():
    points = torch.tensor([[0.0, 0.0, -2.0], [0.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
    K = torch.tensor([[30.0, 0, 18], [0, 30.0, 14], [0, 0, 1]])
    pixels, depth = project(points, torch.eye(4), K)
    assert inside(pixels, W, H, 2.0).tolist() == [0.0, 0.0, 1.0]
    assert depth.tolist() == [-2.0, 0.0, 2.0]


def test_a_look_up_is_bilinear_between_centres_and_goes_on_beyond_the_border(picture):
    pixels = np.random.default_rng(3).uniform(-6, 45, (400, 2))
    found = look_up(float32(picture), float32(pixels))
    at = [np.clip(pixels[:, 1] - 0.5, 0, H - 1), np.clip(pixels[:, 0] - 0.5, 0, W - 1)]
    want = np.stack([map_coordinates(picture[..., c], at, order=1) for c in range(3)], -1)
    np.testing.assert_allclose(found, want, atol=2e-5)
    np.testing.assert_allclose(look_up(float32(picture[..., 1]), float32(pixels)), want[:, 1], atol=2e-5)
    far = torch.tensor([[-1e6, -1e6], [1e6, 1e6]])
    np.testing.assert_allclose(look_up(float32(picture), far), picture[[0, -1], [0, -1]], atol=1e-6)


@pytest.mark.parametrize("mode", ["bilinear", "bicubic", "nearest"])
def test_a_look_up_at_the_centres_is_the_picture(picture, mode):
    np.testing.assert_allclose(look_up(float32(picture), pixel_centres(W, H), mode), picture, atol=2e-5)


def test_inside_rises_from_the_border_over_two_pixels():
    pixels = torch.tensor([[-0.1, 9.0], [0.0, 9.0], [1.0, 9.0], [9.0, 28.5], [9.0, 9.0], [37.0, 9.0]])
    np.testing.assert_allclose(inside(pixels, W, H, 2.0), [0, 0, 0.5, 0.25, 1, 0], atol=1e-6)


def test_a_blur_is_a_gaussian_that_keeps_the_mean_and_the_border(picture):
    found = blurred(float32(picture), 1.7)
    want = gaussian_filter(picture, (1.7, 1.7, 0), mode="nearest", radius=(5, 5, 0))
    np.testing.assert_allclose(found, want, atol=1e-5)
    np.testing.assert_allclose(blurred(torch.full((H, W), 0.3), 4.0), np.full((H, W), 0.3), atol=1e-6)
    assert blurred(float32(picture), 0.0) is not None
    np.testing.assert_array_equal(blurred(float32(picture), 0.0), float32(picture))


@pytest.mark.parametrize("by", [0, 1, 4])
def test_a_matte_is_widened_to_all_sides(picture, by):
    matte = picture[..., 0]
    np.testing.assert_array_equal(dilate(float32(matte), by), float32(maximum_filter(matte, 2 * by + 1)))
    if by:
        least = torch.stack([erode(layer, by) for layer in float32(picture).permute(2, 0, 1)])
        want = [-maximum_filter(-picture[..., c], 2 * by + 1) for c in range(3)]
        np.testing.assert_array_equal(least, float32(np.stack(want)))


def test_smaller_pictures_are_means_and_larger_ones_lie_between(picture):
    slope = pixel_centres(40, 20)
    for width, height in ((20, 10), (10, 5), (80, 40)):
        found = resized(slope, width, height)
        want = pixel_centres(width, height) * (40 / width)
        np.testing.assert_allclose(found[3:-3, 3:-3], want[3:-3, 3:-3], atol=1e-4)  # borders are handled differently
    small = resized(float32(picture[..., 0]), 9, 7)
    assert small.shape == (7, 9)
    assert float(small.mean()) == pytest.approx(picture[..., 0].mean(), abs=0.05)
    assert small.std() < 0.5 * picture[..., 0].std(), "averaged, not picked"
    assert resized(small, 9, 7) is small
