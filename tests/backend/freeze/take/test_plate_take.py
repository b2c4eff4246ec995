"""Files of takes composited from plates: the files beside the frames, resuming after a kill, light above white."""

import dataclasses
import hashlib
import json

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from scipy.ndimage import binary_dilation, binary_erosion

from tests.backend.conftest import film
from torch_backend.contract import CameraFrame, CameraPath, FreezeParams, TrainParams
from torch_backend.footage.color import InputSpace, linear_to_srgb
from torch_backend.footage.display import ROLLED
from torch_backend.footage.images import read_png
from torch_backend.footage.plates import Plates
from torch_backend.freeze import freeze_shot
from torch_backend.freeze.composite.state import StateConfig, rejection
from torch_backend.freeze.composite.warp import apply_warp, read_warp
from torch_backend.freeze.exr import read_frozen_exr, read_key
from torch_backend.freeze.take import frames as take_frames
from torch_backend.freeze.take.plan import planned
from torch_backend.motion.mattes import PAINTED, STILL, write_matte
from torch_backend.shot import write_json
from torch_backend.train import train_shot

RANGE = {"t_star": 105, "first": 103, "last": 108}


def digest(path):
    """Digest of a picture's pixels and metadata without the time of writing."""
    image = oiio.ImageBuf(str(path))
    lines = image.spec().serialize("text", "detailed").splitlines()
    lines = [line for line in lines if not line.strip().startswith(("DateTime", "oiio:SourcePath"))]
    return hashlib.sha256(image.get_pixels(oiio.FLOAT).tobytes() + str(lines).encode()).hexdigest()


def files(folder):
    """Digests of a take's frames, warps and previews by relative path."""
    found = [*folder.glob("*.exr"), *(folder / "warp").glob("*.exr"), *(folder / "preview").glob("*.png")]
    return {str(path.relative_to(folder)): digest(path) for path in found}


@pytest.fixture(scope="module")
def take(trained, quiet):
    facts = freeze_shot(trained.shot, FreezeParams(take="whole", **RANGE), quiet())
    return trained.shot.take("whole"), facts


def test_terms_behind_a_frame_are_its_decisions(trained, take, tmp_path, quiet):
    """With `--debug-terms`, the frames are rendered again without change, and the log-odds reproduce the matte."""
    before = files(take[0])
    ask = dict(RANGE, last=103, only_missing=True, debug_terms=str(tmp_path))
    freeze_shot(trained.shot, FreezeParams(take="whole", **ask), quiet())
    assert files(take[0]) == before
    config = StateConfig()
    image = oiio.ImageBuf(str(*tmp_path.iterdir()))
    terms = dict(zip(image.spec().channelnames, np.moveaxis(image.get_pixels(oiio.FLOAT), 2, 0), strict=True))
    assert {"plate_matte", "change", "unseen", "agreed.105", "origin.develop"} <= terms.keys()
    matte = read_warp(take[0] / "warp" / "000103.exr").matte
    kept = 1.0 - rejection(torch.from_numpy(terms["log_odds"]), config)
    assert kept.shape == matte.shape and float(kept.min()) < 0.1 < float(kept.max())
    np.testing.assert_allclose(np.asarray(matte), kept, atol=0.01)
    assert 0.02 < terms["origin.develop"].mean() <= 1.0


def test_a_frame_is_its_warp_over_the_plate(trained, take):
    folder, facts = take
    plates = Plates(trained.shot)
    assert facts["warp_dir"] == str(folder / "warp")
    for n in range(103, 109):
        frame, warp = read_frozen_exr(folder / f"{n:06d}.exr"), read_warp(folder / "warp" / f"{n:06d}.exr")
        np.testing.assert_allclose(apply_warp(plates.linear(n), warp), frame.rgba[..., :3], atol=1e-3)
        assert warp.metadata.key == frame.metadata.key and warp.metadata.primary == n
        still = frame.detail.plate == 1.0
        assert still.mean() > 0.5
    rows = facts["detail"]["per_frame"]
    assert [row["frame"] for row in rows] == list(range(103, 109))
    assert facts["detail"]["plate_share"] == pytest.approx(np.mean([row["plate_share"] for row in rows]), abs=1e-3)
    assert all(np.mean(row["regions"]) == pytest.approx(row["invented_share"], abs=0.02) for row in rows)
    assert rows[2]["plate_share"] > 0.999, "frame 105 is its plate"  # one pixel of 3072 may come from another plate


def test_without_detail_only_splats_are_rendered(trained, take, quiet):
    folder, _ = take
    part = dict(RANGE, first=107)
    facts = freeze_shot(trained.shot, FreezeParams(take="bare", **part, detail="off"), quiet())
    bare = trained.shot.take("bare")
    assert not (bare / "warp").exists() and "detail" not in facts and "warp_dir" not in facts
    for n in (107, 108):
        plain, detailed = read_frozen_exr(bare / f"{n:06d}.exr"), read_frozen_exr(folder / f"{n:06d}.exr")
        assert plain.detail is None
        splat = np.asarray(detailed.detail.splat)[..., :3]
        np.testing.assert_allclose(splat, plain.rgba[..., :3], rtol=4e-3, atol=1e-4)
    freeze_shot(trained.shot, FreezeParams(take="bare", **part, only_missing=True), quiet())
    with_plates, whole = files(bare), files(folder)
    assert len(with_plates) == 6, "asked for plates, none of the old frames is right"
    assert all(whole[name] == content for name, content in with_plates.items()), "nor does the range matter"
    freeze_shot(trained.shot, FreezeParams(take="bare", **part, only_missing=True, detail="off"), quiet())
    assert not list((bare / "warp").glob("*.exr")), "warps of frames that are gone are gone"


class Killed(BaseException):
    """Ends a take like a kill."""


def test_a_killed_take_goes_on_to_the_same_files(trained, take, quiet, monkeypatch):
    """The take was killed after it had written a warp but not its frame."""
    ask, write = FreezeParams(take="killed", **{**RANGE, "last": 105}, only_missing=True), take_frames._write_frame

    def dies(folder, output, *rest):
        if output.frame == 104:
            raise Killed
        return write(folder, output, *rest)

    with monkeypatch.context() as patched, pytest.raises(Killed):
        patched.setattr(take_frames, "_write_frame", dies)
        freeze_shot(trained.shot, ask, quiet())
    folder = trained.shot.take("killed")
    left = {path.name: path.stat().st_mtime_ns for path in folder.glob("*.exr")}
    assert sorted(left) == ["000103.exr"]
    assert (folder / "warp" / "000104.exr").is_file()
    freeze_shot(trained.shot, ask, quiet())
    finished, whole = files(folder), files(take[0])
    assert len(finished) == 9 and all(whole[name] == content for name, content in finished.items())
    assert all((folder / n).stat().st_mtime_ns == time for n, time in left.items())
    rows = [json.loads((f / "take.json").read_text())["detail"]["per_frame"] for f in (folder, take[0])]
    assert rows[0][1:] == rows[1][1:3]
    assert rows[0][0]["plate_share"] == pytest.approx(rows[1][0]["plate_share"], abs=2e-3)


@pytest.mark.parametrize("detail", ["on", "off"])
def test_a_painted_matte_makes_frames_stale(trained, quiet, detail):
    """Without detail, the mattes still decide where plates measure a frame's depth."""
    ask = FreezeParams(take="painted", detail=detail, develop="off", t_star=105, first=110, last=110, only_missing=True)
    path = trained.shot.root / PAINTED / "000110.png"
    before = path.read_bytes()
    try:
        keys = []
        for _ in range(2):
            freeze_shot(trained.shot, ask, quiet())
            keys.append(read_key(trained.shot.take("painted") / "000110.exr"))
            write_matte(path, np.full((48, 64), STILL, np.uint8))
        assert keys[0] != keys[1]
    finally:
        path.write_bytes(before)


def test_a_zoom_reads_plates_as_fine_as_its_longest_lens(trained, quiet, tmp_path):
    widths = []
    for focals in ((30.0, 30.0), (30.0, 90.0), (90.0, 30.0)):
        pose = trained.viewmats[7].flatten().tolist()
        frames = [CameraFrame(n, pose, [f, f, 32.0, 24.0], "blender") for n, f in enumerate(focals, 1)]
        write_json(tmp_path / "zoom.json", CameraPath(64, 48, frames).to_json())
        params = FreezeParams(take="zoom", develop="off", t_star=108, camera_path=str(tmp_path / "zoom.json"))
        widths.append(planned(trained.shot, params, quiet()).spec.detail.plates.width)
    assert widths == [32, 64, 64]


def test_a_ramp_that_runs_is_the_clip(trained, quiet):
    """In frames at their own instant, pixels equal the plate up to half-float rounding. Later frames stay at 105."""
    ramp = {str(n): float(min(n, 105)) for n in range(101, 117)}
    part = dict(t_star_per_frame=ramp, first=104, last=106, develop="off")
    freeze_shot(trained.shot, FreezeParams(take="runs", **part), quiet())
    plates = Plates(trained.shot)
    for n in (104, 105):
        frame = read_frozen_exr(trained.shot.take("runs") / f"{n:06d}.exr")
        np.testing.assert_allclose(frame.rgba[..., :3], plates.linear(n), rtol=1e-3, atol=1e-6)
    frozen = read_frozen_exr(trained.shot.take("runs") / "000106.exr")
    assert frozen.metadata.t_star_frame == 105.0 and (frozen.detail.source == 105).any()


@pytest.fixture(scope="module")
def bright(tmp_path_factory, world, quiet):
    """(shot, its frame 103, the warp of this frame): a static wall in half-float EXR at twice the size of the solve,
    with lamps of 50 and values below black."""
    rng = np.random.default_rng(4)
    lamps = [(int(y), int(x)) for y, x in rng.integers(4, 60, (12, 2))]

    def picture_of(n):
        small = world.image(n, 0.0).numpy().astype(np.float32) ** 2.2
        picture = np.kron(small, np.ones((2, 2, 1), np.float32)) * rng.uniform(0.9, 1.1, (96, 128, 1))
        for k, (y, x) in enumerate(lamps):
            picture[y : y + 2, x : x + 2] = [50.0, 12.0, -0.02 * k]
        return picture.astype(np.float16)

    shot = film(world, tmp_path_factory.mktemp("bright"), picture_of, working_height=48)
    train_shot(shot, TrainParams(iterations=60, max_gaussians=900), quiet())
    facts = freeze_shot(shot, FreezeParams(t_star=108, first=103, last=103, develop="off"), quiet())
    assert (facts["width"], facts["height"]) == (128, 96)
    folder = shot.take("freeze")
    return shot, read_frozen_exr(folder / "000103.exr"), read_warp(folder / "warp" / "000103.exr")


def test_light_beyond_white_and_below_black_is_the_plates(bright):
    shot, frame, warp = bright
    source = oiio.ImageBuf(str(shot.root.parent / "source" / "a.103.exr")).get_pixels(oiio.FLOAT)
    still = warp.matte.numpy() == 1.0
    assert still.mean() > 0.9 and source[still].max() == 50.0 and source[still].min() < -0.05
    np.testing.assert_allclose(frame.rgba[..., :3][still], source[still], rtol=1e-3, atol=1e-6)
    graded = torch.from_numpy(source) * torch.tensor([2.0, 0.5, 1.0])
    again = apply_warp(graded, warp).numpy()
    np.testing.assert_allclose(again[still], graded.numpy()[still], rtol=1e-3, atol=1e-6)


def test_acescg_footage_is_frozen_in_acescg(bright, quiet):
    """The record declares the footage as ACEScg: frames and warps are written in ACEScg, and stale ones are
    replaced."""
    shot, plain, plain_warp = bright
    folder, record = shot.take("freeze"), json.loads(shot.listing.read_text())
    shot.listing.write_text(json.dumps({**record, "reading": {**record["reading"], "light": "ap1"}}))
    freeze_shot(shot, FreezeParams(t_star=108, first=103, last=103, develop="off", only_missing=True), quiet())
    for file, fill in (("000103.exr", plain.rgba[..., :3]), ("warp/000103.exr", plain_warp.fill.numpy())):
        image = oiio.ImageBuf(str(folder / file))
        assert image.spec().getattribute("oiio:ColorSpace") == "lin_ap1_scene"
        stored = np.asarray(image.get_pixels(oiio.FLOAT))[..., :3]
        expected = InputSpace("lin", "ap1").to_linear(stored)
        assert np.abs(expected - fill).max() < 1e-3 * max(1.0, np.abs(fill).max())
    again = read_frozen_exr(folder / "000103.exr")
    np.testing.assert_allclose(again.rgba, plain.rgba, atol=0.05)
    assert again.metadata.light == "ap1" and again.metadata.key != plain.metadata.key


LAMP = 20.0


@pytest.fixture(scope="module")
def lit(tmp_path_factory, world, quiet):
    """Trained shot of the wall in scene-linear EXR; its patch is a static lamp."""

    def picture_of(n):
        picture = (0.8 * world.image(n, 0.0).numpy()) ** 2.2
        picture[world.patch(n, 0.0) > 0.5] = LAMP
        return picture.astype(np.float16)

    shot = film(world, tmp_path_factory.mktemp("lit"), picture_of)
    train_shot(shot, TrainParams(iterations=300, max_gaussians=1500, method="static"), quiet())
    return shot


def test_highlights_are_kept_in_splats_without_detail(lit, quiet):
    """Frames clipped at white could not exceed 1. Pixels away from the lamp are unchanged."""
    facts = freeze_shot(lit, FreezeParams(t_star=108, first=106, last=106, detail="off", develop="off"), quiet())
    frame = read_frozen_exr(lit.take("freeze") / "000106.exr")
    source = oiio.ImageBuf(str(lit.root.parent / "source" / "a.106.exr")).get_pixels(oiio.FLOAT)
    inside = binary_erosion(source[..., 1] > 10.0)
    far = ~binary_dilation(source[..., 1] > 10.0, iterations=4)
    assert inside.sum() > 20 and far.sum() > 1000
    assert np.median(frame.rgba[..., :3][inside]) == pytest.approx(LAMP, rel=0.3)
    difference = linear_to_srgb(frame.rgba[..., :3][far]) - linear_to_srgb(source[far])
    assert np.abs(difference).mean() < 0.03 and frame.rgba[..., :3][far].max() < 2.0
    assert frame.rgba.max() < 1.01 * LAMP
    assert np.abs(frame.grain[inside]).max() < 0.1, "grain is not what a lamp flickers by"
    preview = read_png(lit.take("freeze") / "preview" / "000106.png") / 255.0
    shown = ROLLED.from_light(frame.rgba[..., :3])
    assert facts["grain"] is not None and np.abs(preview - shown)[far].max() < 1.5 / 255
    assert 0.9 < np.median(preview[inside]) < 1.0


def test_a_lamp_that_plates_fill_stays_a_lamp(lit, quiet):
    """The camera is between two frames of the clip, so every plate is resampled."""
    path = CameraPath.from_json(json.loads((lit.solve / "cameras.json").read_text()))
    before, after = (np.array(path.frames[n].viewmat) for n in (5, 6))
    between = dataclasses.replace(path.frames[5], viewmat=(0.5 * (before + after)).tolist())
    camera = lit.root / "between.json"
    camera.write_text(json.dumps(dataclasses.replace(path, frames=[between]).to_json()))
    ask = FreezeParams(take="between", t_star=108, camera_path=str(camera), width=64, develop="off", grain=False)
    freeze_shot(lit, ask, quiet())
    frame = read_frozen_exr(lit.take("between") / "000106.exr").rgba[..., :3]
    assert frame.max() == pytest.approx(LAMP, rel=0.01)
    assert 0.5 < (frame > 10.0).sum() / (_lamp_of(lit, 106) + _lamp_of(lit, 107)) / 0.5 < 1.5


def _lamp_of(shot, frame):
    source = oiio.ImageBuf(str(shot.root.parent / "source" / f"a.{frame}.exr")).get_pixels(oiio.FLOAT)
    return (source > 10.0).sum()
