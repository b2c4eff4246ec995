"""Timecode: compared with hand counts and the drop-frame rule, through files and into frozen frames."""

from fractions import Fraction

import av
import numpy as np
import OpenImageIO as oiio
import pytest

from tests.backend.pictures import write
from torch_backend.contract.timecode import later, parse_timecode, smpte_bits
from torch_backend.footage import FootageConfig, import_footage, load_frames
from torch_backend.footage.opening import open_source
from torch_backend.shot import Shot


@pytest.mark.parametrize(
    ("start", "frames", "fps", "expected"),
    [
        ("01:00:00:00", 0, 24.0, "01:00:00:00"),
        ("01:00:00:23", 1, 23.976, "01:00:01:00"),
        ("01:02:59:24", 26, 25.0, "01:03:01:00"),
        ("23:59:59:29", 1, 30.0, "00:00:00:00"),
        ("00:00:00:00", -1, 24.0, "23:59:59:23"),
        ("00:00:59;29", 1, 29.97, "00:01:00;02"),
        ("00:09:59;29", 1, 29.97, "00:10:00;00"),
        ("00:00:00;00", 17982, 29.97, "00:10:00;00"),
        ("00:00:00;00", 107892, 29.97, "01:00:00;00"),
        ("00:00:59;59", 1, 59.94, "00:01:00;04"),
        ("23:59:59;29", 1, 29.97, "00:00:00;00"),
    ],
)
def test_a_timecode_moves_on(start, frames, fps, expected):
    assert later(start, frames, fps) == expected
    assert later(expected, -frames, fps) == start


def test_dropped_numbers_never_come():
    """Every seventh frame of eleven minutes: each code occurs once, and no dropped number occurs."""
    codes = [later("00:00:00;00", n, 29.97) for n in range(0, 20_000, 7)]
    assert len(set(codes)) == len(codes) and codes == sorted(codes)
    assert not any(c[6:8] == "00" and int(c[9:]) < 2 and int(c[3:5]) % 10 for c in codes)


@pytest.mark.parametrize("text", ["", "1:2:3:4", "24:00:00:00", "00:60:00:00", "later", "00:00:00:00 and more"])
def test_what_is_no_timecode(text):
    assert parse_timecode(text) == ""


def test_bits_are_those_that_openexr_reads():
    spec = oiio.ImageSpec(8, 8, 3, "half")
    for code in ("01:02:03:04", "23:59:59:23", "10:20:30;19"):
        spec.attribute("smpte:TimeCode", oiio.TypeDesc("timecode"), smpte_bits(code))
        assert spec.get_string_attribute("smpte:TimeCode").replace(";", ":") == code.replace(";", ":")
    with pytest.raises(ValueError, match="timecode cannot be stored in a picture"):
        smpte_bits("00:00:00:59")


@pytest.mark.parametrize("suffix", ["mov", "mp4", "mxf", "mkv"])
def test_videos_carry_it(tmp_path, pan, suffix):
    path = tmp_path / f"a.{suffix}"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg2video" if suffix == "mxf" else "libx264", rate=Fraction(24000, 1001))
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.metadata["timecode"] = container.metadata["timecode"] = "01:02:03:04"
        for picture in pan(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24")))
        container.mux(stream.encode())
    assert open_source(str(path)).info.reading["timecode"] == "01:02:03:04"


@pytest.fixture
def with_timecode(tmp_path, pan):
    """with_timecode(suffix, code): a sequence from 1001 whose files store this timecode; an empty code stores none."""

    def make(suffix="exr", code="10:00:00:00"):
        folder = tmp_path / f"{suffix}{len(code)}"
        folder.mkdir()
        for n, picture in enumerate(pan(10)):
            pixels = (picture / np.float32(255)).astype(np.float16) if suffix == "exr" else picture
            bits = (oiio.TypeDesc("timecode"), smpte_bits(later(code, n, 24))) if code else None
            write(folder / f"a.{1001 + n}.{suffix}", pixels, **({"smpte__TimeCode": bits} if bits else {}))
        return folder

    return make


@pytest.mark.parametrize("suffix", ["exr", "dpx"])
def test_pictures_carry_it_and_a_range_begins_later(tmp_path, with_timecode, recorder, suffix):
    shot = Shot.create(tmp_path / "a.splannequin")
    record = import_footage(shot, str(with_timecode(suffix)), FootageConfig(first=1003, step=1), recorder())
    assert load_frames(shot)["timecode"] == "10:00:00:02"
    assert ", timecode 10:00:00:02." in record["read_as"][0]


def test_footage_without_one_has_none(tmp_path, with_timecode, recorder):
    shot = Shot.create(tmp_path / "a.splannequin")
    record = import_footage(shot, str(with_timecode(code="")), FootageConfig(step=1), recorder())
    assert load_frames(shot)["timecode"] == "" and "timecode" not in record["read_as"][0]
