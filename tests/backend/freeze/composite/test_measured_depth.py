"""Depth of moving objects from the artist's map: correct where the map is, in plate t* and in other views."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from torch_backend.freeze.composite.measured_depth import InstantDepth, MeasuredDepths
from torch_backend.freeze.composite.surface_depth import (
    KeyView,
    Splats,
    StillSurfaces,
    SurfaceDepthConfig,
    frame_depth,
    rays_of,
)

WIDTH, HEIGHT, FOCAL = 120, 90, 110.0
K = np.array([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])
WALL, MOVER, CARD = 6.0, 3.0, 1.5
NOISE = 0.03


def camera(shift: float) -> NDArray[np.float64]:
    viewmat = np.eye(4)
    viewmat[0, 3] = -shift
    return viewmat


def world(shift: float, mover: float = MOVER) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """(inverse depth, moving, card), each [H, W]: a moving object before a wall, and a card in front of its left
    part."""
    rays = rays_of(K, (HEIGHT, WIDTH))

    def hit(depth: float, left: float, right: float, top: float, bottom: float) -> NDArray[Any]:
        x, y = rays[..., 0] * depth + shift, rays[..., 1] * depth
        return (x > left) & (x < right) & (y > top) & (y < bottom)

    moving = hit(mover, -0.6, 0.6, -0.6, 0.6)
    card = hit(CARD, -0.6, -0.22, -0.9, 0.9)
    inverse = np.where(card, 1.0 / CARD, np.where(moving, 1.0 / mover, 1.0 / WALL)).astype(np.float32)
    return inverse, moving & ~card, card


def instant(splat_error: float, sigma: float = 0.02, hole: bool = False) -> InstantDepth:
    """Depth at t*: splats place the moving object too far by the fraction `splat_error`; the map has the true depth."""
    true, moving, _ = world(0.0)
    splats = np.where(moving, true / (1.0 + splat_error), true).astype(np.float32)
    deviation = (sigma * true).astype(np.float32)
    measured = true.copy()
    if hole:
        measured[:, WIDTH // 2 :] = splats[:, WIDTH // 2 :]
        deviation[:, WIDTH // 2 :] = 10.0 * splats[:, WIDTH // 2 :]
    none = np.zeros_like(splats)
    pose = camera(0.0), K
    noise = max(abs(splat_error), NOISE)
    return InstantDepth(
        KeyView(*pose, none, none, splats, NOISE * splats),
        KeyView(*pose, none, none, measured, deviation),
        noise,
        NOISE,
    )


def corrected(shift: float, splat_error: float, **more: Any) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """(depth of the mover / truth, stated relative deviation, depth of all else / truth) in a view shifted by
    `shift`."""
    true, moving, _ = world(shift)
    splats = np.where(moving, true / (1.0 + splat_error), true).astype(np.float32)
    view = KeyView(camera(shift), K, splats, splats, splats, splats)
    factor, deviation = instant(splat_error, **more).correction(view, moving)
    ratio = true / (splats * factor)
    return ratio[moving], deviation[moving], ratio[~moving]


@pytest.mark.parametrize("shift", [0.0, 0.1, 0.3])
@pytest.mark.parametrize("splat_error", [-0.1, 0.06])
def test_what_moves_is_as_far_as_the_map_says_from_any_side(shift, splat_error):
    mover, deviation, background = corrected(shift, splat_error)
    left = abs(splat_error) * 0.02**2 / (0.02**2 + splat_error**2)
    assert np.median(np.abs(mover - 1.0)) < left + 0.005
    np.testing.assert_array_equal(background, 1.0)
    assert np.median(deviation) == pytest.approx(1.0 / np.hypot(1 / 0.02, 1 / splat_error), rel=0.1)


def test_a_map_that_is_worse_than_the_splats_hardly_counts():
    mover, deviation, _ = corrected(0.1, 0.01, sigma=0.3)
    assert np.abs(mover - 1.01).max() < 0.001
    assert np.median(deviation) == pytest.approx(NOISE, rel=0.05)


def test_where_the_map_has_a_hole_the_splats_stay_or_take_their_neighbours_correction():
    mover, _, _ = corrected(0.0, 0.06, hole=True)
    assert np.abs(mover - 1.0).max() < 0.08
    assert np.median(mover) < 1.06


def test_what_plate_t_star_does_not_show_is_not_measured_by_it():
    """Behind the card, the map at t* holds the card's depth."""
    true, moving, _ = world(0.5)
    splats = np.where(moving, true / 1.06, true).astype(np.float32)
    view = KeyView(camera(0.5), K, splats, splats, splats, splats)
    factor, _ = instant(0.06).correction(view, moving)
    wrong = np.abs(factor[moving] - 1.03) > 0.1
    assert wrong.mean() < 0.03, "its outline mixes two surfaces; the card's factor would be 1.9"


def test_a_frames_depth_is_that_of_the_map_inside_of_what_moves():
    true, moving, _ = world(0.1)
    splat_error = 0.08
    splats = np.where(moving, true / (1.0 + splat_error), true).astype(np.float32)
    surfaces = StillSurfaces.__new__(StillSurfaces)
    surfaces.config, surfaces.keys = SurfaceDepthConfig(), []
    picture = np.where(moving[..., None], [0.9, 0.2, 0.1], [0.3, 0.4, 0.5]).astype(np.float32)
    frame = Splats(camera(0.1), K, splats, moving.astype(np.float32))
    inner = moving.copy()
    for axis in (0, 1):
        for by in (-4, 4):
            inner &= np.roll(moving, by, axis)

    def error(measured: InstantDepth | None) -> float:
        inverse, sigma = frame_depth(surfaces, frame, picture, measured)
        assert np.isfinite(sigma).all()
        return float(np.median(np.abs(true / inverse - 1.0)[inner]))

    assert error(None) == pytest.approx(splat_error, rel=0.2)
    assert error(instant(splat_error)) < 0.015


def test_a_run_without_maps_has_no_measurement(trained):
    from torch_backend.freeze.frozen import freeze_at
    from torch_backend.scene import load_scene
    from torch_backend.train import load_run

    run, scene = load_run(trained.shot, "main"), load_scene(trained.shot)
    assert MeasuredDepths(run, scene).at(104, freeze_at(run.model, 0.5, 1.0)) is None
