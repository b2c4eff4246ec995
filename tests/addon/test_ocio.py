"""Colour configurations (OCIO) of other studios: camera and take are inserted, or the scene stays unchanged."""

import json
import os
import subprocess
import sys
from pathlib import Path

import bpy
import numpy as np
import pytest

from tests.addon.data import make_detail
from tests.addon.data import make_shoulder as shoulder
from tests.addon.data.pixels import read

DATA = Path(__file__).resolve().parent / "data"

FROM_AP0 = (
    "!<MatrixTransform> {matrix: [2.52168618674388, -1.13413098823972, -0.387555198504164, 0, -0.276479914229922, "
    "1.37271908766826, -0.096239173438334, 0, -0.0153780649660342, -0.152975335867399, 1.16835340083343, 0, 0, 0, 0, "
    "1]}"
)
"""ACES2065-1 to linear Rec.709, with the numbers of the ACES configurations."""
CURVE = "!<ExponentWithLinearTransform> {gamma: 2.4, offset: 0.055, direction: inverse}"
CONFIG = """ocio_profile_version: 2
search_path: ""
roles:
  aces_interchange: ACES2065-1
  cie_xyz_d65_interchange: CIE XYZ-D65 - Display-referred
  color_picking: {paint}
  data: Raw
  matte_paint: {paint}
  scene_linear: ACEScg
  texture_paint: {paint}
file_rules:
  - !<Rule> {{name: Default, colorspace: ACES2065-1}}
shared_views:
  - !<View> {{name: {view}, view_transform: Un-tone-mapped, display_colorspace: <USE_DISPLAY_NAME>}}
  - !<View> {{name: Raw, colorspace: Raw}}
displays:
  sRGB - Display:
    - !<Views> [Raw, {view}]
view_transforms:
  - !<ViewTransform>
    name: Un-tone-mapped
    from_scene_reference: !<BuiltinTransform> {{style: UTILITY - ACES-AP0_to_CIE-XYZ-D65_BFD}}
display_colorspaces:
  - !<ColorSpace>
    name: CIE XYZ-D65 - Display-referred
  - !<ColorSpace>
    name: sRGB - Display
    from_display_reference: !<BuiltinTransform> {{style: DISPLAY - CIE-XYZ-D65_to_{display}}}
colorspaces:
  - !<ColorSpace>
    name: ACES2065-1
  - !<ColorSpace>
    name: ACEScg
    to_scene_reference: !<BuiltinTransform> {{style: ACEScg_to_ACES2065-1}}
  - !<ColorSpace>
    name: Raw
    isdata: true
"""
SPACES = """  - !<ColorSpace>
    name: {linear}
    from_scene_reference: {matrix}
  - !<ColorSpace>
    name: {srgb}
    from_scene_reference: !<GroupTransform> {{children: [{matrix}, {curve}]}}
"""


def configuration(folder: Path) -> Path:
    """Write a small ACES configuration. Its names for linear Rec.709 and sRGB say nothing."""
    text = CONFIG.format(paint="Bildschirm", view="Un-tone-mapped", display="sRGB")
    text += SPACES.format(linear="Licht", srgb="Bildschirm", matrix=FROM_AP0, curve=CURVE)
    (folder / "config.ocio").write_text(text)
    return folder / "config.ocio"


def blender(config: Path | str, root: Path, shot: Path, out: Path, script: str = "in_ocio") -> dict:
    """Run a script of data/ in another Blender with a colour configuration; return the content of told.json."""
    script = str(root / "tests" / "addon" / "data" / f"{script}.py")
    command = [bpy.app.binary_path, "--background", "--factory-startup", "--python", script]
    command = command if bpy.app.binary_path else [sys.executable, script]
    done = subprocess.run(
        [*command, "--", str(shot), str(out)],
        env={**os.environ, "OCIO": str(config)},
        capture_output=True,
        text=True,
        errors="replace",
        timeout=120,
        check=False,
    )
    printed = done.stdout + done.stderr
    if str(config).startswith("ocio://") and f"could not read '{config}'" in printed:
        pytest.skip("this Blender's OpenColorIO has no configurations built in: it is older than 2.2")
    assert (out / "told.json").is_file(), printed
    return json.loads((out / "told.json").read_text())


def test_camera_and_take_come_in_whole_under_an_aces_configuration(root, shot, tmp_path, pictures, layers):
    """Colour spaces are known by their effect, not by their names. Pixels pass through ACEScg unchanged."""
    result = blender(configuration(tmp_path), root, shot, tmp_path)
    assert "my shot é camera is the scene's camera, with the plate behind it." in result["first"]["said"]
    said = "View transform set from Raw to Un-tone-mapped, so that the plate keeps its colours."
    assert said in result["freeze"]["said"]
    assert "said" in result["combined"]
    plate = pictures.read(tmp_path / "plate" / "000006.png")
    assert np.abs(plate - pictures.read(shot / "frames" / "000006.png")).max() * 255 < 1.1
    frozen = pictures.read(tmp_path / "frozen" / "000006.png")
    expected = pictures.srgb(layers(6)["rgba"][..., :3])
    assert np.abs(frozen - expected)[:, 1:].max() * 255 < 1.6
    assert not result["end"]["made"] and not result["end"]["own"] and result["end"]["colours"][0] == "Raw"


def test_unmatched_colour_space_is_reported_and_changes_nothing(root, shot, tmp_path):
    text = CONFIG.format(paint="ACEScg", view="Film", display="REC.1886-REC.709")
    (tmp_path / "config.ocio").write_text(text)
    result = blender(tmp_path / "config.ocio", root, shot, tmp_path)
    for step in ("first", "again"):
        assert result[step]["error"] == (
            "Blender's OCIO colour configuration has no colour space for sRGB. "
            "Start Blender without this configuration, or add the colour space to it."
        )
        assert result[step]["changed"] == {}, f"{step}: a build that failed left something behind"
    assert result["without a plate"]["changed"]["made"] == [[], ["my shot é"]]
    assert "no view that keeps colours unchanged" in result["freeze"]["error"] and result["freeze"]["changed"] == {}
    assert "no colour space for scene-linear Rec.709" in result["as they come"]["error"]
    assert result["as they come"]["changed"] == {}


CG_CONFIG = "ocio://cg-config-v2.1.0_aces-v1.3_ocio-v2.3"
"""ACES configuration for CG that is built into OpenColorIO."""
TO_AP1 = np.linalg.inv([[1.70505, -0.62179, -0.08326], [-0.13026, 1.14080, -0.01055], [-0.02400, -0.12897, 1.15297]])
"""Linear Rec.709 to ACEScg: inverse of the published matrix."""


def with_detail(shot, probe):
    """Shot with a take of data/detail and its EXR plates; `probe`: linear Rec.709 light of the contract's `PROBE`."""
    make_detail.add_take(shot, probe=probe, space="light")
    return shot


def light(path):
    """[H, W, 3]: values stored in a file, in the scene's linear space."""
    return read(path)[..., :3]


def relative_error(found, expected):
    """Largest pixel error relative to the pixel's brightest channel (at least 0.01)."""
    return float((np.abs(found - expected).max(-1) / np.maximum(np.abs(expected).max(-1), 0.01)).max())


def test_light_passes_an_aces_scene_within_a_thousandth(root, shot, tmp_path):
    """Rec.709 values from -0.2 to 50 through ACEScg, for the plate, the take's frames, and the plate frozen by its
    warp."""
    result = blender(CG_CONFIG, root, with_detail(shot, [0.78125, 0.390625, 0.1953125]), tmp_path, "in_aces")
    assert any("000005.exr is used as the plate" in line for line in result["said"])
    half = make_detail.frozen(6).astype(np.float32).astype(np.float16)
    for name, expected in (("plate", make_detail.plate(6)), ("frozen", half), ("warp", make_detail.frozen(6))):
        assert relative_error(light(tmp_path / f"{name}.exr"), expected @ TO_AP1.T) < 1e-3, name


def test_working_frames_with_a_shoulder_give_their_light_to_an_aces_scene(root, shot, tmp_path):
    """The shoulder applies to Rec.709 channels, so light of up to 60 is converted from the scene's space and back."""
    take_file = with_detail(shot, [0.78125, 0.390625, 0.1953125]) / "takes" / "detail" / "take.json"
    facts = json.loads(take_file.read_text())
    facts["footage"]["unlike"] = "its pixels are not square"
    take_file.write_text(json.dumps(facts))
    expected = shoulder.light(56, 42)
    for frame in (5, 6):
        shoulder.write(shot / "frames" / f"{frame:06d}.png", expected)
    listing = shot / "frames" / "frames.json"
    listing.write_text(json.dumps({**json.loads(listing.read_text()), "display": "shoulder"}))
    result = blender(CG_CONFIG, root, shot, tmp_path, "in_aces")
    assert any("shows working frames as the plate" in line for line in result["said"])
    # One 16-bit step at the end of the shoulder is 8e-4 of light; Blender 4.2 has errors of some steps.
    assert relative_error(light(tmp_path / "plate.exr"), expected @ TO_AP1.T) < 5e-3


def test_an_acescg_plate_passes_an_aces_scene_bit_for_bit(root, shot, tmp_path):
    probe = np.linalg.inv(TO_AP1) @ [0.78125, 0.390625, 0.1953125]
    blender(CG_CONFIG, root, with_detail(shot, probe.tolist()), tmp_path, "in_aces")
    assert np.array_equal(light(tmp_path / "plate.exr"), make_detail.plate(6))


def test_camera_and_take_come_in_whole_under_the_cg_configuration(root, shot, tmp_path, pictures, layers):
    result = blender(CG_CONFIG, root, shot, tmp_path)
    assert "my shot é camera is the scene's camera, with the plate behind it." in result["first"]["said"]
    assert any("to Un-tone-mapped, so that the plate keeps its colours" in line for line in result["freeze"]["said"])
    plate = pictures.read(tmp_path / "plate" / "000006.png")
    assert np.abs(plate - pictures.read(shot / "frames" / "000006.png")).max() * 255 < 1.1
    frozen = pictures.read(tmp_path / "frozen" / "000006.png")
    assert np.abs(frozen - pictures.srgb(layers(6)["rgba"][..., :3]))[:, 1:].max() * 255 < 1.6
    assert not result["end"]["made"] and not result["end"]["own"] and "ACES" in result["end"]["colours"][0]
