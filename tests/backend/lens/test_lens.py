"""The lens in both directions, compared with pycolmap; the maps, compared with pictures resampled by them."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from torch_backend.cli import main, parser
from torch_backend.contract import CameraFrame, CameraPath, ExitCode, FreezeParams, JobError, TakeFolder
from torch_backend.lens.lens import Lens, doubtful, load_lens
from torch_backend.lens.stmap import (
    margin,
    needed_margin,
    redistort_map,
    undistort_map,
    write_maps,
    write_take_map,
)
from torch_backend.lens.undistort import Undistorter
from torch_backend.shot import Shot, write_json

ROOT = Path(__file__).resolve().parents[3]
WIDTH, HEIGHT = 160, 120
LENSES = {
    "none": ("SIMPLE_RADIAL", [150.0, 80.0, 60.0, 0.0]),
    "barrel": ("SIMPLE_RADIAL", [140.0, 82.0, 57.0, -0.2]),
    "strong barrel": ("SIMPLE_RADIAL", [125.0, 80.0, 60.0, -0.2]),
    "pincushion": ("SIMPLE_RADIAL", [120.0, 78.0, 61.0, 0.3]),
    "two terms": ("RADIAL", [130.0, 80.0, 60.0, -0.22, 0.06]),
    "tangential": ("OPENCV", [140.0, 150.0, 80.0, 60.0, -0.15, 0.03, 0.004, -0.003]),
}


def of_colmap(folder: Path, lenses: dict) -> dict[str, dict]:
    """By lens: the worker's pinhole and map, the model's parameters, points of the original and their rays.

    They are of a separate process, because pycolmap cannot be loaded with OpenImageIO.
    """
    code = (
        "import json, sys, numpy as np, pycolmap\n"
        "from torch_backend.sfm.answers import undistortion\n"
        "points = np.random.default_rng(3).uniform([0, 0], [160, 120], (500, 2))\n"
        "for name, (model, params) in json.loads(sys.argv[2]).items():\n"
        "    camera = pycolmap.Camera.create_from_model_name(1, model, 100.0, 160, 120)\n"
        "    camera.params = params\n"
        "    pinhole, where = undistortion(camera)\n"
        "    np.savez(f'{sys.argv[1]}/{name}.npz', pinhole=pinhole, where=where, points=points,\n"
        "             rays=np.asarray(camera.cam_from_img(points)), focal=camera.mean_focal_length(),\n"
        "             extra=[float(camera.params[i]) for i in camera.extra_params_idxs()])\n"
    )
    subprocess.run([sys.executable, "-c", code, str(folder), json.dumps(lenses)], check=True, cwd=ROOT)
    return {name: dict(np.load(folder / f"{name}.npz", allow_pickle=False)) for name in lenses}


@pytest.fixture(scope="module")
def colmap(tmp_path_factory):
    return of_colmap(tmp_path_factory.mktemp("lenses"), LENSES)


def solved(folder: Path, model: str, extra, focal: float, K, width=WIDTH, height=HEIGHT, **facts) -> Shot:
    """Shot with the files of a solve."""
    shot = Shot.create(folder / "lens.splannequin")
    frames = [CameraFrame(n, np.eye(4).ravel().tolist(), [float(v) for v in K]) for n in (1, 2)]
    write_json(shot.solve / "cameras.json", CameraPath(width, height, frames).to_json())
    record = {"version": 1, "camera_model": model, "distortion": list(map(float, extra)), "focal_px": float(focal)}
    write_json(shot.solve / "solve.json", {**record, **facts})
    return shot


@pytest.fixture
def shot_of(colmap, tmp_path):
    def make(name: str) -> Shot:
        of = colmap[name]
        return solved(tmp_path, LENSES[name][0], of["extra"], of["focal"], of["pinhole"])

    return make


def centres(width, height):
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)


def pixels_of(st, width, height):
    """Pixel coordinates of a map [H, W, 3], y down."""
    return np.stack([st[..., 0].astype(float) * width, (1.0 - st[..., 1].astype(float)) * height], axis=-1)


def bilinear(picture, at):
    """Bilinear samples of a picture [H, W] at pixels [..., 2], centres at +0.5; NaN if a neighbour is missing."""
    height, width = picture.shape
    x, y = at[..., 0] - 0.5, at[..., 1] - 0.5
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    inside = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)
    i, j = np.clip(i, 0, width - 2), np.clip(j, 0, height - 2)
    a, b = x - i, y - j
    top = picture[j, i] * (1 - a) + picture[j, i + 1] * a
    low = picture[j + 1, i] * (1 - a) + picture[j + 1, i + 1] * a
    return np.where(inside, top * (1 - b) + low * b, np.nan)


@pytest.mark.parametrize("name", LENSES)
def test_the_lens_is_colmaps_both_ways(colmap, shot_of, name):
    of, lens = colmap[name], load_lens(shot_of(name))
    focal = LENSES[name][1][:2] if name == "tangential" else LENSES[name][1][:1] * 2
    assert lens.focal == pytest.approx(focal, abs=1e-9), "from solve.json and cameras.json alone"
    where = lens.to_original(centres(WIDTH, HEIGHT).reshape(-1, 2)).reshape(HEIGHT, WIDTH, 2)
    np.testing.assert_allclose(where, of["where"], atol=2e-5)  # the worker's values are float32
    rays = (lens.to_plate(of["points"]) - lens.centre) / lens.plate_focal
    np.testing.assert_allclose(rays, of["rays"][:, :2], atol=1e-8)


@pytest.mark.parametrize("damage", [{"distortion": 3}, {"distortion": [None]}, {"focal_px": "wide"}])
def test_a_damaged_record_of_the_lens_is_reported(shot_of, tmp_path, damage):
    shot = Shot(shutil.copytree(shot_of(next(iter(LENSES))).root, tmp_path / "a.splannequin"))
    write_json(shot.solve_record, {**json.loads(shot.solve_record.read_text()), **damage})
    with pytest.raises(JobError) as refused:
        load_lens(shot)
    assert "solve.json" in refused.value.message and refused.value.exit_code == ExitCode.SOLVE


@pytest.mark.parametrize("name", LENSES)
def test_distort_and_undistort_cancel_to_a_millionth_of_a_pixel(shot_of, name):
    lens = load_lens(shot_of(name))
    lens.check()
    at = centres(WIDTH, HEIGHT).reshape(-1, 2)
    np.testing.assert_allclose(lens.to_original(lens.to_plate(at)), at, atol=1e-6)
    np.testing.assert_allclose(lens.to_plate(lens.to_original(at)), at, atol=1e-6)


@pytest.mark.parametrize("name", LENSES)
def test_maps_in_float32_compose_to_the_identity_where_both_are_defined(shot_of, name):
    """Each map is composed with the other lens direction at its float32 coordinates.

    The lens model is evaluated instead of the other map: linear interpolation would hide errors below 1e-3 px.
    """
    lens = load_lens(shot_of(name))
    across, down = needed_margin(lens, WIDTH, HEIGHT)
    at = centres(WIDTH, HEIGHT)
    undistorted = pixels_of(undistort_map(lens, WIDTH, HEIGHT), WIDTH, HEIGHT)
    np.testing.assert_allclose(lens.to_plate(undistorted.reshape(-1, 2)).reshape(at.shape), at, atol=1e-3)
    beyond = (across / WIDTH, down / HEIGHT)
    whole = pixels_of(redistort_map(lens, WIDTH, HEIGHT, beyond), WIDTH + 2 * across, HEIGHT + 2 * down)
    back = lens.to_original((whole - [across, down]).reshape(-1, 2)).reshape(at.shape)
    np.testing.assert_allclose(back, at, atol=1e-3)


def test_s_runs_right_and_t_runs_up_from_pixel_centres():
    lens = Lens(8, 4, (8.0, 8.0), (8.0, 8.0), (4.0, 2.0))
    st = undistort_map(lens, 16, 8)
    assert st.dtype == np.float32 and st.shape == (8, 16, 3)
    np.testing.assert_allclose(st[0, 0], [0.5 / 16, 1 - 0.5 / 8, 1.0], atol=1e-7)  # top left
    np.testing.assert_allclose(st[-1, -1], [1 - 0.5 / 16, 0.5 / 8, 1.0], atol=1e-7)
    np.testing.assert_array_equal(st, redistort_map(lens, 16, 8))
    half = redistort_map(lens, 8, 4, (0.5, 0.0))  # twice as wide, with the plate in the middle
    assert half[0, 0, 0] == pytest.approx((0.5 / 8 + 0.5) / 2) and half[0, 0, 1] == pytest.approx(1 - 0.5 / 4)


def wave(at):
    """Smooth 16-bit picture as a function of original pixels [..., 2]."""
    return 30000 + 14000 * np.sin(at[..., 0] / 11.0 + 0.4) * np.cos(at[..., 1] / 9.0) + 9000 * np.cos(at[..., 0] / 17.0)


def psnr(a, b):
    return -10.0 * np.log10(np.mean(((a - b) / 65535.0) ** 2))


@pytest.mark.parametrize("name", ["barrel", "strong barrel", "pincushion", "tangential"])
def test_a_plate_of_the_solve_comes_back_as_the_original_picture(colmap, shot_of, name):
    lens = load_lens(shot_of(name))
    original = wave(centres(WIDTH, HEIGHT))
    plate = Undistorter(colmap[name]["where"])(np.repeat(original[..., None], 3, axis=2).astype(np.uint16))[..., 0]
    at = pixels_of(redistort_map(lens, WIDTH, HEIGHT), WIDTH, HEIGHT)
    back = bilinear(plate.astype(float), at)
    seen = np.isfinite(back)
    assert 0.5 < seen.mean() < 1.0, "the plate alone lacks what the lens sees beyond it"
    assert psnr(back[seen], original[seen]) > 50.0


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("size", [(160, 120), (80, 60), (240, 180)])
def test_with_overscan_no_pixel_lacks_data(shot_of, name, size):
    """Frozen frames are rendered with overscan: here a formula gives the picture everywhere."""
    lens = load_lens(shot_of(name))
    width, height = size
    across, down = needed_margin(lens, width, height)
    assert (across, down) == (0, 0) if name == "none" else across + down > 0
    whole = (centres(width + 2 * across, height + 2 * down) - [across, down]) * (WIDTH / width)
    frozen = wave(lens.to_original(whole.reshape(-1, 2)).reshape(whole.shape))
    st = redistort_map(lens, WIDTH, HEIGHT, (across / width, down / height))
    assert st[..., :2].min() >= 0.0 and st[..., :2].max() <= 1.0
    back = bilinear(frozen, pixels_of(st, frozen.shape[1], frozen.shape[0]))
    # without a lens there is nothing beyond the plate, and a smaller frame's centres are farther inside
    if name != "none":
        assert np.isfinite(back).all()
    seen = np.isfinite(back)
    assert psnr(back[seen], wave(centres(WIDTH, HEIGHT))[seen]) > (45.0 if width >= WIDTH else 33.0)


def test_the_margin_is_no_larger_than_what_is_looked_at(shot_of):
    lens = load_lens(shot_of("strong barrel"))
    across, down = needed_margin(lens, WIDTH, HEIGHT)
    at = pixels_of(redistort_map(lens, WIDTH, HEIGHT), WIDTH, HEIGHT)
    assert across - 3 <= max(0.5 - at[..., 0].min(), at[..., 0].max() - WIDTH + 0.5) <= across - 2
    assert down - 3 <= max(0.5 - at[..., 1].min(), at[..., 1].max() - HEIGHT + 0.5) <= down - 2


@pytest.mark.parametrize(
    ("model", "extra"),
    [("SIMPLE_RADIAL", [-0.45]), ("OPENCV", [-0.6, 0.05, 0.0, 0.0]), ("RADIAL", [0.4, -0.9])],
)
def test_a_lens_that_folds_over_is_refused_in_words(tmp_path, model, extra):
    shot = solved(tmp_path, model, extra, 120.0, [118.0, 118.0, 80.0, 60.0])
    with pytest.raises(JobError, match="folds over") as refused:
        write_maps(shot)
    assert refused.value.exit_code == ExitCode.SOLVE and "Solve the camera again" in refused.value.hint
    assert not list(shot.solve.glob("*.exr"))


def test_a_fold_beyond_the_newton_start_is_not_taken_for_a_way_back():
    """Beyond the fold, another root of the cubic is a solution too, which shows the picture mirrored."""
    lens = Lens(160, 120, (130.0, 130.0), (70.0, 70.0), (80.0, 60.0), k1=-0.25)
    with pytest.raises(JobError, match="folds over"):
        lens.check()  # original pixels can be inverted, but the plate's corners are beyond the fold


def test_maps_are_written_as_float_and_come_back_bit_for_bit(shot_of):
    shot = shot_of("barrel")
    facts = write_maps(shot)
    lens = load_lens(shot)
    for name, expected in (("undistort", undistort_map(lens, 160, 120)), ("redistort", redistort_map(lens, 160, 120))):
        path = Path(facts[name])
        assert path == shot.solve / f"stmap_{name}.exr"
        buffer = oiio.ImageBuf(str(path))
        assert not buffer.spec().getattribute("DateTime"), "the same map is the same bytes"
        assert buffer.spec().channelnames == ("R", "G", "B") and str(buffer.spec().format) == "float"
        np.testing.assert_array_equal(buffer.get_pixels(oiio.FLOAT), expected)
    assert (facts["width"], facts["height"]) == (160, 120) and min(facts["overscan_percent"]) > 1.0
    wide = write_maps(shot, 320)
    assert (wide["width"], wide["height"]) == (320, 240)
    assert oiio.ImageBuf(wide["redistort"]).spec().width == 320
    with pytest.raises(JobError, match="5 pixels wide"):
        write_maps(shot, 5)


def test_a_solve_that_tells_no_lens_is_refused_in_words(tmp_path):
    shot = Shot.create(tmp_path / "new.splannequin")
    with pytest.raises(JobError, match="no cameras yet"):
        write_maps(shot)
    shot = solved(tmp_path, "SIMPLE_RADIAL", [], 100.0, [100.0, 100.0, 80.0, 60.0])
    with pytest.raises(JobError, match="SIMPLE_RADIAL with 0 numbers"):
        write_maps(shot)
    shot = solved(tmp_path, "OPENCV_FISHEYE", [0.1] * 4, 100.0, [100.0, 100.0, 80.0, 60.0])
    with pytest.raises(JobError, match="OPENCV_FISHEYE with 4 numbers"):
        write_maps(shot)
    shot = solved(tmp_path, "PINHOLE", [], 100.0, [100.0, 100.0, 80.0, 60.0], focal_px=None)
    with pytest.raises(JobError, match="has no lens"):
        write_maps(shot)
    shot = solved(tmp_path, "PINHOLE", [], 100.0, [100.0, 100.0, 80.0, 60.0])
    path = CameraPath.load(shot.solve / "cameras.json")
    path.frames[1].K[0] = 120.0
    write_json(shot.solve / "cameras.json", path.to_json())
    with pytest.raises(JobError, match="focal length changes"):
        write_maps(shot)


def test_overscan_in_percent_and_as_the_lens_needs(shot_of, tmp_path):
    shot = shot_of("barrel")
    lens = load_lens(shot)
    half_size = np.array([lens.intrinsics] * 2) / 2

    def of(overscan, Ks=half_size):
        return margin(shot, FreezeParams(overscan=overscan), 80, 60, Ks)

    assert of(0.0) == (0, 0)
    assert of(10.0) == (8, 6) and of(1.0) == (1, 1)
    assert of(-1.0) == needed_margin(lens, 80, 60) > (0, 0)
    enlarged = half_size * [1.2, 1.2, 1.0, 1.0]
    assert of(10.0, enlarged) == (8, 6), "a percentage needs no lens"
    with pytest.raises(JobError, match="another focal length"):
        of(-1.0, enlarged)
    with pytest.raises(JobError, match="150 percent"):
        of(150.0)
    with pytest.raises(JobError, match="nan percent"):
        of(float("nan"))
    path = TakeFolder(tmp_path).redistort
    assert write_take_map(shot, path, 80, 60, (8, 6), enlarged) is None and not path.exists()
    written = write_take_map(shot, path, 80, 60, (8, 6), half_size)
    assert written == path
    np.testing.assert_array_equal(
        oiio.ImageBuf(str(written)).get_pixels(oiio.FLOAT), redistort_map(lens, 160, 120, (0.1, 0.1))
    )


def test_the_command_line_writes_the_maps_or_says_why_not(shot_of, tmp_path, capsys):
    shot = shot_of("barrel")
    assert main(["stmaps", str(shot.root)]) == ExitCode.OK
    said = capsys.readouterr().out
    assert str(shot.solve / "stmap_redistort.exr") in said and "% of the width" in said
    assert main(["--json", "stmaps", str(shot.root), "--width", "40"]) == ExitCode.OK
    assert json.loads(capsys.readouterr().out)["height"] == 30
    empty = Shot.create(tmp_path / "empty.splannequin")
    assert main(["stmaps", str(empty.root)]) == ExitCode.SOLVE
    assert capsys.readouterr().err.startswith("Error: empty.splannequin has no cameras yet.")


@pytest.mark.parametrize(("text", "value"), [("lens", -1.0), ("12.5", 12.5), ("0", 0.0)])
def test_overscan_on_the_command_line(text, value):
    assert parser().parse_args(["take", "shot", "--overscan", text]).overscan == value


@pytest.mark.parametrize(
    ("size", "focal", "radial", "expected"),
    [
        ((1280, 720), (7526.0, 7526.0), (4.08,), "narrow"),
        ((720, 1280), (7526.0, 7526.0), (4.08,), "narrow"),
        ((640, 480), (100.0, 100.0), (0.0,), "wide"),
        ((640, 480), (float("nan"), float("nan")), (0.0,), "narrow"),
        ((640, 480), (-500.0, -500.0), (0.0,), "narrow"),
        ((1280, 720), (700.0, 700.0), (-0.6,), "bent"),
        ((1280, 720), (700.0, 700.0), (9.0,), "bent"),
        ((1280, 720), (700.0, 300.0), (0.0,), "bent"),
        # examples/sitting.mp4; a phone; a phone's tele; an action camera; a 135 mm lens; a rendered pinhole
        ((640, 480), (541.0, 541.0), (0.03,), ""),
        ((1280, 720), (940.0, 940.0), (0.05,), ""),
        ((720, 1280), (4300.0, 4300.0), (0.4,), ""),
        ((1280, 720), (700.0, 705.0), (-0.24, 0.05), ""),
        ((1920, 1080), (7200.0, 7200.0), (0.0,), ""),
        ((320, 240), (300.0, 300.0), (-0.06,), ""),
    ],
)
def test_a_lens_is_doubted_if_no_camera_has_it(size, focal, radial, expected):
    assert doubtful(*size, focal, *radial) == expected
