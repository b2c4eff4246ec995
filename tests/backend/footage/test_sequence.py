"""Image sequences: real EXR and PNG files, their numbers, depth and colour."""

import numpy as np
import OpenImageIO as oiio
import pytest

from torch_backend.contract import ExitCode, JobError
from torch_backend.footage.color import srgb_to_linear
from torch_backend.footage.sources import open_source


def write(path, pixels, names=None, window=None, full=None, **attributes):
    spec = oiio.ImageSpec(
        pixels.shape[1], pixels.shape[0], pixels.shape[2], str(pixels.dtype).replace("float16", "half")
    )
    if names:
        spec.channelnames = names
    if full:
        spec.full_x, spec.full_y, spec.full_width, spec.full_height = full
        spec.x, spec.y = window
    for name, value in attributes.items():
        spec.attribute(name, value)
    out = oiio.ImageOutput.create(str(path))
    assert out and out.open(str(path), spec) and out.write_image(pixels) and out.close(), oiio.geterror()


@pytest.fixture
def exrs(tmp_path):
    """Frames 1001 to 1010 of scene-linear half floats: a ramp that brightens frame by frame."""
    ramp = np.linspace(0.0, 0.9, 64, dtype=np.float32)
    for i in range(10):
        pixels = np.tile((ramp * (0.5 + 0.05 * i))[None, :, None], (48, 1, 3)).astype(np.float16)
        write(tmp_path / f"shot.{1001 + i}.exr", pixels)
    return tmp_path


@pytest.mark.parametrize("name", ["", "shot.1004.exr", "shot.####.exr", "shot.%04d.exr", "shot.@@@@.exr"])
def test_folder_file_and_patterns_mean_the_same_sequence(exrs, name):
    source = open_source(str(exrs / name) if name else str(exrs))
    frames = list(source.frames(1003, 1006))
    assert [f.number for f in frames] == [1003, 1004, 1005, 1006]
    assert (source.info.first, source.info.last, source.info.width, source.info.height) == (1001, 1010, 64, 48)


def test_linear_pictures_become_sixteen_bit_srgb(exrs):
    source = open_source(str(exrs))
    frame = next(iter(source.frames(None, None)))
    assert (source.info.colour, source.info.deep, frame.pixels.dtype) == ("linear", True, np.uint16)
    expected = (np.linspace(0.0, 0.9, 64) * 0.5).astype(np.float16)
    assert np.allclose(srgb_to_linear(frame.pixels[10, :, 0] / 65535.0), expected, atol=2e-5)


def test_times_count_frames_at_the_files_rate(tmp_path):
    for i in range(1, 10):
        write(tmp_path / f"a.{i:03d}.exr", np.zeros((8, 8, 3), np.float16), FramesPerSecond=30.0)
    source = open_source(str(tmp_path))
    assert source.info.fps == 30.0
    assert [f.seconds for f in source.frames(4, 6)] == pytest.approx([3 / 30, 4 / 30, 5 / 30])
    assert open_source(str(tmp_path), fps=12.0).info.fps == 12.0


def test_bright_and_broken_values_are_clipped_and_counted(tmp_path):
    pixels = np.full((8, 8, 3), 0.25, np.float32)
    pixels[0, :4] = [4.0, 0.1, 0.1]
    pixels[1, 0] = np.nan
    pixels[1, 1] = -1.0
    for i in range(1, 4):
        write(tmp_path / f"a.{i}.exr", pixels)
    frame = next(iter(open_source(str(tmp_path)).frames(None, None)))
    assert frame.clipped == pytest.approx(4 / 64)
    assert frame.pixels[0, 0, 0] == 65535
    assert (frame.pixels[1, :2] == 0).all()


def test_channels_are_found_by_name_and_layer(tmp_path):
    pixels = np.stack([np.full((8, 8), v, np.float32) for v in (0.9, 0.1, 0.2, 0.3)], axis=-1)
    for i in range(1, 4):
        write(tmp_path / f"a.{i}.exr", pixels, names=("depth.Z", "view.B", "view.G", "view.R"))
    frame = next(iter(open_source(str(tmp_path)).frames(None, None)))
    assert srgb_to_linear(frame.pixels[0, 0] / 65535.0) == pytest.approx([0.3, 0.2, 0.1], abs=1e-4)


def test_a_data_window_is_placed_in_its_picture(tmp_path):
    for i in range(1, 4):
        write(tmp_path / f"a.{i}.exr", np.full((4, 4, 3), 1.0, np.float32), window=(2, 3), full=(0, 0, 10, 8))
    frame = next(iter(open_source(str(tmp_path)).frames(None, None)))
    expected = np.zeros((8, 10), bool)
    expected[3:7, 2:6] = True
    assert frame.pixels.shape == (8, 10, 3)
    assert ((frame.pixels[..., 0] == 65535) == expected).all()


def test_eight_bit_pictures_stay_as_they_are(tmp_path):
    rng = np.random.default_rng(0)
    stored = [rng.integers(0, 256, (9, 7, 4), dtype=np.uint8) for _ in range(3)]
    for i, pixels in enumerate(stored):
        pixels[..., 3] = 255
        write(tmp_path / f"a{i + 7:04d}.png", pixels)
    frames = list(open_source(str(tmp_path)).frames(None, None))
    assert [f.number for f in frames] == [7, 8, 9]
    assert all((f.pixels == pixels[..., :3]).all() for f, pixels in zip(frames, stored))


def test_gaps_and_unreadable_files_are_named(exrs):
    (exrs / "shot.1003.exr").unlink()
    (exrs / "shot.1005.exr").write_bytes((exrs / "shot.1005.exr").read_bytes()[:200])
    source = open_source(str(exrs))
    numbers = [f.number for f in source.frames(None, None)]
    assert numbers == [1001, 1002, 1004, 1006, 1007, 1008, 1009, 1010]
    assert [w[0] for w in source.warnings] == [
        "The sequence lacks frame 1003.",
        "Frame 1005 cannot be read: left out of the shot.",
    ]


def test_pictures_of_two_sizes_are_refused(exrs):
    write(exrs / "shot.1006.exr", np.zeros((20, 30, 3), np.float16))
    with pytest.raises(JobError, match=r"shot\.1006\.exr is 30x20, the sequence began with 64x48\."):
        list(open_source(str(exrs)).frames(None, None))


def test_a_folder_of_two_sequences_asks_which(exrs):
    for i in range(3):
        write(exrs / f"other.{i}.png", np.zeros((8, 8, 3), np.uint8))
    with pytest.raises(JobError, match="holds 2 image sequences"):
        open_source(str(exrs))
    assert open_source(str(exrs / "other.1.png")).info.last == 2


@pytest.mark.parametrize("name", ["", "single.png", "none.####.exr", "gone.png", "gone.mp4"])
def test_what_is_no_sequence_is_refused(tmp_path, name):
    write(tmp_path / "single.png", np.zeros((8, 8, 3), np.uint8))
    with pytest.raises(JobError) as error:
        open_source(str(tmp_path / name) if name else str(tmp_path))
    assert error.value.exit_code == ExitCode.FOOTAGE
    assert error.value.message.count(".") <= 3
    assert error.value.hint
