"""Focal length stored in a file's Exif data or QuickTime keys, and its use."""

import math

import av
import numpy as np
import OpenImageIO as oiio
import pytest

from torch_backend.footage.lens_tags import focal_px
from torch_backend.footage.opening import open_source
from torch_backend.footage.reading import read_as


def pictures(folder, focal):
    rng = np.random.default_rng(0)
    for n in range(1, 10):
        spec = oiio.ImageSpec(64, 48, 3, "uint8")
        if focal is not None:
            spec.attribute("Exif:FocalLengthIn35mmFilm", focal)
        picture = oiio.ImageBuf(spec)
        picture.set_pixels(oiio.ROI(), rng.uniform(0, 1, (48, 64, 3)).astype(np.float32))
        assert picture.write(str(folder / f"f.{n:04d}.jpg"))
    return str(folder / "f.####.jpg")


def video(folder, focal):
    with av.open(str(folder / "a.mov"), "w", options={"movflags": "use_metadata_tags"}) as container:
        if focal is not None:
            container.metadata["com.apple.quicktime.camera.focal_length.35mm_equivalent"] = focal
        stream = container.add_stream("libx264", rate=24)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for n in range(10):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 20 * n, np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return str(folder / "a.mov")


@pytest.mark.parametrize(("make", "value"), [(pictures, 26), (video, "26")])
def test_a_focal_length_is_read_and_said(tmp_path, make, value):
    info = open_source(make(tmp_path, value)).info
    assert info.reading["focal_35mm"] == 26.0
    assert "a lens of 26 mm (on 35 mm film)" in read_as(info)[0]


@pytest.mark.parametrize(("make", "value"), [(pictures, None), (pictures, 0), (video, None), (video, "wide")])
def test_a_file_that_does_not_say_or_says_nonsense_has_none(tmp_path, make, value):
    info = open_source(make(tmp_path, value)).info
    assert "focal_35mm" not in info.reading and "lens" not in read_as(info)[0]


def test_the_equivalent_is_over_the_diagonal():
    """The 35 mm equivalent refers to the diagonal: 50 mm see 46.8 degrees between corners for every picture shape."""
    for width, height in ((640, 480), (1920, 1080), (1080, 1920)):
        half = math.hypot(width, height) / 2
        assert 2 * math.degrees(math.atan(half / focal_px(50.0, width, height))) == pytest.approx(46.8, abs=0.05)
