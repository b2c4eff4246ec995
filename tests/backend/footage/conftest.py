"""Tiny real clips and a reporter that records its events."""

from fractions import Fraction

import av
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from tests.backend.quiet import Quiet


@pytest.fixture(scope="session")
def recorder():
    return Quiet


@pytest.fixture(scope="session")
def pan():
    """pan(count, height, width, seed, speed): uint8 frames of a camera that pans over a random texture."""

    def make(count, height=48, width=64, seed=0, speed=2):
        rng = np.random.default_rng(seed)
        wide = gaussian_filter(rng.random((height, width + count * speed + 8, 3)), (2.0, 2.0, 0))
        wide = (wide - wide.min()) / (wide.max() - wide.min())
        tint = rng.random(3) * 0.6 + 0.4
        wide = np.rint(wide * tint * 255).astype(np.uint8)
        return [np.ascontiguousarray(wide[:, i * speed : i * speed + width]) for i in range(count)]

    return make


@pytest.fixture(scope="session")
def write_video():
    """write_video(path, frames, ...): writes a lossless H.264 file in YCbCr 4:4:4."""

    def write(
        path, frames, rate=24, rotation=None, aspect=None, milliseconds=None, codec="libx264", faststart=False,
        **context,
    ):  # fmt: skip
        options = {"movflags": "faststart"} if faststart else {}
        with av.open(str(path), "w", options=options) as container:
            stream = container.add_stream(codec, rate=rate)
            stream.height, stream.width = frames[0].shape[:2]
            stream.pix_fmt = context.pop("pix_fmt", "yuv444p")
            if codec == "libx264":
                stream.options = {"crf": "0", "preset": "ultrafast", **context}
            if aspect:
                stream.codec_context.sample_aspect_ratio = aspect
            if rotation:
                stream.set_display_rotation(rotation)
            if milliseconds:
                stream.codec_context.time_base = Fraction(1, 1000)
            kind = "rgb48le" if frames[0].dtype == np.uint16 else "rgb24"
            for i, pixels in enumerate(frames):
                frame = av.VideoFrame.from_ndarray(pixels, kind)
                if milliseconds:
                    frame.pts, frame.time_base = milliseconds[i], Fraction(1, 1000)
                container.mux(stream.encode(frame))
            container.mux(stream.encode())

    return write


@pytest.fixture
def frame_of_planes():
    """frame_of_planes(planes, format, size): video frame with exactly these codes; each plane is [h, w]."""

    def make(planes, kind, size=None):
        width, height = size or planes[0].shape[::-1]
        frame = av.VideoFrame(width, height, kind)
        for plane, codes in zip(frame.planes, planes, strict=True):
            rows = np.zeros((plane.height, plane.line_size // codes.itemsize), codes.dtype)
            rows[:, : codes.shape[1]] = codes
            plane.update(rows.tobytes())
        return frame

    return make
