"""Surface depth: planes stay planar, plates correct wrong splat depths, and edges follow the picture."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from torch_backend.freeze.composite.planes import smoothed
from torch_backend.freeze.composite.surface_depth import (
    KeyView,
    Splats,
    StillSurfaces,
    SurfaceDepthConfig,
    combined,
    frame_depth,
    key_picture,
)

WIDTH, HEIGHT, FOCAL = 120, 90, 110.0
NORMAL, DISTANCE = np.array([0.25, -0.35, 1.0]), 4.0
"""Plane of the points p with NORMAL @ p = DISTANCE."""


def rays() -> NDArray[Any]:
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    return np.stack([(x - WIDTH / 2) / FOCAL, (y - HEIGHT / 2) / FOCAL, np.ones_like(x)], -1)


def view_of(shift: float, texture: NDArray[Any], wrong: float = 1.0) -> KeyView:
    """View of a textured plane from a camera shifted to the right; its inverse depth is wrong by a factor."""
    viewmat = np.eye(4)
    viewmat[0, 3] = -shift
    inverse = (rays() @ NORMAL) / (DISTANCE - NORMAL[0] * shift)
    points = rays() / inverse[..., None] + [shift, 0.0, 0.0]
    place = ((points[..., :2] + 4.0) * 32.0).astype(np.float32)
    plate = cv2.remap(texture, place[..., 0], place[..., 1], cv2.INTER_LINEAR)
    K = np.array([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])
    inverse = (inverse * wrong).astype(np.float32)
    picture = key_picture(plate[..., None], SurfaceDepthConfig())
    return KeyView(viewmat, K, inverse, 0.03 * inverse, picture, np.ones_like(inverse))


@pytest.fixture(scope="module")
def views() -> list[KeyView]:
    noise = np.random.default_rng(0).random((256, 256)).astype(np.float32)
    texture = cv2.GaussianBlur(noise, (0, 0), 1.2)
    texture = (texture - texture.mean()) * 3.0 + 0.5
    views = [
        view_of(shift, texture, wrong) for shift, wrong in zip((0.0, 0.2, 0.4, 0.6, 0.8), (1.03,) * 5, strict=True)
    ]
    return StillSurfaces(views).keys


def error_of(inverse: NDArray[Any], shift: float = 0.0) -> NDArray[Any]:
    true = (rays() @ NORMAL) / (DISTANCE - NORMAL[0] * shift)
    return np.abs(inverse / true - 1.0)[8:-8, 8:-8]


def test_plates_correct_what_splats_have_three_percent_wrong(views: list[KeyView]) -> None:
    middle = views[2]
    assert np.median(error_of(middle.inverse, 0.4)) < 0.003
    assert (error_of(middle.inverse, 0.4) > 0.01).mean() < 0.05
    assert np.median(middle.sigma / middle.inverse) < 0.05


def test_a_frame_between_key_views_takes_their_depth(views: list[KeyView]) -> None:
    surfaces = StillSurfaces.__new__(StillSurfaces)
    surfaces.config, surfaces.keys = SurfaceDepthConfig(), views
    viewmat = np.eye(4)
    viewmat[0, 3] = -0.3
    true = (rays() @ NORMAL) / (DISTANCE - NORMAL[0] * 0.3)
    shingles = 1.0 + 0.03 * np.sign(np.sin(np.arange(WIDTH) / 3.0))[None]
    splats = Splats(viewmat, views[0].K, (true * shingles).astype(np.float32), np.zeros((HEIGHT, WIDTH), np.float32))
    inverse, sigma = frame_depth(surfaces, splats, np.full((HEIGHT, WIDTH, 3), 0.5, np.float32))
    assert np.median(error_of(inverse, 0.3)) < 0.004
    assert (np.abs(inverse - true) < 2.0 * sigma)[8:-8, 8:-8].mean() > 0.8


def test_windows_over_an_edge_do_not_smear_it() -> None:
    columns = np.arange(60, dtype=np.float32)[None].repeat(40, 0)
    true = np.where(columns < 30, 0.5 + 0.002 * columns, 0.2).astype(np.float32)
    noisy = true + np.random.default_rng(1).normal(0.0, 0.01, true.shape).astype(np.float32)
    smooth, variance = smoothed(noisy, np.full_like(noisy, 1e4), (2, 4), SurfaceDepthConfig().uneven)
    error = np.abs(smooth - true)[5:-5]
    assert error[:, 5:27].max() < 0.02 and error[:, 33:-5].max() < 0.02
    assert error[:, 29:31].mean() < 0.05, "the step of 0.36 stays within a pixel"
    assert (error < 2.0 * np.sqrt(variance)[5:-5])[:, 5:27].mean() > 0.9


def test_a_ragged_edge_takes_the_pictures_line() -> None:
    """Moving objects end at the picture's colour edge, although splats reach up to two pixels beyond."""
    columns = np.arange(80)[None].repeat(60, 0)
    ragged = 40 + np.random.default_rng(2).integers(-2, 3, 60)[:, None]
    inverse = np.where(columns < ragged, 0.5, 0.2).astype(np.float32)
    picture = np.where(columns < 40, 0.8, 0.2)[..., None].repeat(3, 2).astype(np.float32)
    surfaces = StillSurfaces.__new__(StillSurfaces)
    surfaces.config, surfaces.keys = SurfaceDepthConfig(), []
    K = np.array([[70.0, 0.0, 40.0], [0.0, 70.0, 30.0], [0.0, 0.0, 1.0]])
    found, _ = frame_depth(surfaces, Splats(np.eye(4), K, inverse, np.zeros((60, 80), np.float32)), picture)
    wrong_before = ((inverse > 0.35) != (columns < 40)).mean()
    assert ((found > 0.35) != (columns < 40)).mean() < 0.5 * wrong_before


def test_key_views_that_agree_outvote_splats_that_are_wrong() -> None:
    """Splats of a wall are 10 % too far: two key views have the true depth, a third is as wrong as the splats."""
    true = np.full((HEIGHT, WIDTH), 0.25, np.float32)
    K = np.array([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])

    def key(shift: float, inverse: float) -> KeyView:
        viewmat = np.eye(4)
        viewmat[0, 3] = -shift
        still, value = np.ones_like(true), np.full_like(true, inverse)
        return KeyView(viewmat, K, value, 0.004 * value, 0.0 * still, still)

    surfaces = StillSurfaces.__new__(StillSurfaces)
    surfaces.config, surfaces.keys = SurfaceDepthConfig(), [key(0.1, 0.2501), key(0.2, 0.2499), key(-0.1, 0.22)]
    view = key(0.0, 0.225)
    view.sigma = 0.03 * view.inverse
    inverse, _ = combined(surfaces, view, view.still)
    middle = np.s_[8:-8, 16:-16]
    assert np.abs(inverse / true - 1.0)[middle].max() < 0.01
    without_views = combined(surfaces, view, 0.0 * view.still)
    np.testing.assert_allclose(without_views[0], view.inverse, rtol=1e-6)
    np.testing.assert_allclose(without_views[1], view.sigma, rtol=1e-3)
