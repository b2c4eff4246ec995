"""Videos: real files written by the tests, decoded to the original pixels and times."""

import os
from fractions import Fraction

import av
import numpy as np
import pytest

from torch_backend.contract import ExitCode, JobError
from torch_backend.footage.opening import open_source
from torch_backend.footage.sources import Known, frame_words


def decoded(path, first=None, last=None):
    source = open_source(str(path))
    return source, list(source.frames(first, last))


def close(a, b, steps=3):
    return np.abs(a.astype(int) - b.astype(int)).mean() < steps


def test_pixels_numbers_and_times(tmp_path, pan, write_video):
    frames = pan(12)
    write_video(tmp_path / "a.mp4", frames, rate=25)
    source, got = decoded(tmp_path / "a.mp4")
    assert [f.number for f in got] == list(range(1, 13))
    assert np.allclose([f.seconds for f in got], np.arange(12) / 25)
    assert (source.info.width, source.info.height, source.info.fps, source.info.last) == (64, 48, 25.0, 12)
    assert all(close(f.pixels, frame, 2) for f, frame in zip(got, frames))


def test_a_range_keeps_the_clips_numbers(tmp_path, pan, write_video):
    frames = pan(12)
    write_video(tmp_path / "a.mp4", frames)
    _, got = decoded(tmp_path / "a.mp4", 4, 6)
    assert [f.number for f in got] == [4, 5, 6]
    assert close(got[0].pixels, frames[3], 2)


def test_variable_rate_has_real_timestamps(tmp_path, pan, write_video):
    at = [0, 40, 100, 140, 300, 340, 400, 460, 500, 900]
    write_video(tmp_path / "a.mp4", pan(10), milliseconds=at)
    _, got = decoded(tmp_path / "a.mp4")
    assert np.allclose([f.seconds for f in got], np.array(at) / 1000)


def test_ten_bit_video_keeps_its_depth(tmp_path, frame_of_planes):
    """The planes are built here because FFmpeg's scaler has errors of 1 in 256 in both directions."""
    luma = np.linspace(64, 940, 64).round().astype(np.uint16)
    planes = [np.tile(luma, (48, 1)), *np.full((2, 48, 64), 512, np.uint16)]
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=24)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv444p10le"
        for _ in range(3):
            container.mux(stream.encode(frame_of_planes(planes, "yuv444p10le")))
        container.mux(stream.encode())
    source, got = decoded(tmp_path / "a.mkv")
    assert source.info.deep
    assert got[0].pixels.dtype == np.uint16
    # One step of 10 bits is 64 of 65535; 8 bits would have errors of up to 128.
    assert np.abs(got[0].pixels[20, :, 0] - (luma - 64.0) * (65535 / 876)).max() < 16


@pytest.fixture
def interlaced(tmp_path, frame_of_planes):
    """interlaced(top_first): 12 interlaced H.264 frames of moving stripes; every fourth is a key frame.

    Returns the file, and the grey pictures [12, 96, 128] that a progressive camera takes at the times of the first
    fields.
    """

    def picture(instant):
        across = np.arange(128)[None, :] + np.arange(96)[:, None]
        return np.rint(120 + 80 * np.sin((across + 12 * instant) / 15.0)).astype(np.uint8)

    def make(top_first=True):
        path, firsts = tmp_path / "fields.mkv", [picture(2 * i) for i in range(12)]
        tagged = av.filter.Graph()
        nodes = [
            tagged.add_buffer(width=128, height=96, format="yuvj420p", time_base=Fraction(1, 25)),
            tagged.add("setfield", "tff" if top_first else "bff"),
            tagged.add("buffersink"),
        ]
        tagged.link_nodes(*nodes).configure()
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libx264", rate=25, options={"crf": "0", "x264-params": "interlaced=1"})
            stream.width, stream.height, stream.pix_fmt, stream.codec_context.gop_size = 128, 96, "yuvj420p", 4
            for i, first in enumerate(firsts):
                both, later = first.copy(), int(top_first)
                both[later::2] = picture(2 * i + 1)[later::2]
                planes = [both, *np.full((2, 48, 64), 128, np.uint8)]
                tagged.vpush(frame_of_planes(planes, "yuvj420p"))
                container.mux(stream.encode(tagged.vpull()))
            container.mux(stream.encode())
        return path, np.stack(firsts).astype(float)

    return make


@pytest.mark.parametrize("top_first", [True, False])
def test_interlaced_clips_are_deinterlaced_and_reported(interlaced, top_first):
    path, firsts = interlaced(top_first)
    source, got = decoded(path)
    assert [f.number for f in got] == list(range(1, 13))
    assert np.allclose([f.seconds for f in got], np.arange(12) / 25, atol=1e-3)
    pictures = np.stack([f.pixels[..., 1].astype(float) for f in got])
    inner = np.s_[:, 4:-4]
    assert np.abs(pictures - firsts)[inner].mean() < 1.0
    assert np.abs(pictures - firsts)[inner].max() < 8.0, "a comb of the other field is 60 off"
    assert [w[0] for w in source.warnings] == ["The clip is interlaced: each frame is built from its first field."]
    assert source.info.reading["interlaced"] and "deinterlaced" in source.info.key
    assert source.info.mismatch.startswith("it is interlaced")


def woven(frames, top_first=True):
    """Interlace each pair of frames as the two fields of one frame."""
    out = []
    for first, second in zip(frames[::2], frames[1::2], strict=True):
        both = first.copy()
        both[int(top_first) :: 2] = second[int(top_first) :: 2]
        out.append(both)
    return out


@pytest.mark.parametrize("top_first", [True, False])
def test_unmarked_interlaced_clip_is_deinterlaced(tmp_path, pan, write_video, top_first):
    frames = pan(40, 96, 128, speed=3)
    write_video(tmp_path / "a.mp4", woven(frames, top_first))
    source, got = decoded(tmp_path / "a.mp4")
    assert [w[0] for w in source.warnings] == [
        "The clip is interlaced, though it does not say so: each frame is built from its first field."
    ]
    assert source.info.reading["interlaced"] and source.info.mismatch.startswith("it is interlaced")
    errors = [np.abs(one.pixels.astype(int) - first)[4:-4].mean() for one, first in zip(got, frames[::2], strict=True)]
    assert max(errors) < 1.0, max(errors)
    reader = source.plates(Known({f.number: f.seconds for f in got}, 0.0, lambda number, plate: True))
    assert (reader.plate(9) == got[8].pixels).all()
    reader.close()


def test_film_on_interlaced_tape_is_known_by_its_combed_frames(tmp_path, pan, write_video):
    film = pan(32, 96, 128, speed=4)
    fields = [film[4 * (i // 10) + (0, 0, 1, 1, 1, 2, 2, 3, 3, 3)[i % 10]] for i in range(80)]
    write_video(tmp_path / "a.mp4", woven(fields))
    assert open_source(str(tmp_path / "a.mp4")).info.reading["interlaced"]


@pytest.mark.parametrize("what", ["still then moving", "stripes", "noise"])
def test_a_progressive_clip_is_none_of_fields(tmp_path, pan, write_video, what):
    frames = pan(40, 96, 128, speed=3)
    if what == "still then moving":
        frames = [frames[0]] * 20 + frames[:20]
    elif what == "stripes":  # lines as fine as fields, static in the scene
        lines = np.where(np.arange(96)[:, None, None] % 2, 40, -40)
        frames = [np.clip(f.astype(int) + lines, 0, 255).astype(np.uint8) for f in frames]
    else:
        rng = np.random.default_rng(0)
        frames = [np.clip(f + rng.normal(0, 15, f.shape), 0, 255).astype(np.uint8) for f in frames]
    write_video(tmp_path / "a.mp4", frames)
    assert not open_source(str(tmp_path / "a.mp4")).info.reading["interlaced"]


def test_a_plate_of_an_interlaced_clip_is_the_frame_that_was_imported(interlaced):
    """After a seek, decoding begins at a key frame; the deinterlacing filter also needs the frame before."""
    path, _ = interlaced()
    source, got = decoded(path)
    known = Known({f.number: f.seconds for f in got}, 0.0, lambda number, plate: True)
    for number in (5, 9, 2, 12):
        reader = source.plates(known)
        reader.plate(number)
        assert (reader.plate(number) == got[number - 1].pixels).all(), number
        reader.close()
    order = source.plates(known)
    for number in (12, 5, 1, 9):
        assert (order.plate(number) == got[number - 1].pixels).all(), number
    order.close()


def test_damaged_packets_are_skipped_with_a_warning_and_keep_their_numbers(tmp_path, pan, write_video):
    write_video(tmp_path / "a.mkv", pan(12), codec="mjpeg", pix_fmt="yuvj444p")
    damaged = tmp_path / "b.mkv"
    with av.open(str(tmp_path / "a.mkv")) as source, av.open(str(damaged), "w") as target:
        stream = target.add_stream_from_template(source.streams.video[0])
        for i, packet in enumerate(p for p in source.demux(video=0) if p.size):
            if i == 5:
                broken = av.Packet(b"\x00" * 200)
                broken.pts, broken.dts, broken.time_base = packet.pts, packet.dts, packet.time_base
                packet = broken
            packet.stream = stream
            target.mux(packet)
    source, got = decoded(damaged)
    assert [f.number for f in got] == [1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 12]
    assert source.warnings[0][0] == "Frame 6 cannot be decoded: left out of the shot."


@pytest.fixture
def truncated_clip(tmp_path, pan, write_video):
    """truncated_clip(suffix, share): first part of a clip of 24 frames with the header at the beginning of the file."""

    def make(suffix, share):
        whole = tmp_path / f"whole.{suffix}"
        options = {"codec": "mjpeg", "pix_fmt": "yuvj444p"} if suffix == "mov" else {}
        write_video(whole, pan(24), faststart=True, **options)
        content = whole.read_bytes()
        broken = tmp_path / f"broken.{suffix}"
        broken.write_bytes(content[: int(len(content) * share)])
        return broken

    return make


@pytest.mark.parametrize("suffix", ["mp4", "mov", "mkv"])
def test_truncated_file_reports_its_readable_part(truncated_clip, suffix):
    source, got = decoded(truncated_clip(suffix, 0.75))
    assert 12 <= len(got) < 24
    assert [f.number for f in got] == list(range(1, len(got) + 1))
    assert [w[0] for w in source.warnings] == [
        f"broken.{suffix} ends after frame {len(got)}, but its header announces 24."
    ]
    opened, got = decoded(truncated_clip(suffix, 0.75), 2, 10)  # the range ends before the break: no warning
    assert ([f.number for f in got], opened.warnings) == (list(range(2, 11)), [])


@pytest.mark.parametrize(("suffix", "share"), [("mp4", 0.6), ("mov", 0.45), ("mkv", 0.45)])
def test_less_than_half_of_a_file_is_refused(truncated_clip, suffix, share):
    with pytest.raises(JobError, match=r"ends after frame \d+, but its header announces 24\.") as error:
        decoded(truncated_clip(suffix, share))
    assert error.value.exit_code == ExitCode.FOOTAGE


def test_clip_ends_at_a_size_change_with_a_warning(tmp_path, pan, write_video):
    """Motion JPEG stores the size in every picture."""
    write_video(tmp_path / "a.mkv", pan(12), codec="mjpeg", pix_fmt="yuvj444p")
    write_video(tmp_path / "b.mkv", pan(12, height=64, width=48), codec="mjpeg", pix_fmt="yuvj444p")
    with av.open(str(tmp_path / "both.mkv"), "w") as target:
        stream = None
        for part in ("a.mkv", "b.mkv"):
            with av.open(str(tmp_path / part)) as source:
                stream = stream or target.add_stream_from_template(source.streams.video[0])
                for packet in (p for p in source.demux(video=0) if p.size):
                    packet.pts = packet.dts = packet.pts + (500 if part == "b.mkv" else 0)
                    packet.stream = stream
                    target.mux(packet)
    source, got = decoded(tmp_path / "both.mkv")
    assert [f.number for f in got] == list(range(1, 13))
    assert [w[0] for w in source.warnings] == [
        "From frame 13 on the clip is 48x64 pixels instead of 64x48: the shot ends before it."
    ]
    with pytest.raises(JobError, match="changes its size before the range begins: from frame 13 on it is 48x64"):
        decoded(tmp_path / "both.mkv", 14, 24)


@pytest.mark.parametrize("name", ["notes.txt", "noise.mp4", "empty.mov", "list.m3u8"])
def test_what_is_no_video_is_refused_in_one_sentence(tmp_path, name):
    content = {
        "notes.txt": b"hello world\n" * 50,
        "noise.mp4": bytes(range(256)) * 20,
        "empty.mov": b"",
        "list.m3u8": b"#EXTM3U\n#EXTINF:1,\nhttp://127.0.0.1:9/a.ts\n#EXT-X-ENDLIST\n",
    }
    (tmp_path / name).write_bytes(content[name])
    with pytest.raises(JobError) as error:
        open_source(str(tmp_path / name))
    assert error.value.message == f"{name} is not a video that can be read."
    assert error.value.exit_code == ExitCode.FOOTAGE
    assert error.value.hint


@pytest.mark.parametrize("name", ["clip.mp4", "shot.0001.exr", "clip"])
def test_a_pipe_is_refused_without_waiting_for_it(tmp_path, name):
    os.mkfifo(tmp_path / name)
    with pytest.raises(JobError, match="is neither a file nor a folder") as error:
        open_source(str(tmp_path / name))
    assert error.value.exit_code == ExitCode.FOOTAGE


def test_a_name_that_no_system_takes_is_refused_in_a_sentence(tmp_path):
    with pytest.raises(JobError, match="cannot be opened") as error:
        open_source(str(tmp_path / ("a" * 300 + ".mp4")))
    assert error.value.exit_code == ExitCode.FOOTAGE


def test_damaged_headers_get_a_sentence(tmp_path, pan, write_video):
    write_video(tmp_path / "a.mp4", pan(12))
    content = (tmp_path / "a.mp4").read_bytes()
    (tmp_path / "codec.mp4").write_bytes(content.replace(b"avc1", b"zzzz"))
    with pytest.raises(JobError, match=r"codec\.mp4 is encoded in a way that cannot be decoded here") as error:
        open_source(str(tmp_path / "codec.mp4"))
    assert error.value.exit_code == ExitCode.FOOTAGE


def test_pixels_that_no_lens_makes_are_taken_as_square(tmp_path, pan, write_video):
    write_video(tmp_path / "a.mp4", pan(8), aspect=Fraction(5, 1))
    source, got = decoded(tmp_path / "a.mp4")
    assert got[0].pixels.shape == (48, 64, 3)
    assert source.warnings[0][0] == "The footage claims pixels 5 times as wide as high: read as square."


def test_audio_only_file_is_refused(tmp_path):
    with av.open(str(tmp_path / "a.wav"), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), "s16", "mono")
        frame.sample_rate = 8000
        container.mux(stream.encode(frame))
    with pytest.raises(JobError, match="not a video"):
        open_source(str(tmp_path / "a.wav"))


@pytest.mark.parametrize("how", ["index missing", "copy broken off", "never closed", "zeros behind"])
def test_unfinished_recording_is_reported(tmp_path, pan, write_video, how):
    """MP4 and QuickTime store their index at the end."""
    write_video(tmp_path / "a.mp4", pan(8))
    data = (tmp_path / "a.mp4").read_bytes()
    at = data.index(b"moov") - 4
    mdat = data.index(b"mdat") - 4
    cases = {
        "index missing": data[:at],
        "copy broken off": data[: at - 100],
        "never closed": data[:mdat] + bytes(4) + data[mdat + 4 : at - 7],
        "zeros behind": data[:at] + bytes(4096),
    }[how]
    (tmp_path / "a.mov").write_bytes(cases)
    with pytest.raises(JobError, match=r"a.mov was not finished: its index \(the moov atom\) is missing") as caught:
        open_source(str(tmp_path / "a.mov"))
    assert caught.value.exit_code == ExitCode.FOOTAGE


@pytest.fixture
def two_streams(tmp_path, pan):
    """QuickTime file with two video streams of equal size, and the first frame of each."""
    videos = [pan(8, seed=1), pan(8, seed=2)]
    with av.open(str(tmp_path / "a.mov"), "w") as container:
        streams = [container.add_stream("libx264", rate=24) for _ in videos]
        for stream in streams:
            stream.width, stream.height, stream.pix_fmt, stream.options = 64, 48, "yuv444p", {"crf": "0"}
        for frames in zip(*videos, strict=True):
            for stream, pixels in zip(streams, frames, strict=True):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, "rgb24")))
        for stream in streams:
            container.mux(stream.encode())
    return tmp_path / "a.mov", [video[0] for video in videos]


def test_chosen_video_stream_is_reported_and_selectable(two_streams):
    path, firsts = two_streams
    source, got = decoded(path)
    assert source.warnings == [
        (
            "The clip has 2 video streams: number 1 is used, 64x48.",
            "Choose another by its number (--layer): 1 (64x48), 2 (64x48).",
        )
    ]
    assert close(got[0].pixels, firsts[0], 2) and not source.info.mismatch
    second_stream = open_source(str(path), layer="2")
    assert close(next(second_stream.frames(None, None)).pixels, firsts[1], 2) and not second_stream.warnings
    reader = second_stream.plates(Known({n: (n - 1) / 24 for n in range(1, 9)}, 0.0, lambda *_: True))
    assert close(reader.plate(1), firsts[1], 2) and "several video streams" in second_stream.info.mismatch
    reader.close()
    with pytest.raises(JobError, match="a.mov has no video stream '3'"):
        open_source(str(path), layer="3")


def test_frames_in_words():
    assert frame_words([7]) == "frame 7"
    assert frame_words([3, 4, 5, 9, 11, 12]) == "frames 3-5, 9, 11-12"
    assert frame_words(range(1, 40, 2)).endswith(", 13, 15 and 12 more spans")
