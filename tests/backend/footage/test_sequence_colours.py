"""Colours of image sequences are converted to linear Rec.709."""

import struct

import numpy as np
import OpenImageIO as oiio
import pytest

from tests.backend.footage.test_sequence import first_of, flat, said
from tests.backend.pictures import write
from torch_backend.footage.opening import open_source

WHITE = {"D65": (0.3127, 0.3290), "ACES": (0.32168, 0.33767)}
PRIMARIES = {
    "Rec.709": ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06), WHITE["D65"]),
    "ACEScg (AP1)": ((0.713, 0.293), (0.165, 0.830), (0.128, 0.044), WHITE["ACES"]),
    "BT.2020": ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046), WHITE["D65"]),
    "custom primaries": ((0.70, 0.30), (0.20, 0.75), (0.14, 0.05), (0.3457, 0.3585)),
}


def to_rec709(name):
    """Matrix from the named primaries to Rec.709 by definition, with Bradford adaptation of the white point, in
    float64."""

    def to_xyz(corners):
        columns = np.array([[x / y, 1.0, (1.0 - x - y) / y] for x, y in corners]).T
        return columns[:, :3] * (np.linalg.inv(columns[:, :3]) @ columns[:, 3])

    bradford = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
    theirs, ours = to_xyz(PRIMARIES[name]), to_xyz(PRIMARIES["Rec.709"])
    gain = np.diag((bradford @ ours @ np.ones(3)) / (bradford @ theirs @ np.ones(3)))
    return np.linalg.inv(ours) @ np.linalg.inv(bradford) @ gain @ bradford @ theirs


def test_the_matrix_of_acescg_is_the_published_one():
    published = [[1.70505, -0.62179, -0.08326], [-0.13026, 1.14080, -0.01055], [-0.02400, -0.12897, 1.15297]]
    assert np.allclose(to_rec709("ACEScg (AP1)"), published, atol=2e-5)


@pytest.mark.parametrize("name", [n for n in PRIMARIES if n != "Rec.709"])
def test_chromaticities_are_converted_and_named(tmp_path, name):
    colour = np.array([0.30, 0.25, 0.20])
    values = tuple(float(v) for corner in PRIMARIES[name] for v in corner)
    for i in range(3):
        write(tmp_path / f"a.{i}.exr", flat(*colour), chromaticities=values)
    source, pixel = first_of(tmp_path)
    assert pixel == pytest.approx(to_rec709(name) @ colour, rel=3e-4)
    assert said(source) == [f"The pictures are linear, {name}: converted to Rec.709."]
    assert source.info.reading["colour"] == f"linear, {name}"
    assert source.info.reading["colour_told"]


def test_a_named_colour_space_is_converted(tmp_path):
    colour = np.array([0.30, 0.25, 0.20])
    for i in range(3):
        write(tmp_path / f"a.{i}.exr", flat(*colour), oiio__ColorSpace="ACEScg")
    assert first_of(tmp_path)[1] == pytest.approx(to_rec709("ACEScg (AP1)") @ colour, rel=3e-4)


def test_rec709_light_needs_no_words_and_what_was_assumed_is_recorded(tmp_path):
    values = tuple(float(v) for corner in PRIMARIES["Rec.709"] for v in corner)
    for i in range(3):
        write(tmp_path / f"a.{i}.exr", flat(0.3, 0.2, 0.1))
        write(tmp_path / f"b.{i}.exr", flat(0.3, 0.2, 0.1), chromaticities=values)
    for name, is_named in (("a.0.exr", False), ("b.0.exr", True)):
        source, pixel = first_of(tmp_path / name)
        assert pixel == pytest.approx([0.3, 0.2, 0.1], abs=5e-5)
        assert (said(source), source.info.reading["colour_told"]) == ([], is_named)


def test_impossible_chromaticities_are_reported(tmp_path):
    for i in range(3):
        write(tmp_path / f"a.{i}.exr", flat(0.3, 0.2, 0.1), chromaticities=(0.0,) * 8)
    source, pixel = first_of(tmp_path)
    assert pixel == pytest.approx([0.3, 0.2, 0.1], abs=5e-5)
    assert said(source) == ["The chromaticities in a.0.exr are impossible: Rec.709 is assumed."]


@pytest.mark.parametrize("transfer", ["Printing density", "Logarithmic"])
def test_film_log_becomes_light(tmp_path, transfer):
    codes = np.array([95.0, 470.0, 685.0])
    for i in range(3):
        write(tmp_path / f"a.{i}.dpx", flat(*np.rint(codes / 1023 * 65535), kind=np.uint16), dpx__Transfer=transfer)
    source, pixel = first_of(tmp_path)
    black = 10 ** ((95 - 685) * 0.002 / 0.6)
    assert pixel == pytest.approx((10 ** ((codes - 685) * 0.002 / 0.6) - black) / (1 - black), abs=2e-4)
    assert said(source)[0].startswith("The pictures are Cineon log: read with black at code 95")
    assert source.info.colour == "linear"


def profile(name):
    """ICC profile that only contains its name."""
    text = name.encode() + b"\0"
    described = b"desc" + bytes(4) + struct.pack(">I", len(text)) + text + bytes(78)
    head = struct.pack(">I4sI4s4s4s", 144 + len(described), b"none", 0x02100000, b"mntr", b"RGB ", b"XYZ ")
    head += struct.pack(">6H4s", 2026, 1, 1, 0, 0, 0, b"acsp") + b"APPL"
    head = head.ljust(68, b"\0") + struct.pack(">3I", 0xF6D6, 0x10000, 0xD32D)
    return head.ljust(128, b"\0") + struct.pack(">I4sII", 1, b"desc", 144, len(described)) + described


@pytest.mark.parametrize(("name", "words"), [("Display P3", True), ("sRGB IEC61966-2.1", False)])
def test_unapplied_colour_profile_is_reported(tmp_path, name, words):
    content = np.frombuffer(profile(name), np.uint8)
    pixels = flat(200, 100, 50, kind=np.uint8)
    for i in range(3):
        write(tmp_path / f"a.{i}.png", pixels, ICCProfile=(oiio.TypeDesc(f"uint8[{content.size}]"), content))
    warnings = [f"The pictures carry the colour profile {name!r}, which is not applied."]
    assert said(first_of(tmp_path)[0]) == (warnings if words else [])


def write_cineon(path, codes):
    """Write 8 x 8 pixels of one 10-bit colour by Kodak's format description, because OpenImageIO cannot write
    Cineon."""
    head = struct.pack(">6I8s100s12s12s36x", 0x802A5FD7, 2048, 1024, 1024, 0, 2304, b"V4.5", b"", b"", b"")
    head += struct.pack(">BB2x", 0, 3)
    for i in range(8):
        sides = (10, 8, 8) if i < 3 else (0, 0, 0)
        head += struct.pack(">BBBxII4f", 0, i + 1 if i < 3 else 0, *sides, 0, 0, 1023, 2.046)
    head += bytes(260) + struct.pack(">4B2I20x", 0, 5, 0, 0, 0, 0)
    red, green, blue = codes
    path.write_bytes(head.ljust(2048, b"\0") + struct.pack(">I", red << 22 | green << 12 | blue << 2) * 64)


def test_cineon_files_are_read_as_film_log(tmp_path):
    codes = np.array([95, 470, 685])
    for i in range(3):
        write_cineon(tmp_path / f"a.{i}.cin", codes.tolist())
    source, pixel = first_of(tmp_path)
    black = 10 ** ((95 - 685) * 0.002 / 0.6)
    assert pixel == pytest.approx((10 ** ((codes - 685) * 0.002 / 0.6) - black) / (1 - black), abs=2e-4)
    assert said(source)[0].startswith("The pictures are Cineon log")


def test_unspecified_dpx_is_reported(tmp_path):
    for i in range(3):
        write(tmp_path / f"a.{i}.dpx", flat(30000, 20000, 10000, kind=np.uint16))
        write(tmp_path / f"b.{i}.dpx", flat(30000, 20000, 10000, kind=np.uint16), dpx__Transfer="SMPTE 274M")
    for name, words in (("a.0.dpx", ["The pictures do not say how their colour is encoded"]), ("b.0.dpx", [])):
        source = open_source(str(tmp_path / name))
        assert (next(iter(source.frames(None, None))).pixels[4, 4] == [30000, 20000, 10000]).all()
        assert [w.partition(":")[0] for w in said(source)] == words
