"""The joint bilateral filter of planes against its definition in float64."""

import numpy as np
import pytest

from torch_backend.freeze.composite.plane_filter import filtered

NOISE, OUTLIER, COLOR, LEAST, BORDER = 0.03, 1e-6, 0.1, 1e-4, 3


def defined(maps, rough, picture):
    """`filtered` pixel by pixel, in float64."""
    (h, w, _), (height, width) = maps.shape, rough.shape
    inverse, deviation = np.zeros((height, width)), np.zeros((height, width))
    for row, column in np.ndindex(height, width):
        down, along = (row + 0.5) * h / height, (column + 0.5) * w / width
        guesses, weights, variances = [], [], []
        for v in (-BORDER, 0, BORDER):
            for u in (-BORDER, 0, BORDER):
                level, slope, fall, fit, variance, *color = maps[
                    np.clip(int(down) + v, 0, h - 1), np.clip(int(along) + u, 0, w - 1)
                ]
                guess = level + slope * (along - 0.5 - w / 2) + fall * (down - 0.5 - h / 2) - rough[row, column]
                off = np.square((np.array(color) - picture[row, column]) / COLOR).sum()
                near = np.square(guess / (NOISE * max(rough[row, column], LEAST)))
                guesses.append(guess)
                weights.append(fit * np.exp(-off / 2) * (np.exp(-near / 2) + OUTLIER))
                variances.append(variance)
        weight, guess = np.array(weights), np.array(guesses)
        inverse[row, column], deviation[row, column] = rough[row, column], NOISE * rough[row, column]
        if weight.sum() > 1e-12:
            mean = np.average(guess, weights=weight)
            inverse[row, column] += mean
            varied = np.average(np.square(guess - mean), weights=weight)
            deviation[row, column] = np.sqrt(varied + np.average(variances, weights=weight))
    return inverse, deviation


@pytest.mark.parametrize("size", [(12, 16), (27, 37), (36, 48)])
def test_it_is_the_weighted_mean_of_nine_planes(size):
    """At a size as that of the windows, at three times as much, and at no whole multiple."""
    rng = np.random.default_rng(1)
    h, w = 12, 16
    maps = np.concatenate(
        [
            rng.normal(1.0, 0.03, (h, w, 1)), rng.normal(0.0, 1e-3, (h, w, 2)), rng.uniform(0.0, 1.0, (h, w, 1)),
            rng.uniform(1e-6, 1e-4, (h, w, 1)), rng.uniform(0.3, 0.6, (h, w, 4)),
        ],
        axis=2,
    )  # fmt: skip
    rough, picture = rng.normal(1.0, 0.03, size), rng.uniform(0.3, 0.6, (*size, 4))
    rough[2, 3] = 0.0  # a pixel without a splat
    picture[4, 5] = 4.0  # a colour that no window has
    found = filtered(*(a.astype(np.float32) for a in (maps, rough, picture)), BORDER, NOISE, OUTLIER, COLOR, LEAST)
    expected = defined(*(a.astype(np.float32).astype(np.float64) for a in (maps, rough, picture)))
    np.testing.assert_allclose(found[0], expected[0], atol=2e-5)
    np.testing.assert_allclose(found[1], expected[1], rtol=2e-2, atol=2e-5)
    assert found[0][4, 5] == pytest.approx(rough[4, 5], abs=1e-6)
