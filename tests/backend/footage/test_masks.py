"""Masks in all forms that artists deliver: one picture, a sequence, a video, an alpha; and refusal of unsuitable
ones."""

import struct
import zlib

import av
import numpy as np
import OpenImageIO as oiio
import pytest

from torch_backend.contract import ExitCode, JobError
from torch_backend.footage import FootageConfig, import_footage
from torch_backend.footage.images import write_png
from torch_backend.footage.masks import read_masks
from torch_backend.footage.video import VideoSource
from torch_backend.shot import Shot

FRAMES = range(101, 111)
COVERED = np.zeros((48, 64), bool)
COVERED[10:20, 30:50] = True


@pytest.fixture(scope="module")
def shot(tmp_path_factory, pan, recorder):
    """Shot of ten frames of 64 x 48, numbered 101 to 110; tests must not change it."""
    folder = tmp_path_factory.mktemp("shot")
    (folder / "clip").mkdir()
    for number, pixels in zip(FRAMES, pan(10), strict=True):
        write_png(folder / "clip" / f"f.{number}.png", pixels)
    new_shot = Shot.create(folder / "a.splannequin")
    import_footage(new_shot, str(folder / "clip"), FootageConfig(), recorder())
    return new_shot


def white(covered):
    return np.repeat(np.where(covered, 255, 0).astype(np.uint8)[..., None], 3, axis=2)


def write_masks(folder, numbers, covered=COVERED):
    """Write a mask per number, each shifted by one pixel to the right."""
    folder.mkdir()
    for n, number in enumerate(numbers):
        write_png(folder / f"m.{number:04d}.png", white(np.roll(covered, n, axis=1)))
    return str(folder)


def write_rgba(file, rgb, alpha):
    """Write a PNG with straight alpha from rgb [h, w, 3] and alpha [h, w] uint8."""
    buffer = oiio.ImageBuf(np.ascontiguousarray(np.dstack([rgb, alpha])))
    buffer.specmod().attribute("oiio:UnassociatedAlpha", 1)
    buffer.specmod().alpha_channel = 3
    assert buffer.write(str(file))


def masks_of(shot, recorder, **sources):
    return read_masks(shot, {kind: str(source) for kind, source in sources.items()}, recorder())


def test_one_picture_masks_all_frames(shot, recorder, tmp_path):
    write_png(tmp_path / "logo.png", white(COVERED))
    mask = masks_of(shot, recorder, ignore=tmp_path / "logo.png")["ignore"]
    assert list(mask.packed) == list(FRAMES)
    assert all((mask.of(frame) == COVERED).all() for frame in FRAMES)
    assert mask.share == pytest.approx(COVERED.mean())


def test_a_sequence_goes_by_number_and_may_have_more_frames(shot, recorder, tmp_path):
    report = recorder()
    mask = read_masks(shot, {"people": write_masks(tmp_path / "m", range(99, 120))}, report)["people"]
    assert all((mask.of(frame) == np.roll(COVERED, frame - 99, axis=1)).all() for frame in FRAMES)
    assert not report.warnings


def test_unnumbered_masks_are_matched_in_order_and_reported(shot, recorder, tmp_path):
    report = recorder()
    mask = read_masks(shot, {"people": write_masks(tmp_path / "m", range(10))}, report)["people"]
    assert (mask.of(110) == np.roll(COVERED, 9, axis=1)).all()
    assert "is numbered 0 to 9, the frames 101 to 110: picture 0 is used for frame 101" in report.warnings[0]


def test_a_larger_mask_is_brought_to_the_frames_size(shot, recorder, tmp_path):
    write_png(tmp_path / "logo.png", np.kron(white(COVERED), np.ones((4, 4, 1), np.uint8)))
    assert (masks_of(shot, recorder, ignore=tmp_path / "logo.png")["ignore"].of(105) == COVERED).all()


def test_mask_video_is_matched_by_frame_count(shot, recorder, tmp_path, write_video):
    write_video(tmp_path / "m.mp4", [white(np.roll(COVERED, n, axis=1)) for n in range(10)])
    mask = masks_of(shot, recorder, people=tmp_path / "m.mp4")["people"]
    assert all((mask.of(frame) == np.roll(COVERED, frame - 101, axis=1)).all() for frame in FRAMES)


def test_the_footage_s_alpha_ignores_what_is_transparent_and_lets_move_what_is_opaque(tmp_path, pan, recorder):
    (tmp_path / "clip").mkdir()
    for number, pixels in zip(FRAMES, pan(10), strict=True):
        write_rgba(tmp_path / "clip" / f"f.{number}.png", pixels, np.where(COVERED, 255, 0).astype(np.uint8))
    shot = Shot.create(tmp_path / "a.splannequin")
    import_footage(shot, str(tmp_path / "clip"), FootageConfig(), recorder())
    assert (masks_of(shot, recorder, ignore="alpha")["ignore"].of(101) == ~COVERED).all()
    assert (masks_of(shot, recorder, people="alpha")["people"].of(101) == COVERED).all()


ALPHA_CODECS = {
    "prores_ks.mov": ("yuva444p10le", {"profile": "4444", "alpha_bits": "16"}),
    "png.mov": ("rgba", {}),
    "qtrle.mov": ("argb", {}),
    "libvpx-vp9.webm": ("yuva420p", {"lossless": "1"}),
}


def write_alpha_video(path, codec, pixels, rotation=0):
    """Write a video whose alpha covers `COVERED`, shifted by one pixel to the right in each frame."""
    kind, options = ALPHA_CODECS[codec]
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec.partition(".")[0], rate=24, options=options)
        stream.height, stream.width = pixels[0].shape[:2]
        stream.pix_fmt = kind
        if rotation:
            stream.set_display_rotation(rotation)
        for n, rgb in enumerate(pixels):
            alpha = np.where(np.roll(COVERED, n, axis=1), 255, 0).astype(np.uint8)
            frame = av.VideoFrame.from_ndarray(np.dstack([rgb, alpha]), "rgba")
            container.mux(stream.encode(frame.reformat(format=kind)))
        container.mux(stream.encode())


@pytest.mark.parametrize("codec", ALPHA_CODECS)
def test_the_alpha_of_a_video_masks_as_that_of_pictures_does(tmp_path, pan, recorder, codec):
    clip = tmp_path / f"a.{codec.partition('.')[2]}"
    write_alpha_video(clip, codec, pan(12))
    shot, report = Shot.create(tmp_path / "a.splannequin"), recorder()
    import_footage(shot, str(clip), FootageConfig(first=2, last=11), report)
    assert "The clip has alpha: its colour is used, its alpha is ignored." in report.warnings
    ignored = masks_of(shot, recorder, ignore="alpha")["ignore"]
    assert list(ignored.packed) == list(range(2, 12))
    for frame in (2, 7, 11):
        assert (ignored.of(frame) == ~np.roll(COVERED, frame - 1, axis=1)).all()
    assert (masks_of(shot, recorder, people="alpha")["people"].of(11) == np.roll(COVERED, 10, axis=1)).all()


def test_a_mask_video_that_lost_the_alpha_of_a_frame_is_refused(shot, recorder, tmp_path, pan, monkeypatch):
    """A frame without alpha would be read by its brightness."""
    write_alpha_video(tmp_path / "m.mov", "png.mov", pan(10))
    alphas = VideoSource.alphas
    monkeypatch.setattr(VideoSource, "alphas", lambda self, last: (a for a in alphas(self, last) if a[0] != 4))
    with pytest.raises(JobError, match="frame 4 of m.mov"):
        masks_of(shot, recorder, people=tmp_path / "m.mov")


def test_the_alpha_of_a_video_is_turned_as_its_picture_is(tmp_path, pan, recorder):
    clip = tmp_path / "a.mov"
    write_alpha_video(clip, "png.mov", pan(10), rotation=90)
    shot = Shot.create(tmp_path / "a.splannequin")
    import_footage(shot, str(clip), FootageConfig(), recorder())
    found = masks_of(shot, recorder, people="alpha")["people"].of(1)
    assert found.shape == (64, 48) and (found == np.rot90(COVERED)).all()


def test_mask_video_without_alpha_is_reported(tmp_path, pan, recorder, write_video):
    write_video(tmp_path / "a.mp4", pan(10))
    shot = Shot.create(tmp_path / "a.splannequin")
    import_footage(shot, str(tmp_path / "a.mp4"), FootageConfig(), recorder())
    with pytest.raises(JobError, match=r"a\.mp4 has no alpha channel to use as a mask\."):
        masks_of(shot, recorder, ignore="alpha")


def test_a_mask_is_known_by_what_it_covers_and_not_by_its_file(shot, recorder, tmp_path):
    first = masks_of(shot, recorder, people=write_masks(tmp_path / "m", FRAMES))["people"]
    again = masks_of(shot, recorder, people=write_masks(tmp_path / "n", FRAMES))["people"]
    second = masks_of(shot, recorder, people=write_masks(tmp_path / "o", FRAMES, np.roll(COVERED, 1, 0)))["people"]
    assert first.key == again.key != second.key


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda d: str(d / "none.png"), "none.png does not exist."),
        (lambda d: write_masks(d / "m", range(101, 108)), "has no picture for frames 108-110, of 10 frames."),
        (
            lambda d: write_masks(d / "m", FRAMES, np.ones((48, 96), bool)),
            "is 96x48, the footage 64x48: their aspect ratios differ.",
        ),
        (lambda d: write_masks(d / "m", FRAMES, np.zeros((48, 64), bool)), "covers nothing in any frame."),
        (
            lambda d: write_masks(d / "m", FRAMES, np.ones((48, 64), bool)),
            "covers 100 % of the picture: too little is left to solve the camera.",
        ),
        (lambda _: "alpha", "f.101.png has no alpha channel to use as a mask."),
    ],
)
def test_what_does_not_fit_is_refused_in_words(shot, recorder, tmp_path, write, message):
    with pytest.raises(JobError) as error:
        masks_of(shot, recorder, people=write(tmp_path))
    assert error.value.message.endswith(message) and error.value.hint
    assert error.value.exit_code == ExitCode.FOOTAGE


def test_a_damaged_mask_is_named(shot, recorder, tmp_path):
    folder = write_masks(tmp_path / "m", FRAMES)
    (tmp_path / "m" / "m.0104.png").write_bytes(b"\x89PNG")
    with pytest.raises(JobError, match=r"m\.0104\.png cannot be read"):
        masks_of(shot, recorder, people=folder)


def drawn(rgb, alpha):
    """Colour and alpha, broadcast to [48, 64, 3] and [48, 64] uint8."""
    rgb, alpha = np.asarray(rgb, np.uint8), np.asarray(alpha, np.uint8)
    return np.broadcast_to(rgb, (48, 64, 3)), np.broadcast_to(alpha, (48, 64))


SKIN = np.random.default_rng(0).integers(20, 140, (48, 64, 3))
HALF_BLACK = np.where(np.arange(64)[None, :, None] < 40, 0, 255)


@pytest.mark.parametrize(
    ("rgb", "alpha", "expected"),
    [
        (SKIN, np.where(COVERED, 255, 0), COVERED),  # a cut-out of people
        (SKIN // 8, np.where(COVERED, 255, 0), COVERED),  # a dark cut-out
        (np.where(COVERED[..., None], SKIN, 255), np.where(COVERED, 255, 0), COVERED),
        (255, np.where(COVERED, 255, 0), COVERED),
        (0, np.where(COVERED, 255, 0), COVERED),
        # a black and white matte with an alpha
        (HALF_BLACK, np.where(COVERED, 255, 0), COVERED & (HALF_BLACK[..., 0] > 0)),
        (np.where(COVERED[..., None], 255, 0), 255, COVERED),
        (np.where(COVERED[..., None], 255, 0), 0, COVERED),  # an alpha that was never filled
        (np.where(COVERED[..., None], 255, 0), 90, COVERED),
    ],
)
@pytest.mark.parametrize("as_sequence", [False, True])
def test_an_alpha_that_varies_is_the_mask(shot, recorder, tmp_path, rgb, alpha, expected, as_sequence):
    (tmp_path / "m").mkdir()
    for number in FRAMES if as_sequence else [0]:
        write_rgba(tmp_path / "m" / f"m.{number:04d}.png", *drawn(rgb, alpha))
    source = tmp_path / "m" if as_sequence else tmp_path / "m" / "m.0000.png"
    assert (masks_of(shot, recorder, people=source)["people"].of(105) == expected).all()


def test_empty_mask_frames_do_not_change_the_reading_of_others(shot, recorder, tmp_path):
    (tmp_path / "m").mkdir()
    for number in FRAMES:
        alpha = np.where(COVERED, 255, 0) if number > 104 else 0
        write_rgba(tmp_path / "m" / f"m.{number:04d}.png", *drawn(SKIN, alpha))
    mask = masks_of(shot, recorder, people=tmp_path / "m")["people"]
    assert not mask.of(103).any() and (mask.of(105) == COVERED).all()


def test_cut_outs_in_exr_and_in_a_video_are_read_by_their_alpha(shot, recorder, tmp_path):
    light = np.dstack([SKIN / 255.0, np.ones((48, 64))]) * COVERED[..., None]
    assert oiio.ImageBuf(light.astype(np.float32)).write(str(tmp_path / "cut.exr"))
    assert (masks_of(shot, recorder, people=tmp_path / "cut.exr")["people"].of(105) == COVERED).all()
    write_alpha_video(tmp_path / "cut.mov", "png.mov", [SKIN.astype(np.uint8)] * 10)
    mask = masks_of(shot, recorder, people=tmp_path / "cut.mov")["people"]
    assert all((mask.of(frame) == np.roll(COVERED, frame - 101, axis=1)).all() for frame in FRAMES)


def announced(width, height):
    """A PNG of a few bytes whose header announces this size."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)
    body = chunk(b"IDAT", zlib.compress(bytes(1 << 16)))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + body + chunk(b"IEND", b"")


def test_a_mask_of_far_more_pixels_than_the_footage_is_refused_before_they_are_read(shot, recorder, tmp_path):
    (tmp_path / "m.png").write_bytes(announced(8000, 6000))
    with pytest.raises(JobError, match="8000x6000, the footage 64x48: it has far more pixels"):
        masks_of(shot, recorder, people=tmp_path / "m.png")


@pytest.mark.parametrize("size", [(16000, 12000), (100_000, 75_000)])
def test_oversized_picture_is_refused_before_decoding(shot, recorder, tmp_path, size):
    (tmp_path / "m.png").write_bytes(announced(*size))
    words = f"{size[0]} x {size[1]} pixels"
    with pytest.raises(JobError, match=words) as error:
        masks_of(shot, recorder, people=tmp_path / "m.png")
    assert error.value.hint and error.value.exit_code == ExitCode.FOOTAGE
    (tmp_path / "footage").mkdir()
    for n in range(9):
        (tmp_path / "footage" / f"f.{n}.png").write_bytes(announced(*size))
    with pytest.raises(JobError, match=words) as error:
        import_footage(Shot.create(tmp_path / "b.splannequin"), str(tmp_path / "footage"), FootageConfig(), recorder())
    assert error.value.hint and error.value.exit_code == ExitCode.FOOTAGE
