"""Colour spaces by name from OCIO configurations, compared with OpenImageIO's conversions on real files."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from tests.backend.pictures import write
from torch_backend.contract import ExitCode, JobError
from torch_backend.footage import FootageConfig, import_footage, load_frames
from torch_backend.footage.color import PRIMARIES, InputSpace, hlg_to_linear, pq_to_linear
from torch_backend.footage.ocio import BUILT_IN, Colours, OcioSpace, light_of, space_names
from torch_backend.footage.opening import open_source
from torch_backend.footage.plates import Plates
from torch_backend.shot import Shot

CONFIG = """ocio_profile_version: 2
search_path: ""
roles: {{{interchange}default: Raw, scene_linear: Flat}}
file_rules:
  - !<Rule> {{name: scans, pattern: "*scan*", extension: "*", colorspace: Halved}}
  - !<Rule> {{name: Default, colorspace: Raw}}
displays:
  none:
    - !<View> {{name: Raw, colorspace: Raw}}
colorspaces:
  - !<ColorSpace>
    name: Flat
    aliases: [{alias}]
  - !<ColorSpace>
    name: Halved
    to_scene_reference: !<MatrixTransform> {{matrix: [2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 1]}}
  - !<ColorSpace>
    name: Raw
    isdata: true
"""
LIGHT = np.array([-0.01, 0.001, 0.01, 0.18, 1.0, 10.0, 50.0], np.float32)


@pytest.fixture(autouse=True)
def no_config_of_this_machine(monkeypatch):
    monkeypatch.delenv("OCIO", raising=False)
    # OpenImageIO reads its own configuration once per process; this call keeps it from reading one of the tests.
    oiio.ImageBufAlgo.colorconvert(oiio.ImageBuf(np.zeros((1, 1, 3), np.float32)), "ACEScg", "lin_rec709")


def swatches(grey=False):
    """[3, 7, 3] tints of `LIGHT`, or greys."""
    tints = np.array([[1.0, 1.0, 1.0], [1.0, 0.8, 0.6], [0.7, 0.9, 1.0]], np.float32)
    return LIGHT[None, :, None] * (np.ones((3, 1, 3), np.float32) if grey else tints[:, None])


def converted(pixels, space, target, config=BUILT_IN):
    """Pixels converted by OpenImageIO."""
    out = oiio.ImageBufAlgo.colorconvert(oiio.ImageBuf(pixels), space, target, False, "", "", config)
    assert not out.has_error, out.geterror()
    return np.asarray(out.get_pixels(oiio.FLOAT))


def relative_error(found, expected):
    """Largest error of a pixel, relative to its brightest channel."""
    return float((np.abs(found - expected).max(-1) / np.abs(expected).max(-1)).max())


def written(folder, pixels, name="a", **attributes):
    folder.mkdir(exist_ok=True)
    for number in range(1, 4):
        write(folder / f"{name}.{number}.exr", pixels, **attributes)
    return folder


def read(folder, *chosen):
    """(scene-linear Rec.709 plate of the middle frame, its source)."""
    source = open_source(str(folder), colours=Colours(*chosen))
    return source.plates(None).plate(2).astype(np.float32), source


LOGS = ["ARRI LogC3 (EI800)", "ARRI LogC4", "S-Log3 S-Gamut3", "V-Log V-Gamut", "Log3G10 REDWideGamutRGB", "ACEScct"]


@pytest.mark.parametrize("space", ["ACEScg", "ACES2065-1", "Linear Rec.2020", *LOGS])
def test_linear_light_round_trips(space):
    """OpenImageIO encodes light of 0.001 to 50 and -0.01; our decoding agrees with the light and with OpenImageIO's
    decoding."""
    codes = converted(swatches(), "lin_rec709_scene", space)
    found = light_of(codes, space, BUILT_IN)
    assert relative_error(found, swatches()) < 1e-3
    assert relative_error(found, converted(codes, space, "lin_rec709_scene")) < 1e-5
    assert found[0, 0] == pytest.approx(-0.01, rel=1e-3)


@pytest.mark.parametrize("space", ["ADX10", "ADX16"])
def test_a_film_scan_comes_back_from_black_on(space):
    """Film densities cannot encode light below black."""
    codes = converted(swatches()[:, 1:].copy(), "lin_rec709_scene", space)
    assert relative_error(light_of(codes, space, BUILT_IN), swatches()[:, 1:]) < 1e-3


@pytest.mark.parametrize(
    "ours, theirs", [(pq_to_linear, "Rec.2100-PQ - Display"), (hlg_to_linear, "Rec.2100-HLG - Display")]
)
def test_our_hdr_curves_are_ocios_but_for_what_white_is(ours, theirs):
    codes = np.random.default_rng(1).uniform(0.05, 0.95, (9, 11, 3)).astype(np.float32)
    space = InputSpace("pq" if "PQ" in theirs else "hlg", "rec2020")
    assert relative_error(space.to_linear(codes) * 2.03, light_of(codes, theirs, BUILT_IN)) < 1e-3
    grey = np.full((1, 1, 3), 0.5, np.float32)
    assert ours(grey)[0, 0] * 2.03 == pytest.approx(light_of(grey, theirs, BUILT_IN)[0, 0], rel=1e-4)


def test_a_sequence_in_a_named_space_is_what_oiiotool_makes_of_it(tmp_path):
    """oiiotool converts the file in a separate process; plates agree within 1e-3, and record and message name the
    space."""
    folder = written(tmp_path / "plate", converted(swatches(), "lin_rec709_scene", "S-Log3 S-Gamut3"))
    tool = str(Path(sys.executable).with_name("oiiotool"))
    command = [tool, str(folder / "a.2.exr"), "--colorconfig", BUILT_IN]
    command += ["--colorconvert", "S-Log3 S-Gamut3", "lin_rec709_scene", "-o", str(tmp_path / "light.exr")]
    subprocess.run(command, check=True)
    expected = np.asarray(oiio.ImageBuf(str(tmp_path / "light.exr")).get_pixels(oiio.FLOAT))
    found, source = read(folder, "s-log3 s-gamut3")
    assert relative_error(found, expected) < 1e-3 and relative_error(found, swatches()) < 1e-3
    list(source.frames(None, None))
    assert [message for message, _ in source.warnings] == [
        "The pictures are S-Log3 S-Gamut3 (OCIO): converted to Rec.709."
    ]
    reading = source.info.reading
    assert (reading["colour"], reading["colour_told"], reading["ocio"]) == ("S-Log3 S-Gamut3 (OCIO)", True, BUILT_IN)


@pytest.mark.parametrize("named_by_user", ["ARRI LogC3 (EI800)", "ocio:arrilogc3_awg3_scene", "arri_logc3_ei800"])
def test_a_name_in_the_file_is_looked_up_in_the_configuration(tmp_path, named_by_user):
    codes = converted(swatches(), "lin_rec709_scene", "ARRI LogC3 (EI800)")
    found, source = read(written(tmp_path / "plate", codes, colorInteropID=named_by_user))
    assert relative_error(found, swatches()) < 1e-3 and source.info.reading["colour"] == "ARRI LogC3 (EI800) (OCIO)"


def test_a_chosen_space_outdoes_what_the_file_says(tmp_path):
    folder = written(
        tmp_path / "plate", converted(swatches(), "lin_rec709_scene", "ACEScg"), colorInteropID="lin_rec709_scene"
    )
    assert relative_error(read(folder)[0], swatches()) > 0.05
    assert relative_error(read(folder, "ACEScg")[0], swatches()) < 1e-3


def test_srgb_is_bit_identical():
    assert Colours("sRGB - Display").space() == InputSpace("srgb")
    assert Colours("cineon").space() == InputSpace("cineon"), "what only we name is known, too"


def test_names_that_cannot_be_are_refused_in_a_sentence(tmp_path, monkeypatch):
    with pytest.raises(JobError, match=f"configuration {BUILT_IN} has no colour space 'ACEScgg'") as refused:
        Colours("ACEScgg").space()
    assert "among them: ACEScg" in refused.value.hint and refused.value.exit_code == ExitCode.FOOTAGE
    with pytest.raises(JobError, match="'Raw' is a colour space for data"):
        Colours("Raw").space()
    monkeypatch.setenv("OCIO", str(tmp_path / "none.ocio"))
    with pytest.raises(JobError, match="cannot be read"):
        Colours("ACEScg").space()
    (tmp_path / "none.ocio").write_text(CONFIG.format(interchange="", alias="nobody_knows"))
    with pytest.raises(JobError, match="neither ACES2065-1 .* nor linear Rec.709"):
        Colours("Halved").space()


@pytest.mark.parametrize("interchange", ["", "aces_interchange: Flat, "])
def test_the_configuration_of_the_environment_is_the_one_in_force(tmp_path, monkeypatch, interchange):
    """One configuration has ACES2065-1 as a role; the other, of OCIO 1, only names linear Rec.709."""
    config = tmp_path / "studio.ocio"
    config.write_text(CONFIG.format(interchange=interchange, alias="lin_rec709"))
    monkeypatch.setenv("OCIO", str(config))
    assert space_names(str(config)) == ["Flat", "Halved", "Raw"]
    colour = np.array([0.3, 0.2, 0.1], np.float32)
    found, source = read(written(tmp_path / "plate", np.tile(colour, (4, 4, 1))), "Halved")
    expected = 2 * colour
    if interchange:
        expected = converted(expected[None, None], "ACES2065-1", "lin_rec709_scene")[0, 0]
    assert found[2, 2] == pytest.approx(expected, rel=1e-3) and source.info.reading["ocio"] == str(config)
    scan = written(tmp_path / "scans", np.tile(colour, (4, 4, 1)), "scan")
    assert read(scan)[0][2, 2] == pytest.approx(expected, rel=1e-3), "by a file rule"
    plain = written(tmp_path / "other", np.tile(colour, (4, 4, 1)))
    assert read(plain)[0][2, 2] == pytest.approx(colour, rel=1e-3), "the default rule says nothing of a file"


def test_a_video_in_a_named_space(tmp_path, write_video):
    light = np.full((48, 64, 3), 0.18, np.float32)
    code = converted(light, "lin_rec709_scene", "ARRI LogC3 (EI800)")[0, 0]
    frames = [np.tile(np.rint(code * 255).astype(np.uint8), (48, 64, 1))] * 3
    write_video(tmp_path / "log.mp4", frames)
    source = open_source(str(tmp_path / "log.mp4"), colours=Colours("ARRI LogC3 (EI800)"))
    light = next(iter(source.frames(None, None))).pixels[20, 20].astype(np.float32)
    assert light == pytest.approx(0.18, rel=0.05), "within a step of 8 bits"
    assert source.info.extended and source.info.deep and source.info.reading["colour"] == "ARRI LogC3 (EI800) (OCIO)"


def test_plates_keep_to_the_configuration_of_the_import(tmp_path, monkeypatch, recorder, pan):
    """$OCIO has changed since the import: plates still agree with the imported frames, and highlights are kept."""
    config, folder = tmp_path / "studio.ocio", tmp_path / "plate"
    config.write_text(CONFIG.format(interchange="", alias="lin_rec709"))
    folder.mkdir()
    for number, picture in enumerate(pan(9), start=1):
        write(folder / f"a.{number}.exr", (picture / 160.0).astype(np.float16))
    monkeypatch.setenv("OCIO", str(config))
    shot = Shot.create(tmp_path / "a.splannequin")
    import_footage(shot, str(folder), FootageConfig(colour_space="Halved"), recorder())
    record = load_frames(shot)
    assert record["config"]["colour_space"] == "Halved" and record["reading"]["ocio"] == str(config)
    monkeypatch.delenv("OCIO")
    from tests.backend.footage.test_plates import solved

    plates = Plates(solved(shot))
    assert plates.note == "" and plates.linear(3).max() > 1.0


def test_an_ocio_space_is_light():
    space = OcioSpace("lin", "", space="ACEScg", config=BUILT_IN)
    assert space.is_light and not space.is_passthrough
    ap1 = np.array([[[0.3, 0.25, 0.2]]], np.float32)
    assert relative_error(space.to_linear(ap1), InputSpace("lin", "ap1").to_linear(ap1)) < 1e-4
    assert PRIMARIES["ap1"][0] == "ACEScg (AP1)"
