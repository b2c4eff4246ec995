"""Undistortion: sampling compared with pictures defined by a formula, the map compared with the lens model."""

import numpy as np
import pytest

from tests.backend.lens.test_lens import of_colmap
from torch_backend.cameras import imported
from torch_backend.footage.display import PLAIN, ROLLED
from torch_backend.lens.plate_lens import PlateLens
from torch_backend.lens.undistort import BandUndistorter, Undistorter, of_frames


def identity(height, width):
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1).astype(np.float32)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_an_identity_map_changes_nothing(dtype):
    pixels = np.random.default_rng(0).integers(0, np.iinfo(dtype).max + 1, (33, 21, 3), dtype=dtype)
    got = Undistorter(identity(33, 21))(pixels)
    assert got.dtype == dtype
    assert (got == pixels).all()


def test_whole_shifts_move_pixels_and_repeat_the_border():
    pixels = np.random.default_rng(0).integers(0, 256, (12, 10, 3), dtype=np.uint8)
    got = Undistorter(identity(12, 10) + np.float32([2, -1]))(pixels)
    assert (got[1:, :8] == pixels[:-1, 2:]).all()
    assert (got[1:, 9] == pixels[:-1, 9]).all()


def test_fractions_of_pixels_follow_a_smooth_picture():
    def wave(x, y):
        return 30000 + 20000 * np.sin(x / 9.0) * np.cos(y / 7.0)

    at = identity(60, 80)
    pixels = np.repeat(wave(at[..., 0], at[..., 1])[..., None], 3, axis=2).astype(np.uint16)
    where = at + np.float32([0.37, -0.61])
    got = Undistorter(where)(pixels)
    expected = wave(where[..., 0], where[..., 1])
    assert np.abs(got[3:-3, 3:-3, 1] - expected[3:-3, 3:-3]).max() < 12  # bilinear: 61


def test_overshoot_is_clipped_not_wrapped():
    pixels = np.zeros((8, 8, 3), np.uint8)
    pixels[:, 4:] = 255
    got = Undistorter(identity(8, 8) + np.float32([0.5, 0]))(pixels)
    assert got[0, :3].max() < 5 and got[0, 5:].min() > 250


def test_sizes_must_agree():
    with pytest.raises(ValueError, match="sizes differ"):
        Undistorter(identity(8, 8))(np.zeros((8, 9, 3), np.uint8))
    with pytest.raises(ValueError, match=r"\[H, W, 2\]"):
        Undistorter(np.zeros((8, 8), np.float32))


LENSES = {
    "barrel": ("SIMPLE_RADIAL", [140.0, 82.0, 57.0, -0.15]),
    "mild": ("SIMPLE_RADIAL", [140.0, 82.0, 57.0, -0.02]),
    "none": ("SIMPLE_RADIAL", [140.0, 82.0, 57.0, 0.0]),
    "pincushion": ("SIMPLE_RADIAL", [140.0, 82.0, 57.0, 0.08]),
    "tangential": ("OPENCV", [140.0, 150.0, 80.0, 60.0, -0.1, 0.02, 0.003, -0.002]),
    "eight terms": ("FULL_OPENCV", [140.0, 150.0, 80.0, 60.0, -0.1, 0.02, 0.003, -0.002, 0.01, 0.05, -0.01, 0.002]),
    "fisheye": ("OPENCV_FISHEYE", [90.0, 92.0, 82.0, 57.0, 0.03, -0.01, 0.004, -0.001]),
    "plain fisheye": ("SIMPLE_RADIAL_FISHEYE", [90.0, 82.0, 57.0, 0.0]),
}


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    """maps(name): the worker's pinhole and map of a lens."""
    found = of_colmap(tmp_path_factory.mktemp("maps"), LENSES)
    return lambda name: (found[name]["pinhole"], found[name]["where"])


def assert_no_blank_pixels(where):
    assert where.min() >= 0.5 - 1e-3
    assert where[..., 0].max() <= 159.5 + 1e-3 and where[..., 1].max() <= 119.5 + 1e-3


@pytest.mark.parametrize("name", ["barrel", "mild", "none", "pincushion"])
def test_the_map_is_the_lens_model_without_blank_pixels(maps, name):
    pinhole, where = maps(name)
    k = LENSES[name][1][3]
    at = identity(120, 160)
    ideal = (at - pinhole[2:]) / pinhole[:2]
    expected = 140.0 * ideal * (1 + k * (ideal**2).sum(-1, keepdims=True)) + [82.0, 57.0]
    assert np.allclose(where, expected, atol=2e-4)
    assert tuple(pinhole[2:]) == (82.0, 57.0)
    assert_no_blank_pixels(where)
    # The widest such view: its border touches the border of the distorted picture at some point.
    gaps = [where[..., 0].min() - 0.5, where[..., 1].min() - 0.5]
    gaps += [159.5 - where[..., 0].max(), 119.5 - where[..., 1].max()]
    assert min(gaps) < 2e-3


def test_a_tangential_lens_keeps_its_pixel_aspect(maps):
    pinhole, where = maps("tangential")
    assert pinhole[1] / pinhole[0] == pytest.approx(150 / 140)
    assert_no_blank_pixels(where)


@pytest.mark.parametrize("name", LENSES)
def test_plates_of_any_size_lose_the_lens_that_the_working_frames_lost(maps, name):
    model, params = LENSES[name]
    pinhole, where = maps(name)
    lens = PlateLens(imported.lens_from_colmap(model, 160, 120, params), tuple(pinhole))
    assert lens.is_none == (name == "none")
    np.testing.assert_allclose(lens.where(160, 120), where, atol=1e-4)
    # A source of three times the size, up to rounding: every third pixel centre is a pixel centre of the working frame.
    wide = lens.where(480, 361)[:, 1::3] / [3.0, 361 / 120]
    np.testing.assert_allclose(wide[..., 0].mean(0), lens.where(160, 361)[..., 0].mean(0, dtype=float), atol=1e-4)
    np.testing.assert_allclose(lens.where(480, 360)[1::3, 1::3] / 3.0, where, atol=1e-4)


@pytest.mark.parametrize("kind", ["bent", "beyond the border", "turned"])
def test_bands_are_the_matrix_in_float(kind):
    """Undistorter is exact but needs much memory; BandUndistorter must agree, also outside the border and across
    bands."""
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 65536, (200, 90, 3), dtype=np.uint16)
    at = identity(200, 90)
    where = {
        "bent": at + np.sin(at[..., ::-1] / 17.0) * np.float32([3.0, 5.0]),
        "beyond the border": at * np.float32(1.4) - np.float32([20.3, 40.7]),
        "turned": at[::-1] + np.float32(0.37),
    }[kind].astype(np.float32)
    got = BandUndistorter(where)(
        picture, lambda x: x / np.float32(65535), lambda x: x, np.empty(picture.shape, np.float32)
    )
    want = Undistorter(where)(picture)
    assert np.abs(np.clip(got, 0, 1) * 65535 - want).max() < 4
    assert got.min() < 0 and got.max() > 1  # overshoot is not clipped
    with pytest.raises(ValueError, match=r"\[H, W, 2\]"):
        BandUndistorter(where[..., 0])


def test_row_bands_do_not_change_the_result_at_any_size():
    picture = np.random.default_rng(0).normal(0.5, 10.0, (70, 30, 3)).astype(np.float32)
    same = BandUndistorter(identity(70, 30))(picture, lambda x: x, lambda x: x, np.empty_like(picture))
    assert (same == picture).all()
    part = BandUndistorter(identity(20, 10) + np.float32([5, 40]))
    assert (part(picture, lambda x: x, lambda x: x, np.empty((20, 10, 3), np.float32)) == picture[40:60, 5:15]).all()


def test_a_lamp_in_a_working_frame_with_a_shoulder_gets_no_brighter_rim():
    light = np.full((48, 64, 3), 0.1, np.float32)
    light[15:30, 20:40] = 20.0
    codes = np.rint(ROLLED.from_light(light) * 65535.0).astype(np.uint16)
    where = identity(48, 64) * np.float32(0.97) + np.float32(0.7)
    plain = Undistorter(where)
    got = of_frames(plain, where, ROLLED)(codes)
    assert got.dtype == np.uint16
    found = ROLLED.to_light(got / 65535.0)
    assert found.max() == pytest.approx(20.0, rel=0.1) and found.min() > 0.07
    assert ROLLED.to_light(plain(codes) / 65535.0).max() > 30.0, "as codes it would ring"
    assert of_frames(plain, where, PLAIN) is plain
