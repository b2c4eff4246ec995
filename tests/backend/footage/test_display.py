"""Display encoding of working frames: light far above white survives 16 bits, and values below white are unchanged."""

import json

import numpy as np
import pytest

from tests.backend.pictures import write
from torch_backend.contract import JobError
from torch_backend.footage import FootageConfig, import_footage
from torch_backend.footage.color import linear_to_srgb, srgb_to_linear
from torch_backend.footage.display import MOST_LIGHT, PLAIN, ROLLED, clipped_share, display_of
from torch_backend.footage.images import read_png
from torch_backend.footage.importing import import_key
from torch_backend.footage.opening import open_source
from torch_backend.shot import Shot

LIGHT = np.concatenate([np.linspace(-0.1, 1.0, 500), np.geomspace(1.002, MOST_LIGHT, 2000)]).astype(np.float32)
HALF_A_STEP = 0.5 / 65535.0


def test_below_the_shoulder_it_is_srgb_and_above_it_goes_on_at_the_same_slope():
    shown, srgb = ROLLED.from_light(LIGHT), linear_to_srgb(LIGHT)
    assert (shown[srgb <= 0.8] == srgb[srgb <= 0.8]).all()
    assert (np.diff(shown) > 0).all() and 0.999 < shown[-1] < 1.0
    around = np.array([0.799, 0.8, 0.801], np.float32)
    below, above = np.diff(ROLLED.bent(around))
    assert above == pytest.approx(below, rel=0.03)
    assert ROLLED.from_light(65504.0) < 1.2, "of what a half float holds nothing runs away"


def test_light_comes_back_and_from_sixteen_bits_within_a_thousandth():
    np.testing.assert_allclose(ROLLED.to_light(ROLLED.from_light(LIGHT)), LIGHT, rtol=1e-5, atol=1e-7)
    bright = LIGHT[LIGHT > 0.6]
    stored = np.rint(ROLLED.from_light(bright) * 65535.0) / 65535.0
    np.testing.assert_allclose(ROLLED.to_light(stored), bright, rtol=5e-4)
    dark = LIGHT[(LIGHT >= 0.0) & (LIGHT <= 0.6)]
    stored = np.rint(ROLLED.from_light(dark) * 65535.0) / 65535.0
    np.testing.assert_allclose(linear_to_srgb(ROLLED.to_light(stored)), linear_to_srgb(dark), atol=1.1 * HALF_A_STEP)


def test_without_a_shoulder_nothing_is_touched():
    shown = np.linspace(-0.2, 6.0, 300, dtype=np.float32)
    assert PLAIN.bent(shown) is shown and PLAIN.straightened(shown) is shown
    assert (PLAIN.to_light(shown) == srgb_to_linear(shown)).all()
    assert display_of({}) == PLAIN and display_of({"display": ROLLED.name}) == ROLLED
    with pytest.raises(JobError, match=r"does not know: 'filmic'\."):
        display_of({"display": "filmic"})
    with pytest.raises(ValueError, match="cannot show scene-linear light"):
        PLAIN.codes_of(np.zeros((2, 2, 3), np.float16), 2, 2)


@pytest.mark.parametrize("display", [PLAIN, ROLLED])
def test_alpha_is_unpremultiplied_before_the_curve(display):
    shown = np.array([0.5, 0.9, 0.97], np.float32)
    rgba = np.append(shown * 0.25, np.float32(0.25))
    expected = np.append(display.to_light(shown) * 0.25, 0.25)
    np.testing.assert_allclose(display.premultiplied_to_light(rgba), expected, rtol=2e-4)


def test_downscaled_highlight_has_no_overshoot():
    """With the shoulder's encoding, a resampling kernel with overshoot would make the lamp's rim three times as
    bright."""
    plate = np.full((96, 128, 3), 0.1, np.float16)
    plate[30:60, 40:70] = 20.0
    for size in ((64, 48), (92, 70)):
        light = ROLLED.light_of(ROLLED.codes_of(plate, *size)).astype(np.float32)
        assert light.max() == pytest.approx(20.0, rel=0.1) and light.min() > 0.07


def test_what_is_brighter_than_the_display_holds_is_counted():
    plate = np.full((4, 5, 3), 0.5, np.float16)
    plate[0, 0], plate[1, 1, 2], plate[2, 2] = MOST_LIGHT, 65504.0, -3.0
    assert clipped_share(plate) == pytest.approx(1 / 20)


def test_an_exr_of_lamps_is_imported_with_them(tmp_path, recorder):
    """Light 50 is recovered from the working frame. Frames that version 0.2 clipped stay unchanged."""
    wall = np.random.default_rng(0).uniform(0.1, 0.9, (48, 100, 3))
    for n in range(9):
        picture = np.ascontiguousarray(wall[:, 4 * n : 4 * n + 64]).astype(np.float16)
        picture[8:16, 30:40], picture[30, 30], picture[2, 2] = 50.0, -0.5, 1000.0
        write(tmp_path / f"a.{n}.exr", picture)
    shot, report = Shot.create(tmp_path / "a.splannequin"), recorder()
    import_footage(shot, str(tmp_path), FootageConfig(), report)
    record = json.loads(shot.listing.read_text())
    assert (record["display"], record["brightest"], display_of(record).bends) == ("shoulder", 1.0, True)
    light = ROLLED.to_light(read_png(shot.raw / "000008.png") / 65535.0)
    assert light[8:16, 30:40] == pytest.approx(50.0, rel=1e-3)
    assert light[30, 30].max() == 0.0 and light[2, 2].min() > MOST_LIGHT
    kept = np.ones((48, 64), bool)
    kept[30, 30] = kept[2, 2] = False
    np.testing.assert_allclose(light[kept], picture.astype(np.float32)[kept], rtol=1e-3, atol=1e-5)


def test_finished_import_of_an_older_version_is_kept(tmp_path, recorder):
    wall = np.random.default_rng(0).uniform(0.1, 0.9, (48, 100, 3)).astype(np.float16)
    for n in range(9):
        write(tmp_path / f"a.{n}.exr", wall[:, 4 * n : 4 * n + 64])
    shot, config = Shot.create(tmp_path / "a.splannequin"), FootageConfig()
    import_footage(shot, str(tmp_path), config, recorder())
    record = json.loads(shot.listing.read_text())
    info = open_source(str(tmp_path)).info
    assert record["key"] == import_key(info, config) != import_key(info, config, PLAIN)
    assert record["brightest"] == pytest.approx(ROLLED.from_light(wall.max()).item(), abs=1e-4)
    del record["display"], record["brightest"]
    old = json.dumps({**record, "key": import_key(info, config, PLAIN)})
    shot.listing.write_text(old)
    report = recorder()
    import_footage(shot, str(tmp_path), config, report)
    assert shot.listing.read_text() == old, "the solve and the runs made of it stay"
