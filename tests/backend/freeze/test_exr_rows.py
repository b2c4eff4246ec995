"""Packed rows against OpenImageIO's own conversion, and against the rounding of each layer in float64."""

from typing import Any, cast

import numpy as np
import OpenImageIO as oiio
import pytest

from torch_backend.freeze.exr import linear_spec, set_margin, write_exr
from torch_backend.freeze.exr_rows import ROUNDED, Packing

NAMES = ("Z", "R", "G", "B", "A", "Über.V", "Motion.V")
FORMATS = (oiio.FLOAT, oiio.HALF, oiio.HALF, oiio.HALF, oiio.HALF, oiio.FLOAT, oiio.HALF)


def values(height: int, width: int) -> list[np.ndarray]:
    """[h, w], [h, w, 4], [h, w], [h, w]: colours of all magnitudes, a view with strides, and a broadcast."""
    rng = np.random.default_rng(1)
    colour = rng.normal(size=(height, width, 4)) * 10.0 ** rng.integers(-9, 7, (height, width, 4))
    wide = rng.normal(size=(height, 2 * width)).astype(np.float32)
    return [
        wide[:, ::2],
        colour.astype(np.float32),
        wide[::-1, 1::2],
        np.broadcast_to(np.float32(0.5), (height, width)),
    ]


@pytest.mark.parametrize("size", [(1, 1), (37, 53), (130, 64)])
def test_the_file_is_the_one_that_openimageio_writes(tmp_path, size):
    height, width = size
    spec = linear_spec(width, height, NAMES, FORMATS)
    set_margin(spec, (0, 0) if size == (1, 1) else (3, 2))
    parts = values(height, width)
    pixels = np.concatenate([part.reshape(height, width, -1) for part in parts], axis=2)
    pixels[..., 1:5] = pixels[..., 1:5].clip(-65504.0, 65504.0)
    output = cast(Any, oiio.ImageOutput).create(str(tmp_path / "a.exr"))
    assert output.open(str(tmp_path / "a.exr"), spec)
    assert output.write_scanlines(spec.y, spec.y + height, 0, pixels) and output.close()
    written = write_exr(tmp_path / "b.exr", spec, parts)
    assert written.read_bytes() == (tmp_path / "a.exr").read_bytes()


def nearest(x: np.ndarray, mantissa_bits: int) -> np.ndarray:
    """float64 `x` with so many bits of mantissa, as the number below it plus half a step or more."""
    step = 2.0 ** (np.floor(np.log2(np.abs(x))) - mantissa_bits)
    return np.sign(x) * np.floor(np.abs(x) / step + 0.5) * step


@pytest.mark.parametrize("name", ["grain", "splat", "plate", "rgba"])
def test_layers_are_rounded_to_nearest(name):
    x = np.random.default_rng(2).uniform(0.001, 1.0, (8, 500)).astype(np.float32)
    spec = linear_spec(500, 8, ("V",), (oiio.HALF,))
    found, infinite = Packing(spec, [name]).packed([x])
    exact = x.astype(np.float64)
    half = x.astype(np.float16).astype(np.float64)
    want = {
        "grain": nearest(half, 2), "splat": nearest(exact, 8), "plate": np.rint(exact * 256.0) / 256.0, "rgba": half,
    }  # fmt: skip
    assert not infinite and (set(ROUNDED) | {"rgba"}) == set(want)
    np.testing.assert_array_equal(found.astype(np.float64), want[name])


def test_all_halves_are_kept_and_floats_between_them_rounded_to_even():
    halves = np.arange(65536, dtype=np.uint16).view(np.float16)
    halves = halves[np.isfinite(halves)].astype(np.float32)
    between = (halves[:-1].astype(np.float64) + halves[1:]) / 2.0
    x = np.concatenate([halves, between.astype(np.float32)])[None]
    spec = linear_spec(x.shape[1], 1, ("V",), (oiio.HALF,))
    found = Packing(spec, [""]).packed([x])[0]
    np.testing.assert_array_equal(found.view(np.uint16), x.astype(np.float16).view(np.uint16))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_layers_that_are_not_finite_are_named(bad):
    spec = linear_spec(20, 3, ("R", "Z"), (oiio.HALF, oiio.FLOAT))
    good = np.zeros((3, 20), np.float32)
    for n in (0, 1):
        layers = [good, good]
        layers[n] = good.copy()
        layers[n][2, 17] = bad
        infinite = Packing(spec, ["first", "second"]).packed(layers)[1]
        assert infinite == [("first", "second")[n]]
    assert np.isnan(Packing(spec, ["", ""]).packed([good * np.nan, good])[0].view(np.float16)[0, :20]).all()
