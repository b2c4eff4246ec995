"""Measurements of frames, compared with known pictures; detection of cuts; choice of frames."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from torch_backend.footage.analysis import (
    FrameMeasures,
    automatic_step,
    choose_solved,
    flag_duplicate,
    measure,
    thumbnail,
)


def flat(value, dtype=np.uint8):
    return np.full((48, 64, 3), value, dtype)


def plain(count, **flags):
    """Measures of frames 1 to `count` with equal sharpness; flags by frame, such as f5="blank"."""
    return [FrameMeasures(i, 10.0, 0.0, [flags[f"f{i}"]] if f"f{i}" in flags else []) for i in range(1, count + 1)]


@pytest.mark.parametrize(("linear", "stops"), [(0.18, 0.0), (0.36, 1.0), (0.09, -1.0)])
def test_exposure_is_in_stops_above_grey(linear, stops):
    encoded = 1.055 * linear ** (1 / 2.4) - 0.055
    assert measure(1, flat(round(encoded * 255))).exposure == pytest.approx(stops, abs=0.03)
    assert measure(1, flat(round(encoded * 65535), np.uint16)).exposure == pytest.approx(stops, abs=0.001)


def test_sharpness_is_the_variance_of_the_laplacian():
    rng = np.random.default_rng(0)
    grey = rng.integers(0, 256, (40, 50), dtype=np.uint8)
    f = grey.astype(np.float64)
    laplacian = f[:-2, 1:-1] + f[2:, 1:-1] + f[1:-1, :-2] + f[1:-1, 2:] - 4 * f[1:-1, 1:-1]
    assert measure(1, np.repeat(grey[..., None], 3, 2)).sharpness == pytest.approx(laplacian.var(), rel=1e-3)


def test_blur_lowers_sharpness(pan):
    sharp = pan(1, height=96, width=128)[0]
    soft = gaussian_filter(sharp, (2, 2, 0))
    assert measure(1, soft).sharpness < 0.3 * measure(1, sharp).sharpness


@pytest.mark.parametrize(("value", "blank"), [(0, True), (255, True), (90, True), (None, False)])
def test_blank_frames(pan, value, blank):
    pixels = pan(1)[0] if value is None else flat(value)
    assert (measure(1, pixels).flags == ["blank"]) == blank


def test_thumbnail_is_the_mean_of_blocks():
    pixels = np.random.default_rng(0).integers(0, 256, (72, 128, 3), dtype=np.uint8)
    expected = pixels.reshape(36, 2, 64, 2, 3).mean((1, 3))
    assert np.allclose(thumbnail(pixels), expected, atol=1e-3)
    assert thumbnail(np.zeros((20, 30, 3), np.uint8)).shape == (20, 30, 3)


def test_a_repeated_frame_is_flagged_and_a_slow_pan_is_not(pan):
    frames = pan(3)
    one, two = measure(1, frames[0]), measure(2, frames[1])
    again = measure(2, np.clip(frames[0].astype(int) + np.eye(48, 64, dtype=int)[..., None], 0, 255).astype(np.uint8))
    assert flag_duplicate(again, one) and again.flags == ["duplicate"]
    assert not flag_duplicate(two, one) and not two.flags


@pytest.mark.parametrize(
    ("count", "fps", "step"), [(74, 10, 1), (150, 29, 2), (232, 29, 3), (10, 24, 1), (1800, 30, 12), (1800, 240, 26)]
)
def test_automatic_step(count, fps, step):
    assert automatic_step(count, fps) == step


@given(st.integers(1, 5000), st.floats(0, 240))
def test_automatic_step_never_outruns_the_camera(count, fps):
    step = automatic_step(count, fps)
    assert step >= 1
    assert step <= max(1, round(fps * 0.4))


def test_a_step_keeps_both_ends():
    assert choose_solved(plain(10), 4) == {1, 5, 9, 10}
    assert choose_solved(plain(10), 1) == set(range(1, 11))


def test_flagged_frames_give_way_to_their_neighbours():
    assert choose_solved(plain(9, f4="blank", f1="duplicate"), 3) & {1, 4} == set()
    chosen = choose_solved(plain(9, f4="blank"), 3)
    assert {1, 7, 9} < chosen and chosen & {3, 5}


def test_a_blurred_frame_gives_way_to_the_sharpest_near_it():
    frames = plain(11)
    frames[5].sharpness, frames[7].sharpness = 1.0, 11.0  # frame 6 is blurred, frame 8 is the sharpest
    assert choose_solved(frames, 5) == {1, 8, 11}


def test_a_step_below_one_is_refused():
    with pytest.raises(ValueError, match="got 0"):
        choose_solved(plain(9), 0)


@given(st.integers(8, 120), st.integers(1, 20), st.sets(st.integers(1, 120)))
def test_chosen_frames_are_usable_and_no_denser_than_the_step(count, step, bad):
    frames = plain(count, **{f"f{i}": "blank" for i in bad})
    chosen = choose_solved(frames, step)
    assert not chosen & bad
    assert len(chosen) <= -(-count // step) + 2
