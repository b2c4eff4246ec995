"""Footage facts in take.json: path, meaning of values, and the map that undistorts the footage."""

import json

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from tests.backend.footage.test_plates import solved
from tests.backend.pictures import write
from tests.backend.quiet import Quiet
from torch_backend.contract import PROBE
from torch_backend.footage import FootageConfig, import_footage
from torch_backend.footage.color import srgb_to_linear
from torch_backend.footage.images import read_png, write_png
from torch_backend.footage.ocio import BUILT_IN, light_of
from torch_backend.footage.plates import Plates
from torch_backend.freeze.composite.warp import sample
from torch_backend.freeze.take.footage_facts import footage_facts
from torch_backend.lens.plate_lens import load_plate_lenses
from torch_backend.shot import Shot


def pictures(folder, count=9, size=(96, 128), suffix="png", **attributes):
    """Write pictures of a camera that pans over a smooth texture."""
    folder.mkdir()
    y, x = np.mgrid[0 : size[0], 0 : size[1] + 4 * count]
    wide = np.stack([0.5 + 0.3 * np.sin(x / 9 + k) * np.cos(y / (7 + k)) for k in range(3)], -1)
    wide += np.random.default_rng(0).uniform(-0.02, 0.02, wide.shape)
    for n in range(count):
        picture = np.ascontiguousarray(wide[:, 4 * n : 4 * n + size[1]])
        path = folder / f"a.{1001 + n}.{suffix}"
        if suffix == "png":
            write_png(path, np.rint(picture * 255).astype(np.uint8))
        else:
            write(path, picture.astype(np.float16), **attributes)
    return folder


@pytest.fixture
def shot_of(tmp_path):
    def make(folder, radial=0.0, **config):
        shot = Shot.create(tmp_path / "a.splannequin")
        import_footage(shot, str(folder), FootageConfig(working_height=48, **config), Quiet())
        return solved(shot, radial)

    return make


def facts_of(shot):
    take = shot.take("t")
    take.mkdir(parents=True, exist_ok=True)
    return footage_facts(shot, take), take


def test_footage_without_a_lens_of_a_varying_rate_and_gone(tmp_path, shot_of):
    shot = shot_of(pictures(tmp_path / "plate"))
    facts, take = facts_of(shot)
    assert facts["file"] == str(tmp_path / "plate" / "a.1001.png") and facts["beside"] == "../plate/a.1001.png"
    assert (facts["size"], facts["first"], facts["last"], facts["unlike"]) == ([128, 96], 1001, 1009, "")
    assert facts["probe"] == pytest.approx(srgb_to_linear(PROBE)) and facts["map"] == "" and not list(take.iterdir())
    record = json.loads(shot.listing.read_text())
    record["frames"][-1]["seconds"] += 0.03
    shot.listing.write_text(json.dumps(record))
    assert facts_of(shot)[0]["unlike"] == "its rate varies"
    for file in (tmp_path / "plate").iterdir():
        file.rename(file.with_suffix(".away"))
    assert facts_of(shot)[0] == {}


def test_full_size_map_undistorts_like_the_plates_and_is_computed_once_per_solve(tmp_path, shot_of):
    """The map gives positions in the footage's pixels; sampled with it, the footage equals the plate."""
    shot = shot_of(pictures(tmp_path / "plate"), radial=-0.2)
    facts, take = facts_of(shot)
    assert facts["map"] == "stmap/undistort.exr"
    st = np.asarray(oiio.ImageBuf(str(take / facts["map"])).get_pixels(oiio.FLOAT))
    where = load_plate_lenses(shot)[1005].where(128, 96)
    assert np.abs(st[..., 0] * 128 - where[..., 0]).max() < 1e-3
    assert np.abs((1.0 - st[..., 1]) * 96 - where[..., 1]).max() < 1e-3 and (st[..., 2] == 1.0).all()
    assert np.abs(where - (np.mgrid[0:96, 0:128][::-1].transpose(1, 2, 0) + 0.5)).max() > 1.0, "else nothing is bent"
    raw = torch.from_numpy(read_png(tmp_path / "plate" / "a.1005.png").astype(np.float32) / 255.0)
    seen, plate = sample(raw, torch.from_numpy(st[..., :2].copy())), Plates(shot).display(1005)
    assert float((seen - plate).abs()[3:-3, 3:-3].mean()) < 0.01 < float((raw - plate).abs().mean())
    file = take / facts["map"]
    before, pixels = file.stat().st_mtime_ns, file.read_bytes()
    facts_of(shot)
    assert file.stat().st_mtime_ns == before
    solved(shot, -0.15)
    facts_of(shot)
    assert file.read_bytes() != pixels


def test_log_footage_says_what_light_it_means(tmp_path, shot_of):
    facts, _ = facts_of(shot_of(pictures(tmp_path / "plate", suffix="exr"), colour_space="S-Log3 S-Gamut3"))
    expected = light_of(np.array([[PROBE]], np.float32), "S-Log3 S-Gamut3", BUILT_IN)[0, 0]
    assert facts["probe"] == pytest.approx(expected, rel=1e-4) and facts["space"] == "S-Log3 S-Gamut3 (OCIO)"


def test_footage_that_blender_shows_differently_is_recorded(tmp_path, shot_of):
    facts, _ = facts_of(shot_of(pictures(tmp_path / "plate", suffix="exr", PixelAspectRatio=2.0)))
    assert facts["unlike"] == "its pixels are not square"


def test_picture_orientation_is_recorded(tmp_path, shot_of):
    """Blender shows pictures as stored, without their orientation tag."""
    facts = facts_of(shot_of(pictures(tmp_path / "plate", suffix="exr", Orientation=6)))[0]
    assert facts["size"] == [96, 128]
    assert facts["unlike"] == "its pictures are turned clockwise according to their header"
