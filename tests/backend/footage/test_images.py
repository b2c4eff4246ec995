"""Image files: round trip, sizes, and full disks."""

import errno

import numpy as np
import pytest

from torch_backend.footage.images import read_png, resize, working_size, write_png


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_png_gives_back_what_was_written(tmp_path, dtype):
    pixels = np.random.default_rng(0).integers(0, np.iinfo(dtype).max + 1, (31, 17, 3), dtype=dtype)
    write_png(tmp_path / "a.png", pixels)
    got = read_png(tmp_path / "a.png")
    assert got.dtype == dtype
    assert (got == pixels).all()
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]


def test_a_picture_that_cannot_be_written_leaves_the_old_one(tmp_path):
    write_png(tmp_path / "a.png", np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(ValueError, match="uint8 or uint16"):
        write_png(tmp_path / "a.png", np.zeros((4, 4, 3), np.float32))
    assert (read_png(tmp_path / "a.png") == 0).all()


def test_writing_where_no_file_can_be_is_an_os_error(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(OSError) as error:
        write_png(tmp_path / "file" / "a.png", np.zeros((4, 4, 3), np.uint8))
    assert error.value.errno in (errno.ENOTDIR, errno.EEXIST)


def test_reading_names_the_file(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"a\.png"):
        read_png(tmp_path / "a.png")
    (tmp_path / "a.png").write_bytes(b"no picture")
    with pytest.raises(ValueError, match=r"a\.png cannot be read"):
        read_png(tmp_path / "a.png")


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_resizing_keeps_depth_and_does_not_shift(dtype):
    top = np.iinfo(dtype).max
    y, x = np.mgrid[:120, :160]
    smooth = 0.5 + 0.4 * np.sin((x + 0.5) / 160 * 6.0) * np.cos((y + 0.5) / 120 * 4.0)
    pixels = np.repeat((smooth * top)[..., None], 3, axis=2).astype(dtype)
    small = resize(pixels, 80, 60)
    y, x = np.mgrid[:60, :80]
    expected = 0.5 + 0.4 * np.sin((x + 0.5) / 80 * 6.0) * np.cos((y + 0.5) / 60 * 4.0)
    assert (small.shape, small.dtype) == ((60, 80, 3), dtype)
    assert np.abs(small[2:-2, 2:-2, 0] / top - expected[2:-2, 2:-2]).max() < 0.006


@pytest.mark.parametrize(
    ("size", "wanted", "expected"),
    [
        ((640, 480), 0, (640, 480)),
        ((1920, 1080), 0, (1280, 720)),
        ((1920, 1080), 1080, (1920, 1080)),
        ((1920, 1080), 2160, (1920, 1080)),
        ((1440, 1080), 0, (960, 720)),
        ((4096, 1716), 0, (1718, 720)),
        ((1080, 1920), 0, (720, 1280)),
        ((2160, 3840), 0, (720, 1280)),
        ((3000, 3000), 0, (960, 960)),
        ((1080, 1350), 0, (858, 1072)),
        ((720, 900), 0, (720, 900)),
        ((1080, 1920), 720, (404, 720)),
        ((63, 47), 0, (63, 47)),
        ((1920, 1080), 361, (640, 360)),
    ],
)
def test_working_size(size, wanted, expected):
    assert working_size(*size, wanted) == expected
