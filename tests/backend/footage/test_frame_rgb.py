"""Decoding matrix: clips of many codecs, depths, ranges, matrices, rates, rotations, sizes and aspects.

Each clip shows 48 patches of 16 x 16 pixels with known codes. Their centres are compared with the definition of the
YCbCr matrix in float64. Reference codes are the written ones or, for lossy codecs, the decoder's unscaled output.
"""

import contextlib
import os
from dataclasses import dataclass, field, replace
from fractions import Fraction

import av
import numpy as np
import pytest

from torch_backend import contract
from torch_backend.footage.frame_rgb import MATRIX_OVERRIDES, RANGE_OVERRIDES
from torch_backend.footage.opening import open_source
from torch_backend.footage.plate_encoding import display
from torch_backend.footage.sources import Overrides

SHARES = {
    1: (0.2126, 0.0722),
    4: (0.30, 0.11),
    5: (0.299, 0.114),
    6: (0.299, 0.114),
    7: (0.212, 0.087),
    9: (0.2627, 0.0593),
}
"""Weights of red and blue in luma, by matrix number of ITU-T H.273."""
PATCH, COLUMNS, ROWS = 16, 8, 6
ALPHA = 3


@dataclass
class Clip:
    """One generated input clip."""

    codec: str
    kind: str
    """FFmpeg's name of the pixel format."""
    matrix: int = 1
    """Matrix number stored in the file; 2: unspecified."""
    codes: int = 1
    """Stored range; 1: video range, 2: full range, 0: unspecified."""
    suffix: str = "mkv"
    rate: str = "24"
    size: tuple[int, int] = (PATCH * COLUMNS, PATCH * ROWS)
    aspect: str = "1"
    turned: int = 0
    transfer: int = 1
    expected_matrix: int = 0
    """Expected matrix if the file does not specify it."""
    loses: bool = False
    decoded: str = ""
    """Pixel format of the decoder's output, if it differs."""
    options: dict[str, str] = field(default_factory=dict)

    @property
    def name(self):
        """Name of the test."""
        words = [self.codec, self.kind, f"m{self.matrix}", f"r{self.codes}", self.suffix, self.rate.replace("/", ":")]
        words += [f"{self.size[0]}x{self.size[1]}"] * (self.size != (128, 96)) + [f"a{self.aspect}"] * (
            self.aspect != "1"
        )
        return "-".join(
            words + [f"turned{self.turned}"] * bool(self.turned) + [f"t{self.transfer}"] * (self.transfer != 1)
        )


X264 = {"options": {"crf": "0", "qp": "0", "preset": "ultrafast"}}
X264_DEEP = {"loses": True, **X264}
X265 = {"options": {"preset": "ultrafast", "x265-params": "lossless=1:log-level=none"}}
VP9 = {"options": {"lossless": "1", "deadline": "realtime", "cpu-used": "8"}}
CLIPS = [
    Clip("libx264", "yuv420p", suffix="mp4", rate="24000/1001", **X264),
    Clip("libx264", "yuv420p", 6, suffix="mov", rate="25", **X264),
    Clip("libx264", "yuv420p", 5, rate="30000/1001", **X264),
    Clip("libx264", "yuv420p", 2, 0, suffix="mp4", expected_matrix=5, **X264),
    Clip("libx264", "yuv420p", 2, 0, size=(1280, 96), expected_matrix=1, **X264),
    Clip("libx264", "yuvj420p", 1, 2, suffix="mp4", **X264),
    Clip("libx264", "yuv422p", suffix="mov", rate="50", **X264),
    Clip("libx264", "yuv444p", 9, rate="60000/1001", **X264),
    Clip("libx264", "yuvj444p", 6, 2, suffix="mp4", size=(127, 95), **X264),
    Clip("libx264", "yuv420p", 9, suffix="mp4", rate="120", **X264),
    Clip("libx264", "yuv420p", 7, **X264),
    Clip("libx264", "yuv420p", 4, **X264),
    Clip("libx264", "yuv420p", suffix="mp4", turned=90, **X264),
    Clip("libx264", "yuv420p", 6, suffix="mov", turned=180, **X264),
    Clip("libx264", "yuv420p10le", suffix="mp4", turned=270, **X264_DEEP),
    Clip("libx264", "yuv420p", suffix="mp4", aspect="2/1", **X264),
    Clip("libx264", "yuv420p", suffix="mov", aspect="10/11", rate="30000/1001", **X264),
    Clip("libx264", "yuv420p10le", suffix="mp4", rate="24000/1001", aspect="4/3", **X264_DEEP),
    Clip("libx264", "yuv422p10le", **X264_DEEP),
    Clip("libx264", "yuv444p10le", 1, 2, **X264_DEEP),
    Clip("libx264", "gray", 1, 1, **X264),
    Clip("libx265", "yuv420p", suffix="mp4", **X265),
    Clip("libx265", "yuv420p10le", suffix="mp4", rate="60000/1001", **X265),
    Clip("libx265", "yuv422p10le", 9, 2, **X265),
    Clip("libx265", "yuv420p12le", suffix="mov", **X265),
    Clip("libx265", "yuv444p12le", 1, 2, **X265),
    Clip("libvpx-vp9", "yuv420p", suffix="webm", rate="30", **VP9),
    Clip("libvpx-vp9", "yuv444p", 6, suffix="webm", **VP9),
    Clip("libsvtav1", "yuv420p", suffix="mp4", loses=True, options={"crf": "1", "preset": "12"}),
    Clip("libsvtav1", "yuv420p10le", suffix="mkv", loses=True, options={"crf": "1", "preset": "12"}),
    Clip("ffv1", "yuv420p", size=(127, 95)),
    Clip("ffv1", "yuv420p10le", size=(127, 95)),
    Clip("ffv1", "yuv411p", 6),
    Clip("ffv1", "yuv440p"),
    Clip("ffv1", "yuv420p9le", 1, 2),
    Clip("ffv1", "yuv444p12le", rate="12"),
    Clip("ffv1", "yuv420p16le"),
    Clip("ffv1", "yuv422p16le", 9, 2),
    Clip("ffv1", "gray", 1, 2),
    Clip("ffv1", "gray10le", 1, 1),
    Clip("ffv1", "gbrp10le", 0, 2),
    Clip("ffv1", "gbrp12le", 0, 2),
    Clip("ffv1", "yuva444p10le"),
    Clip("ffv1", "yuv420p10le", 1, 2, transfer=8),
    Clip("ffv1", "yuv444p10le", 1, 2, transfer=8),
    Clip("ffv1", "yuv422p12le", 9, 1, transfer=8),
    Clip("huffyuv", "yuv422p", 2, 0, suffix="avi", expected_matrix=5),
    Clip("ffvhuff", "yuv420p", 2, 0, suffix="avi", expected_matrix=5),
    Clip("utvideo", "gbrp", 0, 2, suffix="avi"),
    Clip("magicyuv", "yuv444p", 2, 0, suffix="avi", expected_matrix=5),
    Clip("v210", "yuv422p10le", suffix="mov"),
    Clip("rawvideo", "yuv422p", suffix="mkv"),
    Clip("prores_ks", "yuv422p10le", suffix="mov", loses=True, options={"profile": "3"}),
    Clip(
        "prores_ks",
        "yuv444p10le",
        suffix="mov",
        rate="24000/1001",
        loses=True,
        decoded="yuv444p12le",
        options={"profile": "4"},
    ),
    Clip("prores_ks", "yuva444p10le", 9, suffix="mov", loses=True, decoded="yuv444p12le", options={"profile": "4"}),
    Clip("dnxhd", "yuv422p", suffix="mov", size=(256, 128), loses=True, options={"profile": "dnxhr_hq"}),
    Clip("dnxhd", "yuv422p10le", suffix="mov", size=(256, 128), loses=True, options={"profile": "dnxhr_hqx"}),
    Clip("mjpeg", "yuvj420p", 5, 2, suffix="avi", loses=True, options={"qmin": "1", "qmax": "1"}),
    Clip("mjpeg", "yuvj422p", 5, 2, suffix="mov", loses=True, aspect="2/1", options={"qmin": "1", "qmax": "1"}),
    Clip("mpeg2video", "yuv420p", 6, suffix="mpg", rate="25", loses=True, options={"qmin": "1", "qmax": "1"}),
    Clip("mpeg4", "yuv420p", suffix="mp4", rate="30", loses=True, options={"qmin": "1", "qmax": "1"}),
    Clip("cfhd", "gbrp12le", 0, 2, suffix="mov", loses=True),
    Clip("png", "rgb24", 0, 2, suffix="mov"),
    Clip("qtrle", "rgb24", 0, 2, suffix="mov", rate="12"),
]


def depth(kind):
    """Bit depth of an FFmpeg pixel format."""
    digits = "".join(c for c in kind.removesuffix("le")[-2:] if c.isdigit())
    return int(digits) if kind.endswith("le") else 8


def patch_codes(clip):
    """[3, rows, columns] integer Y, Cb, Cr (or G, B, R) of in-gamut colours; the first patch is white, the second
    black."""
    rng = np.random.default_rng(7)
    rows, columns = (-(-n // PATCH) for n in clip.size[::-1])
    rgb = rng.uniform(0.05, 0.95, (rows, columns, 3))
    if clip.kind.startswith("gray"):
        rgb[:] = rgb[..., :1]
    rgb[0, 0], rgb[0, 1] = 1.0, 0.0
    bits, full = depth(clip.kind), clip.codes == 2
    largest, step = (1 << bits) - 1, 1 << (bits - 8)
    if clip.kind.startswith(("gbr", "rgb")):
        return np.rint(np.moveaxis(rgb[..., [1, 2, 0]], -1, 0) * largest)
    kr, kb = SHARES[clip.expected_matrix or clip.matrix]
    y = rgb @ [kr, 1 - kr - kb, kb]
    cb, cr = (rgb[..., 2] - y) / (2 * (1 - kb)), (rgb[..., 0] - y) / (2 * (1 - kr))
    if full:
        return np.rint([y * largest, *(c * largest + (largest + 1) // 2 for c in (cb, cr))])
    return np.rint([(16 + 219 * y) * step, *((128 + 224 * c) * step for c in (cb, cr))])


def reference(codes, clip):
    """R'G'B' [..., 3] of codes [3, ...] by the definition, in float64."""
    bits = depth(clip.decoded or clip.kind)
    largest, step = (1 << bits) - 1, 1 << (bits - 8)
    if clip.kind.startswith(("gbr", "rgb")):
        return np.stack([codes[2], codes[0], codes[1]], -1) / largest
    kr, kb = SHARES[clip.expected_matrix or clip.matrix]
    if clip.codes == 2:
        y, cb, cr = codes[0] / largest, *((c - (largest + 1) // 2) / largest for c in codes[1:])
    else:
        y, cb, cr = (codes[0] / step - 16) / 219, *((c / step - 128) / 224 for c in codes[1:])
    red, blue = y + 2 * (1 - kr) * cr, y + 2 * (1 - kb) * cb
    rgb = np.stack([red, (y - kr * red - kb * blue) / (1 - kr - kb), blue], -1)
    if clip.transfer == 8:
        rgb = np.where(rgb <= 0.0031308, 12.92 * rgb, 1.055 * np.maximum(rgb, 1e-9) ** (1 / 2.4) - 0.055)
    return np.clip(rgb, 0, 1)


def shares(kind):
    """Chroma subsampling: luma rows and columns per chroma sample, as (down, across)."""
    return {"420": (2, 2), "422": (1, 2), "440": (2, 1), "411": (1, 4)}.get(kind.lstrip("yuvaj")[:3], (1, 1))


def planes_of_patches(codes, clip):
    """Planes that the file should contain, each [h, w]."""
    width, height = clip.size
    kind = np.uint8 if depth(clip.kind) == 8 else np.uint16
    down, across = shares(clip.kind)
    planes = []
    if clip.kind == "rgb24":
        rgb = np.moveaxis(codes[[2, 0, 1]], 0, -1).astype(np.uint8)
        return [np.repeat(np.repeat(rgb, PATCH, 0), PATCH, 1).reshape(height, 3 * width)]
    for i, plane in enumerate(codes if not clip.kind.startswith("gray") else codes[:1]):
        a, b = (down, across) if i else (1, 1)
        whole = np.repeat(np.repeat(plane, PATCH // a, 0), PATCH // b, 1).astype(kind)
        planes.append(whole[: -(-height // a), : -(-width // b)])
    if "yuva" in clip.kind:
        planes.append(np.full((height, width), (1 << depth(clip.kind)) - 1, kind))
    return planes


@contextlib.contextmanager
def usual_scheduling():
    """Restore the scheduling of this thread: SVT-AV1, run as root, makes its caller a real-time thread permanently."""
    yield
    if hasattr(os, "sched_setscheduler") and os.sched_getscheduler(0) != os.SCHED_OTHER:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def written(path, clip, frame_of_planes, codes):
    """Write a clip of three frames, tagged in container and codec as a camera would."""
    with usual_scheduling(), av.open(str(path), "w") as container:
        stream = container.add_stream(clip.codec, rate=Fraction(clip.rate), options=clip.options)
        (stream.width, stream.height), stream.pix_fmt = clip.size, clip.kind
        context = stream.codec_context
        context.color_range, context.color_primaries, context.color_trc = clip.codes, 1, clip.transfer
        if clip.matrix != 2:
            context.colorspace = clip.matrix
        if clip.codec in ("prores_ks", "dnxhd", "mpeg2video", "mpeg4"):
            context.bit_rate = 200_000_000
        if clip.aspect != "1":
            context.sample_aspect_ratio = Fraction(clip.aspect)
        if clip.turned:
            stream.set_display_rotation(clip.turned if clip.turned <= 180 else clip.turned - 360)
        for _ in range(3):
            frame = frame_of_planes(planes_of_patches(codes, clip), clip.kind, clip.size)
            frame.color_range = clip.codes
            if clip.matrix != 2:
                frame.colorspace = clip.matrix
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def stored(path, clip):
    """Codes [3, rows, columns] at the centres of the patches, as decoded."""
    with av.open(str(path)) as container:
        frame = next(container.decode(video=0))
    kind = np.uint8 if depth(frame.format.name) == 8 else np.uint16
    down, across = shares(frame.format.name)
    found = []
    for i, plane in enumerate(frame.planes[:3]):
        rows = np.frombuffer(memoryview(plane), kind).reshape(plane.height, -1)[:, : plane.width].astype(np.float64)
        a, b = (down, across) if i else (1, 1)
        found.append(rows[PATCH // 2 // a :: PATCH // a, PATCH // 2 // b :: PATCH // b])
    if clip.kind.startswith("gray"):
        found = found[:1]
        found += [np.full(found[0].shape, 1 << (depth(clip.kind) - 1))] * 2
    return np.stack(found)


@pytest.mark.parametrize("clip", CLIPS, ids=lambda clip: clip.name)
def test_decoded_clips_are_what_their_codes_say(tmp_path, frame_of_planes, clip):
    path, codes = tmp_path / f"clip.{clip.suffix}", patch_codes(clip)
    written(path, clip, frame_of_planes, codes)
    stored_codes = stored(path, clip) if clip.loses or clip.kind.startswith("gray") else codes
    source = open_source(str(path))
    frames = list(source.frames(None, None))
    check_facts(source, frames, clip)
    pixels = np.clip(display(frames[0].pixels), 0.0, 1.0)  # also if the pixels are linear light
    pixels = np.rot90(pixels, -clip.turned // 90)
    across = max(1.0, float(Fraction(clip.aspect)))
    down = max(1.0, 1 / float(Fraction(clip.aspect)))
    rows = (np.arange(codes.shape[1]) * PATCH + PATCH // 2) * down
    columns = (np.arange(codes.shape[2]) * PATCH + PATCH // 2) * across
    got, expected = pixels[np.ix_(rows.astype(int), columns.astype(int))], reference(stored_codes, clip)
    step = 1 / 255 if depth(clip.kind) == 8 else 1 / 1023
    inside = ((expected > 0) & (expected < 1)).all(-1)
    assert np.abs(got - expected).max() < step
    assert np.abs((got - expected)[inside].mean(0)).max() < 0.2 * step
    if (reference(stored_codes, clip)[0, 0] >= 1).all():
        # With non-square pixels resampled, 16-bit white is 65531: FFmpeg's Lanczos weights do not sum to exactly 1.
        assert (got[0, 0] >= (1.0 if clip.aspect == "1" or step == 1 / 255 else 0.9999)).all(), "white"
    intended = reference(codes, replace(clip, decoded=""))
    assert not clip.loses or np.abs(expected - intended).max() < 12 / 255, "the clip shows its patches"


def check_facts(source, frames, clip):
    """Check sizes, numbers, times and the metadata of the source."""
    aspect, (width, height) = Fraction(clip.aspect), clip.size
    size = (round(width * aspect), height) if aspect >= 1 else (width, round(height / aspect))
    size = size[::-1] if clip.turned % 180 else size
    assert (source.info.width, source.info.height) == size
    assert [frame.pixels.shape for frame in frames] == [(size[1], size[0], 3)] * 3
    assert [frame.number for frame in frames] == [1, 2, 3]
    assert source.info.fps == pytest.approx(float(Fraction(clip.rate)), rel=1e-4)
    start = frames[0].seconds
    assert np.abs([frame.seconds - start - i / Fraction(clip.rate) for i, frame in enumerate(frames)]).max() < 1e-3
    reading = source.info.reading
    assert reading["range"] == ("full" if clip.codes == 2 else "video")
    assert reading["bits"] == depth(clip.decoded or clip.kind)
    assert reading["alpha"] == ("yuva" in clip.kind)
    assert reading["pixel_aspect"] == pytest.approx(float(aspect))


def test_a_person_outdoes_the_file(tmp_path, frame_of_planes):
    """The user states full range and BT.709; the file states video range and BT.601. Pixels are twice as wide as
    high."""
    true = Clip("ffv1", "yuv422p10le", 1, 2)
    codes, says = patch_codes(true), Clip("ffv1", "yuv422p10le", 6, 1)
    written(tmp_path / "a.mkv", says, frame_of_planes, codes)
    source = open_source(str(tmp_path / "a.mkv"), overrides=Overrides("bt709", "full", Fraction(2)))
    got = next(iter(source.frames(None, None))).pixels[8::16, 16::32] / 65535
    assert np.abs(got - reference(codes, true)).max() < 1 / 1023
    reading = [source.info.reading[name] for name in ("matrix", "matrix_told", "range", "range_told", "pixel_aspect")]
    assert reading == ["ITU709", True, "full", True, 2.0]
    assert np.abs(got - reference(codes, says)).max() > 8 / 1023, "the case should show whether it is heeded"


def test_what_can_be_said_of_a_video_is_what_is_heeded():
    choices = {field.name: spec.choices for field, spec in contract.options_of(contract.ImportParams)}
    assert set(choices["matrix"]) == {"auto", *MATRIX_OVERRIDES}
    assert set(choices["levels"]) == {"auto", *RANGE_OVERRIDES}
