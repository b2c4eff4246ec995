"""Colours of video streams are converted to Rec.709."""

from fractions import Fraction

import av
import numpy as np
import pytest

from tests.backend.footage.test_video import decoded
from torch_backend.footage.opening import open_source
from torch_backend.footage.sources import Overrides

PATCHES = np.array([[0.2, 0.2, 0.2], [0.5, 0.4, 0.3], [0.35, 0.5, 0.45], [0.3, 0.35, 0.55]])
"""R'G'B' of four vertical stripes."""
D65 = (0.3127, 0.3290)
CORNERS = {
    1: ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06), D65),
    9: ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046), D65),
    12: ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060), D65),
}
"""Chromaticities (R, G, B, white) of primaries, by their number in ITU-T H.273."""


LUMA = {1: (0.2126, 0.0722), 9: (0.2627, 0.0593)}
"""Weights of red and blue in luma, by matrix."""


def ten_bits(rgb, kr, kb):
    """Y, Cb and Cr codes of R'G'B' in a 10-bit file."""
    y = rgb @ [kr, 1 - kr - kb, kb]
    return np.rint([64 + 876 * y, *(512 + 448 * (rgb[:, i] - y) / (1 - k) for i, k in ((2, kb), (0, kr)))])


def from_ten_bits(codes, kr, kb):
    y, cb, cr = (codes[0] - 64) / 876, (codes[1] - 512) / 448, (codes[2] - 512) / 448
    red, blue = y + (1 - kr) * cr, y + (1 - kb) * cb
    return np.stack([red, (y - kr * red - kb * blue) / (1 - kr - kb), blue], axis=-1)


@pytest.fixture
def write_patches(tmp_path):
    """write_patches(transfer, primaries, matrix): a lossless 10-bit YCbCr 4:4:4 clip with these tags."""

    def write(transfer, primaries, matrix, patches=PATCHES):
        kr, kb = LUMA[matrix]
        codes = ten_bits(patches, kr, kb)
        path = tmp_path / f"{transfer}_{primaries}.mkv"
        with av.open(str(path), "w") as container:
            stream = container.add_stream("ffv1", rate=24)
            stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv444p10le"
            context = stream.codec_context
            context.color_trc, context.color_primaries, context.colorspace = transfer, primaries, matrix
            context.color_range = 1
            for _ in range(3):
                frame = av.VideoFrame(64, 48, "yuv444p10le")
                for plane, values in zip(frame.planes, codes):
                    row = np.zeros(plane.line_size // 2, np.uint16)
                    row[:64] = np.repeat(values.astype(np.uint16), 16)
                    plane.update(np.tile(row, 48).tobytes())
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
        source, got = decoded(path)
        pixels = got[0].pixels[24, 8::16]
        return source, srgb(pixels.astype(float)) if pixels.dtype == np.float16 else pixels / 65535.0

    return write


def to_rec709(primaries):
    """Matrix from the primaries to Rec.709 with equal white point, by definition, in float64."""

    def to_xyz(corners):
        columns = np.array([[x / y, 1.0, (1.0 - x - y) / y] for x, y in corners]).T
        return columns[:, :3] * np.linalg.solve(columns[:, :3], columns[:, 3])

    return np.linalg.solve(to_xyz(CORNERS[1]), to_xyz(CORNERS[primaries]))


def srgb(light):
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


def srgb_light(x):
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def pq_light(x):
    m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 4096 * 128, 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
    return 10000 * (np.maximum(x ** (1 / m2) - c1, 0) / (c2 - c3 * x ** (1 / m2))) ** (1 / m1) / 203


def hlg_light(x):
    a = 0.17883277
    scene = np.where(x <= 0.5, x**2 / 3, (np.exp((x - (0.5 - a * np.log(4 * a))) / a) + 1 - 4 * a) / 12)
    return 1000 / 203 * scene * (scene @ [0.2627, 0.6780, 0.0593])[:, None] ** 0.2


def video(x):
    return x**2.4


CASES = {
    "BT.2020 SDR": (14, 9, 9, lambda x, m: (video(x) @ m.T) ** (1 / 2.4)),
    "P3 video": (1, 12, 1, lambda x, m: (video(x) @ m.T) ** (1 / 2.4)),
    "Display P3": (13, 12, 1, lambda x, m: srgb(srgb_light(x) @ m.T)),
    "linear": (8, 1, 1, lambda x, m: srgb(x)),
    "PQ": (16, 9, 9, lambda x, m: srgb(pq_light(x) @ m.T)),
    "HLG": (18, 9, 9, lambda x, m: srgb(hlg_light(x) @ m.T)),
}


@pytest.mark.parametrize("name", CASES)
def test_wide_linear_and_hdr_video_becomes_rec709(write_patches, name):
    transfer, primaries, matrix, reference = CASES[name]
    stored = from_ten_bits(ten_bits(PATCHES, *LUMA[matrix]), *LUMA[matrix])
    expected = reference(stored, to_rec709(primaries))
    if name not in ("linear", "PQ", "HLG"):  # those store light, which is not clipped
        expected = np.clip(expected, 0, 1)
    assert np.abs(expected - PATCHES).max() > 8 / 255, "the case should show whether it is converted"
    source, got = write_patches(transfer, primaries, matrix)
    assert np.abs(got - expected).max() < 1 / 1023
    assert len(source.warnings) == 1
    assert source.info.reading["colour"] in source.warnings[0][0]
    assert source.info.reading["colour_told"] and source.info.reading["matrix_told"]


def test_rec709_video_is_read_unchanged_without_warnings(write_patches):
    source, got = write_patches(1, 1, 1)
    assert np.abs(got - PATCHES).max() < 1.2 / 255
    assert (source.warnings, source.info.colour, len(source.info.key)) == ([], "srgb", 3)


def test_hdr_highlights_are_kept(write_patches):
    bright = np.array([[0.9, 0.9, 0.9], *PATCHES[1:]])
    _, got = write_patches(16, 9, 9, bright)
    assert pq_light(0.9) > 15 and srgb_light(got[0]) == pytest.approx(pq_light(0.9), rel=1e-2)


def test_unknown_transfer_function_is_reported(write_patches):
    source, _ = write_patches(9, 1, 1)
    assert source.warnings[0][0] == (
        "The clip's transfer function (number 9 of ITU-T H.273) is unknown: read as video."
    )
    assert not source.info.reading["colour_told"]


@pytest.mark.parametrize(
    "size, tags, choices, reason",
    [
        ((48, 64), {}, {}, ""),
        ((16, 1280), {}, {}, "it does not state its colour matrix"),
        ((16, 1280), {"colorspace": 1}, {}, ""),
        ((48, 64), {}, {"matrix": "bt709"}, "its matrix or levels were set by hand"),
        ((48, 64), {"rotation": 90}, {}, ""),  # Blender applies the rotation itself
        ((48, 64), {"aspect": Fraction(2)}, {}, "its pixels are not square"),
    ],
)
def test_footage_that_blender_decodes_differently_is_marked(tmp_path, write_video, size, tags, choices, reason):
    """FFmpeg, and therefore Blender, decodes clips without a matrix as BT.601 at any size."""
    options = {name: tags[name] for name in ("rotation", "aspect") if name in tags}
    frames = [np.full((*size, 3), 60, np.uint8)] * 3
    write_video(
        tmp_path / "a.mp4", frames, **options, **({"x264-params": "colormatrix=bt709"} if "colorspace" in tags else {})
    )
    assert open_source(str(tmp_path / "a.mp4"), overrides=Overrides(**choices)).info.mismatch == reason
