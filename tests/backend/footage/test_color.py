import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torch_backend.footage.color import (
    linear_to_srgb,
    linear_to_srgb8,
    on_straight_colour,
    srgb_to_linear,
)


def reference_to_linear(x):
    """IEC 61966-2-1 decoding in float64, extended to negative values as an odd function."""
    magnitude = np.abs(np.asarray(x, dtype=np.float64))
    return np.sign(x) * np.where(magnitude <= 0.04045, magnitude / 12.92, ((magnitude + 0.055) / 1.055) ** 2.4)


@pytest.mark.parametrize(
    ("encoded", "linear"),
    [(0.0, 0.0), (1.0, 1.0), (0.5, 0.21404114), (0.04045, 0.0031308), (0.7353569, 0.5), (-0.5, -0.21404114)],
)
def test_known_values_both_ways(encoded, linear):
    assert srgb_to_linear(encoded) == pytest.approx(linear, abs=2e-7)
    assert linear_to_srgb(linear) == pytest.approx(encoded, abs=2e-6)


def test_agrees_with_the_float64_formula_below_0_and_above_1():
    x = np.linspace(-4.0, 16.0, 100_001)
    np.testing.assert_allclose(srgb_to_linear(x), reference_to_linear(x.astype(np.float32)), rtol=2e-6, atol=1e-9)


@given(st.floats(min_value=-(2.0**126), max_value=2.0**126, width=32))
def test_every_linear_value_comes_back(value):
    back = srgb_to_linear(linear_to_srgb(value))
    assert back == pytest.approx(value, rel=1e-6 if abs(value) < 16 else 1e-5, abs=1e-37)


@given(st.floats(min_value=-(2.0**53), max_value=2.0**53, width=32))
def test_every_encoded_value_comes_back(value):
    assert linear_to_srgb(srgb_to_linear(value)) == pytest.approx(
        value, rel=1e-6 if abs(value) < 4 else 1e-5, abs=1e-37
    )


def test_strictly_rising_over_all_16_bit_codes():
    codes = np.arange(-65535, 65536, dtype=np.float64) / 65535.0
    assert (np.diff(srgb_to_linear(codes)) > 0).all()
    # Neighbouring float32 values may share a code in linear light, but codes must never decrease.
    assert (np.diff(linear_to_srgb(codes)) >= 0).all()


def test_keeps_shape_and_gives_float32():
    x = np.zeros((3, 5, 4), dtype=np.uint8)
    for convert in (srgb_to_linear, linear_to_srgb):
        assert convert(x).shape == x.shape
        assert convert(x).dtype == np.float32


def test_all_8_bit_codes_survive_the_round_trip():
    codes = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(linear_to_srgb8(srgb_to_linear(codes / 255.0)), codes)
    np.testing.assert_array_equal(linear_to_srgb8([-1.0, 7.0, np.nan]), [0, 255, 0])


def test_premultiplied_converts_the_straight_colour():
    half_covered_grey = np.array([0.25, 0.25, 0.25, 0.5])
    expected = reference_to_linear(0.5) * 0.5
    got = on_straight_colour(half_covered_grey, srgb_to_linear)
    np.testing.assert_allclose(got, [*[expected] * 3, 0.5], rtol=1e-6)
    np.testing.assert_allclose(on_straight_colour([0.5] * 4, srgb_to_linear), [0.5] * 4, rtol=1e-6)


def test_premultiplied_round_trip_including_thin_alpha():
    rng = np.random.default_rng(3)
    alpha = np.concatenate([rng.uniform(1e-6, 1.0, 500), np.zeros(4), np.ones(4)])[:, None]
    rgba = np.concatenate([rng.uniform(-0.2, 1.5, (len(alpha), 3)) * alpha, alpha], axis=1).astype(np.float32)
    back = on_straight_colour(on_straight_colour(rgba, srgb_to_linear), linear_to_srgb)
    np.testing.assert_allclose(back, rgba, rtol=1e-5, atol=1e-9)


def test_premultiplied_refuses_a_picture_without_alpha():
    with pytest.raises(ValueError, match=r"\[\.\.\., 4\], got shape \[2, 2, 3\]"):
        on_straight_colour(np.zeros((2, 2, 3)), srgb_to_linear)
