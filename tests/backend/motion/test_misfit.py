"""Objects that are missing in the static model of a scene, in synthetic pictures."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from torch_backend.motion.misfit import MisfitConfig, Sight, misfit, seeded

WIDTH, HEIGHT, UNIT, DEPTH = 160, 120, 0.5, 4.0
Y, X = np.mgrid[0.5:HEIGHT, 0.5:WIDTH]
GRID = (2.0 * X).astype(np.float32), (2.0 * Y).astype(np.float32)
K = np.array([[320.0, 0.0, WIDTH], [0.0, 320.0, HEIGHT], [0.0, 0.0, 1.0]])
"""Intrinsics in flow pixels; a grid cell has two."""
STEPS = (-6, -4, -2, 2, 4, 6)
"""Positions of the other cameras, as shifts of the wall in grid cells."""
INVERSE = np.full((HEIGHT, WIDTH), 1.0 / DEPTH, np.float32)


def wall(step: int = 0) -> np.ndarray:
    """Picture of a plane at `DEPTH` from a camera `step` grid cells to the right."""
    coarse = np.random.default_rng(3).uniform(60, 190, (30, 44, 3)).astype(np.uint8)
    whole = cv2.resize(coarse, (WIDTH + 16, HEIGHT), interpolation=cv2.INTER_CUBIC)
    return whole[:, 8 + step : 8 + step + WIDTH].copy()


def sight(picture: np.ndarray, step: int = 0) -> Sight:
    viewmat = np.eye(4)
    viewmat[0, 3] = -step * 2.0 * DEPTH / K[0, 0]
    return Sight(picture, viewmat, K)


def noisy(picture: np.ndarray, sigma: float, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0.0, sigma, picture.shape)
    return np.clip(np.rint(picture + noise), 0, 255).astype(np.uint8)


def disc(radius: float) -> np.ndarray:
    return np.hypot(X - 70.0, Y - 50.0) < radius


def moving(frame: np.ndarray, shown: np.ndarray, witnesses: list[Sight]) -> np.ndarray:
    config = MisfitConfig()
    difference = misfit(sight(frame), INVERSE, shown, witnesses, GRID, UNIT, config)
    return seeded(difference > config.weak, difference > config.strong, 12)


def around(sigma: float = 0.0, gain: float = 1.0) -> list[Sight]:
    return [sight(noisy(gain * wall(step), sigma, 10 + step), step) for step in STEPS]


@pytest.mark.parametrize(("sigma", "gain"), [(2.0, 1.0), (8.0, 1.0), (2.0, 0.8)])
def test_what_the_world_at_rest_lacks_is_found_whatever_noise_and_exposure(sigma: float, gain: float) -> None:
    frame, truth = wall(), disc(8.0)
    frame[truth] = 200, 30, 30
    mask = moving(noisy(frame, sigma, 1), noisy(wall(), sigma, 2), around(sigma, gain))
    assert (mask & truth).sum() > 0.9 * truth.sum()
    assert not (mask & ~disc(14.0)).any()


@pytest.mark.parametrize("sigma", [0.0, 2.0, 8.0])
def test_noise_is_not_a_mover(sigma: float) -> None:
    assert moving(noisy(wall(), sigma, 1), noisy(wall(), sigma, 2), around(sigma)).mean() < 0.01


def test_one_witness_that_errs_makes_no_mover() -> None:
    """First the model is wrong in an area; then the other frames show another surface there because of a wrong
    depth."""
    poor = wall()
    poor[disc(8.0)] = 200, 30, 30
    assert not moving(noisy(wall(), 2.0, 1), noisy(poor, 2.0, 2), around(2.0)).any()
    witnesses = around(2.0)
    for witness in witnesses:
        witness.colors[disc(16.0)] = 200, 30, 30
    assert not moving(noisy(wall(), 2.0, 1), noisy(wall(), 2.0, 2), witnesses).any()


def test_frame_that_differs_everywhere_has_no_movers() -> None:
    """A flash, or a wrong pose."""
    assert moving(255 - wall(), wall(), around()).mean() < 0.01
    assert moving(wall(7), wall(), around()).mean() < 0.01


def test_four_witness_frames_are_not_enough() -> None:
    frame = wall()
    frame[disc(8.0)] = 200, 30, 30
    far_view = np.eye(4)
    far_view[0, 3] = 100.0
    far = [Sight(wall(), far_view, K) for _ in STEPS]
    behind = [Sight(wall(), np.diag([-1.0, 1.0, -1.0, 1.0]), K) for _ in STEPS]
    assert not misfit(sight(frame), INVERSE, wall(), [*around()[:4], *far, *behind], GRID, UNIT, MisfitConfig()).any()


def test_the_values_are_those_of_double_precision() -> None:
    frame, shown = noisy(wall(), 8.0, 1), noisy(wall(), 2.0, 2)
    witnesses = [sight(noisy(wall(), 8.0, seed)) for seed in (3, 4, 5, 6, 7)]
    median = np.median([witness.colors for witness in witnesses], axis=0)
    gaps = [np.abs(frame.astype(np.float64) - each).max(-1) for each in (shown, median)]
    taps = np.arange(-8, 9)  # OpenCV's kernel for float pictures extends to four sigmas
    kernel = np.exp(-0.5 * (taps / (4.0 * UNIT)) ** 2)
    kernel /= kernel.sum()
    gaps = [cv2.sepFilter2D(gap, cv2.CV_64F, kernel, kernel, borderType=cv2.BORDER_REFLECT_101) for gap in gaps]
    expected = np.minimum(*gaps)
    found = misfit(sight(frame), INVERSE, shown, witnesses, GRID, UNIT, MisfitConfig())
    assert np.abs(found - expected / np.quantile(expected, 0.9)).max() < 0.08  # the brightness fit is affected by noise
