"""Depth maps as written by programs and phones: which values are used, and which are dropped and why."""

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from torch_backend.contract import ExitCode, JobError
from torch_backend.footage.depth_maps import UnusableMap, find_depth, read_map


def write(path: Path, channels: dict[str, np.ndarray], kind=oiio.FLOAT):
    planes = np.stack([np.asarray(plane, np.float32) for plane in channels.values()], axis=-1)
    spec = oiio.ImageSpec(planes.shape[1], planes.shape[0], planes.shape[2], kind)
    if path.suffix == ".exr":
        spec.channelnames = tuple(channels)
    path.parent.mkdir(parents=True, exist_ok=True)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec) and output.write_image(planes) and output.close()


RAMP = np.linspace(0.1, 0.9, 64 * 48, dtype=np.float32).reshape(48, 64)
UNRELATED = np.full_like(RAMP, 0.3)


@pytest.mark.parametrize(
    "channels",
    [
        {"Z": RAMP},
        {"R": UNRELATED, "G": UNRELATED, "B": 2 * UNRELATED, "Z": RAMP},
        {"ViewLayer.Combined.R": UNRELATED, "ViewLayer.Depth.Z": RAMP},
        {"Normal.X": UNRELATED, "Normal.Y": UNRELATED, "Normal.Z": UNRELATED, "depth.V": RAMP},
        {"Y": RAMP},
        {"whatever": RAMP},
        {"R": RAMP, "G": RAMP, "B": RAMP},
    ],
)
def test_the_channel_of_depth_is_found_in_an_exr(tmp_path, channels):
    write(tmp_path / "a.exr", channels)
    np.testing.assert_allclose(read_map(tmp_path / "a.exr"), RAMP, rtol=1e-6)


@pytest.mark.parametrize(("ending", "kind", "tolerance"), [("png", oiio.UINT16, 1e-5), ("tif", oiio.UINT16, 1e-5)])
def test_whole_numbers_of_16_bits_are_read(tmp_path, ending, kind, tolerance):
    write(tmp_path / f"a.{ending}", {"Y": RAMP}, kind)
    np.testing.assert_allclose(read_map(tmp_path / f"a.{ending}"), RAMP, atol=tolerance)


def test_what_is_not_finite_or_zero_or_endlessly_far_is_unknown(tmp_path):
    holes = RAMP.copy()
    holes[0, :5] = [np.nan, np.inf, 0.0, 1e10, -np.inf]
    write(tmp_path / "a.exr", {"Z": holes})
    read = read_map(tmp_path / "a.exr")
    assert np.isnan(read[0, :5]).all()
    np.testing.assert_array_equal(read[1:], RAMP[1:])


@pytest.mark.parametrize(
    "channels",
    [
        {"R": RAMP, "G": UNRELATED, "B": UNRELATED},
        {"Normal.X": UNRELATED, "Normal.Y": UNRELATED, "Normal.Z": RAMP},
        {"Z": np.full_like(RAMP, np.nan)},
        {"Z": np.zeros_like(RAMP)},
    ],
)
def test_pictures_that_hold_no_depth_are_of_no_use(tmp_path, channels):
    write(tmp_path / "a.exr", channels)
    with pytest.raises(UnusableMap):
        read_map(tmp_path / "a.exr")


def test_maps_match_by_number_and_unusable_ones_are_reported(world, quiet, tmp_path):
    folder = tmp_path / "depth"
    for n in range(16):
        write(folder / f"d.{101 + n:04d}.exr", {"Z": RAMP + n})
    (folder / "d.0103.exr").unlink()
    (folder / "d.0104.exr").write_bytes(b"no picture")
    write(folder / "d.0105.exr", {"Z": RAMP[:20]})
    write(folder / "d.0106.exr", {"Z": np.full_like(RAMP, np.nan)})
    found = find_depth(world.shot, str(folder), quiet())
    read = {frame: found.read(frame) for frame in range(101, 117)}
    assert [frame for frame, values in read.items() if values is None] == [103, 104, 105, 106]
    np.testing.assert_allclose(read[110], RAMP + 9, rtol=1e-6)
    messages = found.refused_words(16)
    assert messages.startswith("4 of 16 ") and messages.count("\n") == 0
    assert all(
        part in messages for part in ("frame 103 is missing", "frame 104 cannot be read", "64x20", "frame 106 contains")
    )


def test_the_key_follows_the_contents(world, quiet, tmp_path):
    for n in range(16):
        write(tmp_path / f"d.{101 + n:04d}.exr", {"Z": RAMP})
    before = find_depth(world.shot, str(tmp_path), quiet()).key
    assert find_depth(world.shot, str(tmp_path), quiet()).key == before
    write(tmp_path / "d.0108.exr", {"Z": 2 * RAMP})
    assert find_depth(world.shot, str(tmp_path), quiet()).key != before


def test_missing_folder_or_no_sequence_is_refused(world, quiet, tmp_path):
    for place in (tmp_path / "nowhere", tmp_path):
        with pytest.raises(JobError) as refused:
            find_depth(world.shot, str(place), quiet())
        assert refused.value.exit_code == ExitCode.FOOTAGE
