"""Orientation in headers: videos, pictures and masks are shown as in a standard-conforming viewer."""

import math

import av
import numpy as np
import OpenImageIO as oiio
import pytest

from torch_backend.contract import JobError
from torch_backend.footage.importing import FootageConfig, import_footage
from torch_backend.footage.masks import read_masks
from torch_backend.footage.opening import open_source
from torch_backend.footage.sources import Known
from torch_backend.shot import Shot

UPRIGHT = {
    1: lambda x: x,
    2: lambda x: x[:, ::-1],
    3: lambda x: x[::-1, ::-1],
    4: lambda x: x[::-1],
    5: lambda x: x.swapaxes(0, 1),
    6: lambda x: x[::-1].swapaxes(0, 1),
    7: lambda x: x[::-1, ::-1].swapaxes(0, 1),
    8: lambda x: x[:, ::-1].swapaxes(0, 1),
}
"""Map from EXIF code to the upright picture, by the standard's definition of first row and column."""
MATRICES = {
    1: (1, 0, 0, 1), 2: (-1, 0, 0, 1), 3: (-1, 0, 0, -1), 4: (1, 0, 0, -1),
    5: (0, 1, 1, 0), 6: (0, 1, -1, 0), 7: (0, -1, -1, 0), 8: (0, -1, 1, 0),
}  # fmt: skip
COS, SIN = math.cos(math.radians(30)), math.sin(math.radians(30))


def set_matrix(path, a, b, c, d):
    """Write a display matrix into the header of an MP4's first track."""
    data = bytearray(path.read_bytes())
    at = data.find(b"tkhd") + 44
    rows = [round(65536 * value) for value in (a, b, 0, c, d, 0, 0, 0, 16384)]
    data[at : at + 36] = np.array(rows, ">i4").tobytes()
    path.write_bytes(bytes(data))


def write_pictures(folder, frames, codes, suffix="png"):
    folder.mkdir()
    for number, (pixels, code) in enumerate(zip(frames, codes, strict=True), start=1):
        buffer = oiio.ImageBuf(np.ascontiguousarray(pixels))
        buffer.specmod().attribute("Orientation", code)
        assert buffer.write(str(folder / f"f_{number:04d}.{suffix}"))


def same(a, b):
    return a.shape == b.shape and np.abs(a.astype(int) - b.astype(int)).mean() < 2


@pytest.mark.parametrize("code", MATRICES)
def test_a_video_is_shown_by_its_display_matrix_when_read_and_when_read_again(tmp_path, pan, write_video, code):
    frames = pan(8)
    write_video(tmp_path / "a.mp4", frames)
    set_matrix(tmp_path / "a.mp4", *MATRICES[code])
    source = open_source(str(tmp_path / "a.mp4"))
    got = list(source.frames(None, None))
    assert (source.info.width, source.info.height) == got[0].pixels.shape[1::-1]
    assert all(same(one.pixels, UPRIGHT[code](frame)) for one, frame in zip(got, frames, strict=True))
    reader = source.plates(Known({n: (n - 1) / 24 for n in range(1, 9)}, 0.0, lambda *_: True))
    assert same(reader.plate(6), UPRIGHT[code](frames[5]))
    reader.close()


@pytest.mark.parametrize("matrix", [(COS, SIN, -SIN, COS), (0, 2, -1, 0), (1, 0.5, 0, 1), (0, 0, 0, 0)])
def test_unsupported_display_matrix_is_reported_and_ignored(tmp_path, pan, write_video, matrix):
    frames = pan(8)
    write_video(tmp_path / "a.mp4", frames)
    set_matrix(tmp_path / "a.mp4", *matrix)
    source = open_source(str(tmp_path / "a.mp4"))
    assert same(next(source.frames(None, None)).pixels, frames[0]) and (source.info.width, source.info.height) == (
        64,
        48,
    )
    assert any("read as stored" in message for message, _ in source.warnings) and source.info.mismatch


def test_a_matrix_that_only_enlarges_changes_nothing(tmp_path, pan, write_video):
    frames = pan(8)
    write_video(tmp_path / "a.mp4", frames)
    set_matrix(tmp_path / "a.mp4", 0, 2, -2, 0)
    source = open_source(str(tmp_path / "a.mp4"))
    assert same(next(source.frames(None, None)).pixels, UPRIGHT[6](frames[0])) and not source.warnings


def test_a_mirrored_clip_of_two_fields_is_shown_by_its_matrix(tmp_path, pan):
    """Deinterlacing keeps the side data of frames."""
    graph = av.filter.Graph()
    nodes = [
        graph.add_buffer(width=128, height=96, format="yuv444p", time_base="1/25"), graph.add("setfield", "tff"),
        graph.add("buffersink"),
    ]  # fmt: skip
    graph.link_nodes(*nodes).configure()
    still = pan(1, 96, 128)[0]
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 128, 96, "yuv444p"
        stream.options = {"crf": "0", "flags": "+ildct+ilme", "x264-params": "tff=1"}
        for i in range(8):
            frame = av.VideoFrame.from_ndarray(still, "rgb24").reformat(format="yuv444p")
            frame.pts = i
            graph.push(frame)
            container.mux(stream.encode(graph.pull()))
        container.mux(stream.encode())
    set_matrix(tmp_path / "a.mp4", *MATRICES[5])
    source = open_source(str(tmp_path / "a.mp4"))
    got = list(source.frames(None, None))
    assert source.info.reading["interlaced"] and all(same(one.pixels, UPRIGHT[5](still)) for one in got)


@pytest.mark.parametrize("code", MATRICES)
@pytest.mark.parametrize("suffix", ["jpg", "tif", "png"])
def test_pictures_are_shown_by_their_exif_orientation(tmp_path, pan, code, suffix):
    frames = pan(3)
    write_pictures(tmp_path / "a", frames, [code] * 3, suffix)
    source = open_source(str(tmp_path / "a"))
    got = list(source.frames(None, None))
    wanted = [UPRIGHT[code](frame) for frame in frames]
    near = 6 if suffix == "jpg" else 1
    for pixels in [got[2].pixels, source.plates(Known({}, None, lambda *_: True)).plate(3)]:
        assert pixels.shape == wanted[2].shape and np.abs(pixels.astype(int) - wanted[2]).mean() < near
    assert bool(source.info.mismatch) == (code != 1)


@pytest.mark.parametrize(
    ("second_orientation", "words"), [(3, "turned by 180 degrees"), (6, "turned clockwise"), (2, "mirrored")]
)
def test_pictures_that_differ_in_orientation_are_refused(tmp_path, pan, second_orientation, words):
    """The headers cannot tell whether the pixels or the orientation tags of such a sequence are consistent."""
    write_pictures(tmp_path / "a", pan(4), [1, 1, second_orientation, second_orientation])
    with pytest.raises(JobError) as caught:
        list(open_source(str(tmp_path / "a")).frames(None, None))
    assert "f_0003.png" in caught.value.message and words in caught.value.message


@pytest.mark.parametrize("kind", ["picture", "video"])
def test_masks_are_turned_as_their_headers_say(tmp_path, pan, write_video, recorder, kind):
    shot = Shot.create(tmp_path / "shot")
    write_video(tmp_path / "a.mp4", pan(8))
    import_footage(shot, str(tmp_path / "a.mp4"), FootageConfig(), recorder())
    white = np.zeros((48, 64, 3), np.uint8)
    white[:10, :20] = 255
    if kind == "picture":
        write_pictures(tmp_path / "m", [UPRIGHT[8](white)], [6])
        mask = tmp_path / "m" / "f_0001.png"
    else:
        mask = tmp_path / "m.mp4"
        write_video(mask, [np.ascontiguousarray(UPRIGHT[7](white))] * 8)
        set_matrix(mask, *MATRICES[7])
    covered = read_masks(shot, {"ignore": str(mask)}, recorder())["ignore"].of(3)
    assert np.array_equal(covered, white[..., 0] > 0)
