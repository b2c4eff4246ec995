from fractions import Fraction

import av
import numpy as np
import pytest

from torch_backend.freeze.take.video import rational_fps, write_video


def moving_picture(count, height, width):
    """Smooth, saturated, sliding colours with a hard-edged block."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    for index in range(count):
        red = 0.5 + 0.45 * np.sin((x + 3 * index) / 17.0)
        green = 0.5 + 0.45 * np.sin((y - 2 * index) / 23.0)
        frame = np.stack([red, green, (x + y) / (height + width)], axis=-1)
        frame[10:26, 8 + 4 * index : 24 + 4 * index] = 0.1
        yield (frame * 255.0 + 0.5).astype(np.uint8)


def decode(path):
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        tags = tuple(int(v) for v in (context.color_primaries, context.color_trc, context.colorspace))
        frames = [f.reformat(format="rgb24", src_colorspace="ITU709").to_ndarray() for f in container.decode(stream)]
        return stream.codec.name, stream.average_rate, stream.pix_fmt, tags, int(context.color_range), frames


def psnr(a, b):
    error = np.mean((a.astype(np.float64) - b.astype(np.float64)) ** 2)
    return 10.0 * np.log10(255.0**2 / error)


@pytest.mark.parametrize("size", [(120, 160), (121, 159)])
def test_decodes_to_the_same_pictures(tmp_path, size):
    stored = list(moving_picture(9, *size))
    path = tmp_path / "Größe 測試" / "video.mp4"
    assert write_video(path, iter(stored), 29.97) == ""
    codec, rate, layout, tags, color_range, frames = decode(path)
    assert (codec, layout, tags, color_range) == ("h264", "yuv420p", (1, 1, 1), 1)
    assert rate == Fraction(30000, 1001)
    assert len(frames) == 9
    for written, read in zip(stored, frames, strict=True):
        assert read.shape == (size[0] + size[0] % 2, size[1] + size[1] % 2, 3)
        assert psnr(written, read[: size[0], : size[1]]) > 35.0
    assert [p.name for p in path.parent.iterdir()] == ["video.mp4"]


def test_flat_colours_keep_their_rec709_values(tmp_path):
    """A wrong matrix or range would shift saturated patches by ten codes or more."""
    colours = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255], [0, 0, 0], [128, 60, 200]], np.uint8)
    patches = np.repeat(np.repeat(colours[None], 64, axis=0), 64, axis=1)
    path = tmp_path / "video.mp4"
    write_video(path, [patches] * 3, 24)
    with av.open(str(path)) as container:
        frame = next(container.decode(video=0))
    yuv = frame.to_ndarray()
    luma = yuv[32, 32:384:64].astype(np.float64)
    expected = 16.0 + colours @ np.array([0.2126, 0.7152, 0.0722]) * 219.0 / 255.0
    np.testing.assert_allclose(luma, expected, atol=1.5)


def test_odd_sizes_repeat_the_edge(tmp_path):
    frame = np.full((33, 31, 3), 40, np.uint8)
    frame[:, -3:] = 200
    frame[-3:] = 90
    path = tmp_path / "video.mp4"
    write_video(path, [frame] * 2, 25)
    read = decode(path)[-1][0].astype(int)
    assert read.shape == (34, 32, 3)
    assert np.abs(read[:28, 31] - 200).max() < 8
    assert np.abs(read[33, :28] - 90).max() < 8


def test_video_index_precedes_the_pictures(tmp_path):
    path = tmp_path / "video.mp4"
    write_video(path, moving_picture(5, 64, 64), 25)
    data = path.read_bytes()
    assert 0 < data.index(b"moov") < data.index(b"mdat")


@pytest.mark.parametrize(
    ("fps", "exact"),
    [
        (23.976, Fraction(24000, 1001)),
        (29.97, Fraction(30000, 1001)),
        (59.94005994, Fraction(60000, 1001)),
        (24.0, Fraction(24)),
        (25.0, Fraction(25)),
        (30.0, Fraction(30)),
        (12.5, Fraction(25, 2)),
        (1.0, Fraction(1)),
    ],
)
def test_rates_become_exact_fractions(fps, exact):
    assert rational_fps(fps) == exact


@pytest.mark.parametrize("fps", [0.0, -24.0, float("nan"), float("inf")])
def test_refuses_a_bad_rate(tmp_path, fps):
    with pytest.raises(ValueError, match="fps should be a positive number"):
        write_video(tmp_path / "video.mp4", moving_picture(2, 32, 32), fps)


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ([], "at least one frame"),
        ([np.zeros((32, 32, 4), np.uint8)], r"frames\[0\] should be \[H,W,3\] uint8"),
        ([np.zeros((32, 32, 3), np.float32)], r"frames\[0\]"),
        ([np.zeros((32, 32, 3), np.uint8), np.zeros((32, 34, 3), np.uint8)], r"frames\[1\] should be \[32, 32, 3\]"),
    ],
)
def test_refuses_bad_frames_and_leaves_nothing(tmp_path, frames, message):
    with pytest.raises(ValueError, match=message):
        write_video(tmp_path / "video.mp4", frames, 25)
    assert list(tmp_path.iterdir()) == []


def test_render_error_keeps_the_old_video(tmp_path):
    def broken():
        yield from moving_picture(3, 64, 64)
        raise RuntimeError("render failed")

    path = tmp_path / "video.mp4"
    write_video(path, moving_picture(2, 64, 64), 25)
    before = path.read_bytes()
    with pytest.raises(RuntimeError, match="render failed"):
        write_video(path, broken(), 25)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["video.mp4"]


def test_missing_h264_is_reported_and_a_video_is_written(tmp_path, monkeypatch):
    """Some builds of PyAV lack x264."""
    monkeypatch.setattr(av, "codecs_available", {"mpeg4"})
    stored = list(moving_picture(4, 120, 160))
    path = tmp_path / "video.mp4"
    assert "no H.264 encoder" in write_video(path, stored, 25)
    codec, *_, frames = decode(path)
    assert codec == "mpeg4"
    assert min(psnr(a, b) for a, b in zip(stored, frames, strict=True)) > 35.0
