"""Measured grain of a plate, compared with added grain; and synthesised grain."""

import numpy as np
import pytest

from torch_backend.footage.color import linear_to_srgb, srgb_to_linear
from torch_backend.footage.display import PLAIN, ROLLED
from torch_backend.footage.images import write_png
from torch_backend.freeze.composite.grain import BINS, Brush, Grain, _noise, draw, measure, measure_plate

AGREEMENT = np.array([[1.0, 0.6, 0.2], [0.6, 1.0, 0.3], [0.2, 0.3, 1.0]], np.float32)
HEIGHT, WIDTH = 192, 320


def scene(texture: float = 0.1) -> np.ndarray:
    """[H, W, 3] in 0..1: gradients over most levels, one half textured."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    picture = np.stack([0.1 + 0.8 * x / WIDTH, 0.1 + 0.8 * y / HEIGHT, 0.5 + 0.2 * np.sin(x / 60) * np.cos(y / 50)], -1)
    busy = (x // 32 + y // 32) % 2 == 1
    picture += texture * (np.sin(1.3 * x + 0.7 * y) * busy)[..., None]
    return picture


def noise(seed: int, softness: float) -> np.ndarray:
    """[H, W, 3] of standard deviation 1, blurred in the Fourier domain, independently of the tested code."""
    white = np.random.default_rng(seed).standard_normal((HEIGHT, WIDTH, 3)) @ np.linalg.cholesky(AGREEMENT).T
    fy, fx = np.fft.fftfreq(HEIGHT)[:, None], np.fft.fftfreq(WIDTH)[None, :]
    low = np.exp(-2.0 * (np.pi * softness) ** 2 * (fy**2 + fx**2))
    return np.fft.ifft2(np.fft.fft2(white, axes=(0, 1)) * (low / np.sqrt((low**2).mean()))[..., None], axes=(0, 1)).real


def stored(picture: np.ndarray, bits: int) -> np.ndarray:
    most = 2**bits - 1
    return np.clip(np.round(picture * most), 0, most).astype(np.uint8 if bits == 8 else np.uint16)


@pytest.mark.parametrize(
    ("deviation", "softness", "bits"), [(1.0, 0.6, 8), (8.0, 0.0, 8), (1.0, 1.0, 16), (8.0, 0.6, 16)]
)
def test_known_grain_is_recovered(deviation, softness, bits):
    found = measure([stored(scene() + noise(k, softness) * deviation / 255, bits) for k in range(4)])
    np.testing.assert_allclose(found.deviation[:, 1:-1] * 255, deviation, rtol=0.1)
    assert found.softness == pytest.approx(softness, abs=0.25)
    np.testing.assert_allclose(found.correlation, AGREEMENT, atol=0.1)


def test_grain_is_measured_per_brightness_level():
    base = scene()
    found = measure([stored(base + noise(k, 0.5) * (1.0 + 5.0 * base) / 255, 8) for k in range(6)])
    middles = (np.arange(BINS) + 0.5) / BINS
    for c in (0, 1):
        np.testing.assert_allclose(found.deviation[c, 1:-1] * 255, (1.0 + 5.0 * middles)[1:-1], rtol=0.15)


@pytest.mark.parametrize("bits", [8, 16])
def test_a_clean_clip_has_none(bits):
    found = measure([stored(scene(), bits)] * 3)
    assert found.deviation[:, 1:-1].max() * 255 < 0.15
    assert not draw(found, 1, np.full((8, 8, 4), 0.5, np.float32), (8, 8)).any() or found.deviation.any()


def test_a_clip_in_which_nothing_is_flat_has_no_grain_of_the_size_of_its_texture():
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    busy = 0.5 + 0.3 * np.sin(1.9 * x + 0.3 * y)[..., None] * np.ones(3)
    assert measure([stored(busy, 8)]).deviation.max() == 0.0
    assert measure([]).deviation.max() == 0.0 == measure([np.zeros((8, 8, 3), np.uint8)]).deviation.max()


@pytest.mark.parametrize("display", [PLAIN, ROLLED])
def test_a_plate_is_measured_from_its_files_on_whatever_display_they_are(tmp_path, display):
    files = [tmp_path / f"{k:06d}.png" for k in range(3)]
    for k, path in enumerate(files):
        picture = scene() + noise(k, 0.6) * 3.0 / 255
        write_png(path, display.codes(picture) if display.bends else stored(picture, 8))
    np.testing.assert_allclose(measure_plate(files, display).deviation[:, 1:-1] * 255, 3.0, rtol=0.1)


GRAIN = Grain(np.tile(np.linspace(2, 6, BINS, dtype=np.float32) / 255, (3, 1)), 0.7, AGREEMENT)


def flat(value: float, alpha: float = 1.0, size: tuple[int, int] = (WIDTH, HEIGHT)) -> np.ndarray:
    return np.array([value, value, value, 1.0], np.float32) * np.full((size[1], size[0], 1), alpha, np.float32)


def test_drawn_grain_is_what_was_measured():
    """Synthesised grain on a clean picture is measured with the same deviation, softness and channel correlation."""
    frames = []
    for k in range(4):
        picture = scene().astype(np.float32)
        rgba = np.concatenate([picture, np.ones_like(picture[..., :1])], axis=-1)
        frames.append(stored(linear_to_srgb(srgb_to_linear(picture) + draw(GRAIN, k, rgba, (WIDTH, HEIGHT))), 8))
    found = measure(frames)
    np.testing.assert_allclose(found.deviation[:2, 1:-1], GRAIN.deviation[:2, 1:-1], rtol=0.1)
    assert found.softness == pytest.approx(0.7, abs=0.15)
    np.testing.assert_allclose(found.correlation, AGREEMENT, atol=0.1)


def test_grain_depends_only_on_the_frame_and_has_zero_mean():
    first, again, next_frame = (draw(GRAIN, n, flat(0.5), (WIDTH, HEIGHT)) for n in (7, 7, 8))
    np.testing.assert_array_equal(first, again)
    assert abs(np.corrcoef(first.ravel(), next_frame.ravel())[0, 1]) < 0.02
    display = linear_to_srgb(first + srgb_to_linear(np.float32(0.5))) - 0.5
    assert abs(display.mean()) < 0.05 / 255
    assert draw(GRAIN, -3, flat(0.5), (WIDTH, HEIGHT)).std() > 0


def test_grain_ends_where_the_picture_does_and_never_leaves_black_or_white():
    assert not draw(GRAIN, 1, flat(0.5, alpha=0.0), (WIDTH, HEIGHT)).any()
    half, whole = (draw(GRAIN, 1, flat(0.5, alpha=a), (WIDTH, HEIGHT)) for a in (0.5, 1.0))
    np.testing.assert_allclose(half, 0.5 * whole, atol=1e-7)
    for value in (0.0, 1.0):
        grainy = srgb_to_linear(np.float32(value)) + draw(GRAIN, 1, flat(value), (WIDTH, HEIGHT))
        assert grainy.min() >= -1e-6 and grainy.max() <= 1.0 + 1e-6


def test_downscaled_frame_has_downscaled_plate_grain():
    large = draw(GRAIN, 1, flat(0.5), (WIDTH, HEIGHT))
    small = draw(GRAIN, 1, flat(0.5, size=(WIDTH // 2, HEIGHT // 2)), (WIDTH, HEIGHT))
    grey = srgb_to_linear(np.float32(0.5))
    means = linear_to_srgb(grey + large).reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean((1, 3))
    np.testing.assert_allclose(linear_to_srgb(grey + small), means, atol=1e-5)
    odd = draw(GRAIN, 1, flat(0.5, size=(401, 97)), (WIDTH, HEIGHT))
    assert odd.shape == (97, 401, 3) and 0.3 < odd.std() / large.std() < 1.1


@pytest.mark.parametrize("size", [(WIDTH + 3, HEIGHT), (WIDTH // 2, HEIGHT // 2)])
def test_grain_drawn_some_rows_at_a_time_is_the_same(size):
    width, height = size
    picture = np.random.default_rng(0).uniform(size=(height, width, 4)).astype(np.float32)
    ones = np.ones((height, width), np.float32)
    brush = Brush(GRAIN, 5, (height, width), (WIDTH, HEIGHT))
    parts = [
        brush.rows(of, picture[of, :, :3], picture[of, :, 3], ones[of])
        for of in (slice(top, top + 50) for top in range(0, height, 50))
    ]
    np.testing.assert_array_equal(np.concatenate(parts), draw(GRAIN, 5, picture, (WIDTH, HEIGHT)))


def light(encoded: np.ndarray) -> np.ndarray:
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


@pytest.mark.parametrize("is_light", [False, True])
def test_grain_is_noise_times_the_deviation_of_each_brightness(is_light):
    """Against its definition in float64, in a picture of half again the plate's size."""
    rng, (width, height), size = np.random.default_rng(2), (63, 36), (42, 24)
    noise = _noise(GRAIN, 9, size).astype(np.float64)
    for axis, length in ((0, height), (1, width)):
        before = noise.shape[axis]
        at = np.clip((np.arange(length) + 0.5) * before / length - 0.5, 0.0, before - 1.0)
        low = np.minimum(at.astype(int), before - 2)
        part = (at - low).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        noise = noise.take(low, axis) * (1.0 - part) + noise.take(low + 1, axis) * part
    shown, alpha, share = rng.uniform(0.0, 1.2, (height, width, 3)), *rng.uniform(0.0, 1.0, (2, height, width))
    share[:, 10:50] = 0.0
    premultiplied = shown * alpha[..., None]
    bins = (np.arange(BINS) + 0.5) / BINS
    straight = shown.clip(0.0, 1.0)
    deviation = np.stack([np.interp(straight[..., c], bins, GRAIN.deviation[c]) for c in range(3)], -1)
    want = light((straight + deviation * noise).clip(0.0, 1.0)) - light(straight)
    found = Brush(GRAIN, 9, (height, width), size).rows(
        slice(0, height), light(premultiplied) if is_light else premultiplied, alpha, share, is_light
    )
    np.testing.assert_allclose(found, want * (alpha * share)[..., None], atol=1e-6)
    assert not np.signbit(found[share == 0.0]).any(), "negative zeros do not compress"
