"""ST maps as other programs write them: supported conventions, and messages for the others."""

import numpy as np
import OpenImageIO as oiio
import pytest

from tests.backend.pictures import write
from torch_backend.contract import ExitCode, JobError
from torch_backend.footage.oiio_types import open_output
from torch_backend.lens.lens import Lens
from torch_backend.lens.map_reading import fingerprint, read_lens
from torch_backend.lens.stmap import redistort_map, undistort_map

WIDTH, HEIGHT = 320, 180
FRAMES = {"width": WIDTH, "height": HEIGHT, "source_size": [2 * WIDTH, 2 * HEIGHT]}
TRUTH = Lens(WIDTH, HEIGHT, (240.0, 240.0), (240.0, 240.0), (164.0, 86.0), -0.18, 0.03, 0.002, -0.001)


class Heard(list):
    """Records warnings."""

    def warning(self, message, hint=""):
        self.append(message)


def places(width, height, beyond=0.0):
    """Pixel centres [h, w, 2] of a picture that is extended by a fraction of its size on every side, in its own
    pixels."""
    across, down = round(beyond * width), round(beyond * height)
    x, y = np.arange(-across, width + across) + 0.5, np.arange(-down, height + down) + 0.5
    return np.stack(np.meshgrid(x, y), -1)


def undistorting(width=WIDTH, height=HEIGHT, beyond=0.0, lens=TRUTH):
    """[h, w, 2] of s and t for an undistorted picture that extends beyond the plate."""
    ratio = width / WIDTH
    at = places(width, height, beyond)
    original = lens.to_original(at.reshape(-1, 2) / ratio).reshape(at.shape)
    return original / [WIDTH, HEIGHT] * [1, -1] + [0, 1]


def redistorting(beyond=0.0):
    return redistort_map(TRUTH, WIDTH, HEIGHT, (beyond, beyond))[..., :2].astype(float)


def written(folder, st, kind=oiio.FLOAT, names=("R", "G", "B"), name="map.exr", **window):
    """Write a file of s and t; additional channels are 1."""
    st = np.asarray(st, np.float32)
    pixels = np.ones((*st.shape[:2], len(names)), np.float32)
    for n, channel in enumerate("RG"[: st.shape[2]]):
        where = next((i for i, one in enumerate(names) if one.rpartition(".")[2].upper() == channel), n)
        pixels[..., where] = st[..., n]
    spec = oiio.ImageSpec(st.shape[1], st.shape[0], len(names), kind)
    spec.channelnames = tuple(names)
    for key, value in window.items():
        setattr(spec, key, value)
    output = oiio.ImageOutput.create(str(folder / name))
    assert open_output(output, folder / name, spec) and output.write_image(pixels) and output.close()
    return str(folder / name)


def read(path, way="undistort", layer="", **frames):
    heard = Heard()
    return read_lens(path, way, layer, {**FRAMES, **frames}, heard), heard


def error_px(lens, beyond=0.0):
    """Largest error, in pixels of 320 x 180, from original to the map's undistorted picture, over the whole
    original."""
    at = places(WIDTH, HEIGHT)[::7, ::7].reshape(-1, 2)
    found = lens.map_of_plate(lens.to_plate(at))
    found = (found * (1.0 + 2.0 * beyond) - beyond) * [WIDTH, HEIGHT]
    return float(np.hypot(*(found - TRUTH.to_plate(at)).T).max())


def test_both_ways_and_overscan_give_the_same_lens(tmp_path):
    lens, heard = read(written(tmp_path, undistorting()))
    assert error_px(lens) < 1e-3, "also in the corners, which are not in this map"
    assert ["does not cover the whole original picture" in one for one in heard] == [True]
    assert lens.window == (1.0, 1.0)
    wide, heard = read(written(tmp_path, undistorting(beyond=0.2)))
    assert error_px(wide, 0.2) < 1e-3 and heard == []
    back, heard = read(written(tmp_path, redistorting()), "redistort")
    assert error_px(back) < 2e-3 and heard == []
    over, _ = read(written(tmp_path, redistorting(0.1)), "redistort")
    assert error_px(over, 0.1) < 2e-3
    # All maps give the same lens and plate: the widest window without missing pixels.
    at = places(WIDTH, HEIGHT)[::9, ::9].reshape(-1, 2)
    for variant in (back, over):
        np.testing.assert_allclose(variant.to_original(at), wide.to_original(at), atol=0.05)


def test_maps_that_this_product_writes_are_read_again(tmp_path):
    both = [
        read(written(tmp_path, make(TRUTH, WIDTH, HEIGHT)[..., :2]), way)[0]
        for make, way in ((undistort_map, "undistort"), (redistort_map, "redistort"))
    ]
    assert [error_px(lens) < 2e-3 for lens in both] == [True, True]


@pytest.mark.parametrize("size", [(160, 90), (640, 360)])
def test_maps_of_another_size_are_of_the_same_picture(tmp_path, size):
    lens, _ = read(written(tmp_path, undistorting(*size, beyond=0.2)))
    assert error_px(lens, 0.2) < 2e-3


def test_overscan_as_a_data_window_beyond_the_picture(tmp_path):
    """As written by Nuke: the display window is the plate, and coordinates and sizes refer to it."""
    st = undistorting(beyond=0.1)
    path = written(tmp_path, st, x=-32, y=-18, full_x=0, full_y=0, full_width=WIDTH, full_height=HEIGHT)
    lens, heard = read(path)
    assert error_px(lens) < 1e-3 and heard == []
    assert 1.01 < lens.window[0] < 1.1, "the plate shows some of what is beyond"


def test_t_may_run_down_and_that_is_said(tmp_path):
    lens, heard = read(written(tmp_path, undistorting(beyond=0.2) * [1, -1] + [0, 1]))
    assert error_px(lens, 0.2) < 1e-3
    assert heard == ["The ST map map.exr counts t from the top, and is read that way."]


def test_sixteen_bits_are_smoothed(tmp_path):
    """Near 1, half floats have a step of one pixel at a width of 2048: 0.3 px at 640 here, and more outside the
    picture."""
    lens, heard = read(written(tmp_path, undistorting(beyond=0.1), oiio.HALF))
    assert error_px(lens, 0.1) < 0.1
    assert "16-bit" in heard[0]
    lens, _ = read(written(tmp_path, np.clip(undistorting(), 0, 1), oiio.UINT16, name="map.tif"))
    assert error_px(lens) < 0.02


def test_invalid_map_areas_are_ignored(tmp_path):
    st = undistorting(beyond=0.2)
    inside = ((st > 0) & (st < 1)).all(-1, keepdims=True)
    for name, path in {
        "clamped": written(tmp_path, np.clip(st, 0.0, 1.0), name="a.exr"),
        "black": written(tmp_path, np.where(inside, st, 0.0), name="b.exr"),
    }.items():
        lens, _ = read(path)
        assert error_px(lens, 0.2) < 2e-3, name
    rgb = np.concatenate([st, inside.astype(float)], -1)
    rgb[..., :2][~inside[..., 0]] = 0.7
    write(tmp_path / "c.exr", rgb.astype(np.float32), ("R", "G", "A"))
    assert error_px(read(str(tmp_path / "c.exr"))[0], 0.2) < 2e-3


def test_layers(tmp_path):
    st = undistorting(beyond=0.2)
    one = written(tmp_path, st, names=("lens.R", "lens.G"), name="one.exr")
    assert error_px(read(one)[0], 0.2) < 1e-3, "the only pair there is"
    two = written(tmp_path, st, names=("a.back.R", "a.back.G", "b.x", "b.y"), name="two.exr")
    with pytest.raises(JobError, match=r"several layers that could be the map: a\.back, b") as refused:
        read(two)
    assert "--st-map-layer" in refused.value.hint
    assert error_px(read(two, layer="Back")[0], 0.2) < 1e-3
    with pytest.raises(JobError, match="no layer 'front'"):
        read(two, layer="front")
    with pytest.raises(JobError, match="no red and green channel"):
        read(written(tmp_path, st[..., :1], names=("Y",), name="grey.exr"))


def test_anamorphic_maps_work_for_stored_and_square_pixels(tmp_path):
    st = undistorting(beyond=0.2)
    footage = {"reading": {"pixel_aspect": 2.0}}
    for variant in (st, 0.5 * (st[:, ::2] + st[:, 1::2])):
        lens, _ = read(written(tmp_path, variant), **footage)
        assert error_px(lens, 0.2) < 0.05 and lens.window[0] == pytest.approx(lens.window[1], abs=0.01)
    with pytest.raises(JobError, match="aspect ratios differ"):
        read(written(tmp_path, st[:, ::2]))


def noisy(st):
    return st + np.random.default_rng(0).normal(0.0, 0.002, st.shape)


def holed(st):
    st = st.copy()
    st[7, 9] = np.nan
    return st


def folded(st):
    u = places(WIDTH, HEIGHT) / [WIDTH, HEIGHT] - 0.5
    r2 = (u**2).sum(-1, keepdims=True)
    return 0.5 + 1.1 * u * [1, -1] * (1.0 - 2.2 * r2)


def four_to_three():
    lens = Lens(320, 240, (240.0, 240.0), (240.0, 240.0), (160.0, 120.0), -0.1)
    return undistort_map(lens, 320, 240)[..., :2]


def moved(st):
    at = places(WIDTH, HEIGHT) - 0.5
    return at / [WIDTH, HEIGHT] * [1, -1] + [0, 1]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (noisy, r"not a smooth map of a lens: at column \d+, row \d+ it differs by \d\.\d\d pixels"),
        (holed, r"contains 1 pixels that are not numbers \(NaN\), the first at column 9, row 7"),
        (folded, r"folds over: at \d+ % of the width"),
        (moved, r"has no distortion, but moves the whole picture by -1\.00 and -1\.00 pixels"),
        (lambda st: st * [WIDTH, HEIGHT], r"contains pixels \(up to 3\d\d\) instead"),
        (lambda st: st - moved(st) + 0.001, "contains no coordinates: red grows by"),
        (lambda st: st[:, ::-1], "is mirrored"),
        (lambda st: st[..., ::-1], "has s and t swapped"),
        (lambda st: np.zeros_like(st), "has coordinates in only 0 % of its picture"),
        (lambda st: four_to_three(), "is 320 x 240, the footage 640 x 360: their aspect ratios differ"),
    ],
    ids=["noise", "NaN", "fold", "identity with an offset", "pixels", "displacement", "mirrored", "swapped", "black",
         "shape"],
)  # fmt: skip
def test_what_is_no_map_of_this_lens_is_refused_in_a_sentence(tmp_path, change, words):
    with pytest.raises(JobError, match=words) as refused:
        read(written(tmp_path, change(undistorting())))
    assert refused.value.hint and refused.value.exit_code == ExitCode.USAGE
    assert refused.value.message.startswith("The ST map map.exr ")


def test_map_of_a_different_shape_is_refused_in_both_directions(tmp_path):
    with pytest.raises(JobError, match="aspect ratios differ"):
        read(written(tmp_path, redistorting()[:, 40:280]), "redistort")


def test_eight_bits_and_what_is_no_file_are_refused(tmp_path):
    st = np.clip(undistorting(), 0, 1)
    with pytest.raises(JobError, match="8 bits per channel"):
        read(written(tmp_path, st, oiio.UINT8, name="map.png"))
    (tmp_path / "text.exr").write_text("no picture")
    for path in (tmp_path / "text.exr", tmp_path / "gone.exr", tmp_path):
        with pytest.raises(JobError, match="cannot be read") as refused:
            read(str(path))
        assert refused.value.exit_code == ExitCode.USAGE
    with pytest.raises(JobError, match="cannot be read"):
        fingerprint(str(tmp_path / "gone.exr"))


def test_a_map_that_bends_nothing_is_taken_and_said(tmp_path):
    lens, heard = read(written(tmp_path, places(WIDTH, HEIGHT) / [WIDTH, HEIGHT] * [1, -1] + [0, 1]))
    assert lens.is_none and lens.window == (1.0, 1.0) and "has no distortion" in heard[0]


def test_map_type_is_detected_by_content(tmp_path):
    one = written(tmp_path, undistorting(), name="a.exr")
    (tmp_path / "copy.exr").write_bytes((tmp_path / "a.exr").read_bytes())
    assert fingerprint(one) == fingerprint(str(tmp_path / "copy.exr"))
    assert fingerprint(one) != fingerprint(written(tmp_path, redistorting(), name="b.exr"))
