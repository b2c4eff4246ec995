"""Linear fits of depth maps to the solve's points, compared with known lines."""

import numpy as np
import pytest

from torch_backend.train.depth_fit import KINDS, fit_sequence

FRAMES = 12


def scene(rng, count=400):
    """Depths of points: half on a wall at 6, the others from 1.5 to 5."""
    return np.concatenate([np.full(count // 2, 6.0), rng.uniform(1.5, 5.0, count // 2)])


def sequence(kind, slopes, shifts, noise=0.02, hidden=0.0, seed=0):
    """Map from frame to (values, depths) for maps of a kind, with noise relative to their spread and some hidden
    points."""
    rng, samples = np.random.default_rng(seed), {}
    for n in range(FRAMES):
        depth = scene(rng)
        shown = np.where(rng.random(len(depth)) < hidden, depth * rng.uniform(0.3, 0.9, len(depth)), depth)
        y = shown if kind == KINDS[0] else 1.0 / shown
        values = slopes[n] * y + shifts[n]
        samples[n] = values + noise * values.std() * rng.standard_normal(len(depth)), depth
    return samples


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_scale_and_shift_of_each_frame_are_found_whatever_the_maps_grow_with(kind, sign):
    rng = np.random.default_rng(1)
    slopes, shifts = sign * rng.uniform(0.2, 0.5, FRAMES), rng.uniform(-0.4, 0.4, FRAMES)
    fit = fit_sequence(sequence(kind, slopes, shifts))
    assert fit is not None and fit.kind == kind and fit.fits
    assert fit.residual < 0.03
    found = np.array([(fit.frames[n].slope, fit.frames[n].shift) for n in range(FRAMES)])
    np.testing.assert_allclose(found[:, 0], slopes, rtol=0.02)
    depth = np.linspace(1.5, 6.0, 20)
    for n in range(FRAMES):
        values = (slopes[n] * (depth if kind == KINDS[0] else 1.0 / depth) + shifts[n]).astype(np.float32)
        np.testing.assert_allclose(1.0 / fit.frames[n].inverse_of(values, kind), depth, rtol=0.03)


def test_points_that_something_hides_do_not_bend_the_fit():
    fit = fit_sequence(sequence(KINDS[0], [0.4] * FRAMES, [0.1] * FRAMES, noise=0.02, hidden=0.15))
    assert fit is not None and fit.fits and fit.kind == KINDS[0]
    assert all(abs(one.slope / 0.4 - 1.0) < 0.05 for one in fit.frames.values())


def test_the_deviation_that_it_states_is_that_of_the_maps():
    clean = sequence(KINDS[1], [2.0] * FRAMES, [0.3] * FRAMES, noise=0.0)
    rng = np.random.default_rng(3)
    noisy = {n: (values + 0.04 * rng.standard_normal(len(values)), depth) for n, (values, depth) in clean.items()}
    fit = fit_sequence(noisy)
    assert fit is not None
    assert np.median([one.sigma for one in fit.frames.values()]) == pytest.approx(0.04 / 2.0, rel=0.1)


def test_frame_without_points_uses_the_shared_fit_with_less_certainty():
    samples = sequence(KINDS[0], [0.4] * FRAMES, [0.1] * FRAMES)
    values, depth = samples[5]
    fit = fit_sequence({**samples, 5: (values[:3], depth[:3])})
    assert fit is not None
    assert fit.frames[5].points == 3 and fit.frames[5].slope == pytest.approx(0.4, rel=0.01)
    assert fit.frames[5].sigma >= np.median([fit.frames[n].sigma for n in range(FRAMES) if n != 5])


def test_metric_sequence_has_one_fit_despite_few_points():
    samples = sequence(KINDS[0], [0.4] * FRAMES, [0.1] * FRAMES, noise=0.1)
    few = np.random.default_rng(2).permutation(400)[:25]
    values, depth = samples[7]
    single = fit_sequence({7: (values[few], depth[few])})
    together = fit_sequence({**samples, 7: (values[few], depth[few])})
    assert single is not None and together is not None
    assert abs(together.frames[7].slope - 0.4) < abs(single.frames[7].slope - 0.4)


@pytest.mark.parametrize("seed", range(3))
def test_maps_of_something_else_do_not_fit(seed):
    samples = sequence(KINDS[0], [0.4] * FRAMES, [0.1] * FRAMES)
    rng = np.random.default_rng(seed)
    fit = fit_sequence({n: (rng.permutation(values), depth) for n, (values, depth) in samples.items()})
    assert fit is not None and not fit.fits


def test_no_points_give_no_fit():
    assert fit_sequence({1: (np.ones(5), np.ones(5))}) is None
