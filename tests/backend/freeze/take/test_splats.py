"""Exported splats and cameras of a take, read back and compared with its frames and depth."""

import json

import numpy as np
import pytest
import torch
from pxr import Usd, UsdGeom, UsdVol

from torch_backend.cameras.placement import Similarity
from torch_backend.cameras.stored import load_cameras
from torch_backend.contract import (
    CameraFrame,
    CameraPath,
    FreezeParams,
    JobError,
    Placement,
    UserError,
    file_digest,
    write_json,
)
from torch_backend.freeze import freeze_shot
from torch_backend.freeze.exr import read_frozen_exr
from torch_backend.freeze.take.splats import export_splats, write_stage
from torch_backend.freeze.usd import CAMERA, SPLATS
from torch_backend.gaussians.ply import PlyGaussians, read_ply
from torch_backend.raster import rasterize

TURNED = [0.0, -2.5, 0.0, 4.0, 0.0, 0.0, 2.5, 1.0, -2.5, 0.0, 0.0, 7.0, 0.0, 0.0, 0.0, 1.0]
"""Placement with a rotated and moved floor and a scale."""
SIZE = (64, 48)


def rendered(gaussians: PlyGaussians, viewmat: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(alpha [H, W], median depth [H, W]) of splats seen by a camera."""
    state = [torch.from_numpy(np.array(part)) for part in gaussians]
    seen = rasterize(
        *state[:4], sh=state[4], viewmats=torch.from_numpy(viewmat).float()[None], Ks=torch.from_numpy(K).float()[None],
        width=SIZE[0], height=SIZE[1], with_depth=True,
    )  # fmt: skip
    return seen.alphas[0].numpy(), seen.depth_median[0].numpy()


def camera_of(stage, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """(viewmat [4, 4] OpenCV, K [3, 3] for `SIZE`) of a stage's camera, from USD's frustum."""
    camera = UsdGeom.Camera.Get(stage, CAMERA).GetCamera(Usd.TimeCode(frame))
    viewmat = np.diag([1.0, -1.0, -1.0, 1.0]) @ np.array(camera.frustum.ComputeViewMatrix()).T
    window = np.array([tuple(camera.frustum.GetWindow().GetMin()), tuple(camera.frustum.GetWindow().GetMax())])
    (left, bottom), (right, top) = window
    fx, fy = SIZE[0] / (right - left), SIZE[1] / (top - bottom)
    return viewmat, np.array([[fx, 0, -left * fx], [0, fy, top * fy], [0, 0, 1]])


def splats_of(stage) -> PlyGaussians:
    field = UsdVol.ParticleField3DGaussianSplat.Get(stage, SPLATS)
    quats = [[q.GetReal(), *q.GetImaginary()] for q in field.GetOrientationsAttr().Get()]
    opacities = np.clip(np.array(field.GetOpacitiesAttr().Get(), np.float64), 1e-7, 1 - 1e-7)
    means = np.array(field.GetPositionsAttr().Get())
    sh = np.array(field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get()).reshape(len(means), -1, 3)
    scales = np.log(np.array(field.GetScalesAttr().Get()))
    logits = np.log(opacities / (1 - opacities))
    return PlyGaussians(*(np.asarray(a, np.float32) for a in (means, quats, scales, logits, sh)))


@pytest.fixture(scope="module")
def taken(trained, quiet):
    """The tiny shot with a splats-only take, frozen for a scene with a rotated floor and a scale."""
    shot = trained.shot
    write_json(shot.placement, Placement(TURNED, 0.01, file_digest(shot.cameras)).to_json())
    try:
        facts = freeze_shot(shot, FreezeParams(take="placed", t_star=108, step=5, detail="off", develop="off"), quiet())
    finally:
        shot.placement.unlink()
    return shot, facts


@pytest.mark.parametrize("kind", ["ply", "usd"])
def test_the_splats_of_a_take_lie_on_its_camera(taken, kind):
    """In the exported camera, means project to the solve's pixels, and the rendered depth equals the take's Z."""
    shot, facts = taken
    stage = Usd.Stage.Open(facts["usd"])
    splats = read_ply(facts["ply"]) if kind == "ply" else splats_of(stage)
    where, cameras = Similarity.of(Placement(TURNED)), load_cameras(shot)
    in_solve = where.inverse().points(splats.means)
    for number in (101, 111, 116):
        viewmat, K = camera_of(stage, number)
        frame = next(f for f in cameras.frames if f.frame == number)
        local = in_solve @ np.reshape(frame.viewmat, (4, 4))[:3, :3].T + np.reshape(frame.viewmat, (4, 4))[:3, 3]
        pixels = local[:, :2] / local[:, 2:] * frame.K[:2] + frame.K[2:]
        placed = splats.means @ viewmat[:3, :3].T + viewmat[:3, 3]
        found = placed[:, :2] / placed[:, 2:] * [K[0, 0], K[1, 1]] + K[:2, 2]
        alpha, depth = rendered(splats, viewmat, K)
        before = local[:, 2] > 0.1
        assert np.median(np.linalg.norm(found - pixels, axis=1)[before]) < 0.01, "pixels"
        image = read_frozen_exr(shot.take("placed") / f"{number:06d}.exr")
        solid = (alpha > 0.9) & (image.rgba[..., 3] > 0.9)
        assert solid.mean() > 0.5
        # Z is measured from the plates, the splats' depth from single Gaussians: medians agree better than single
        # pixels. Between neighbouring plates of 64 x 48 pixels, a parallax of 0.4 % is less than a hundredth of a
        # pixel.
        assert abs(np.median((depth / 2.5 / image.depth)[solid]) - 1.0) < 4e-3, "depth"


def test_both_files_hold_the_same_splats_and_the_take_says_where(taken):
    shot, facts = taken
    ply, usd = read_ply(facts["ply"]), splats_of(Usd.Stage.Open(facts["usd"]))
    np.testing.assert_array_equal(usd.means, ply.means)
    np.testing.assert_array_equal(usd.sh, ply.sh)
    np.testing.assert_allclose(usd.log_scales, ply.log_scales, atol=1e-5)
    placement = json.loads((shot.take("placed") / "take.json").read_text())["placement"]
    assert (placement["scene_from_solve"], placement["metres_per_unit"]) == (TURNED, 0.01)
    stage = Usd.Stage.Open(facts["usd"])
    assert UsdGeom.GetStageMetersPerUnit(stage) == 0.01 and stage.GetEndTimeCode() == 116


@pytest.mark.parametrize("kind", ["ply", "usd"])
def test_an_export_after_set_scale_places_the_take_anew(taken, tmp_path, kind):
    """The take is not frozen again; its splats are transformed."""
    shot, facts = taken
    file = tmp_path / "twice.json"
    write_json(file, Placement([2.0 * v for v in TURNED[:15]] + [1.0], 1.0).to_json())
    (written,) = export_splats(shot, kind, tmp_path / "out", "placed", str(file))
    was = read_ply(facts["ply"])
    now = read_ply(written) if kind == "ply" else splats_of(Usd.Stage.Open(str(written)))
    np.testing.assert_allclose(now.means, 2.0 * was.means, rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(now.log_scales, was.log_scales + np.log(2.0), atol=1e-4)
    np.testing.assert_allclose(now.sh, was.sh, atol=1e-5)


def test_a_take_of_an_earlier_version_is_placed_from_the_solves_axes(taken, tmp_path):
    shot, facts = taken
    path = shot.take("placed") / "take.json"
    kept = path.read_text()
    try:
        write_json(path, {k: v for k, v in facts.items() if k != "placement"})
        (written,) = export_splats(shot, "ply", tmp_path, "placed")
    finally:
        path.write_text(kept)
    was = read_ply(facts["ply"]).means
    np.testing.assert_allclose(read_ply(written).means, was[:, [0, 2, 1]] * [1, 1, -1], rtol=1e-6)


def test_the_stage_of_an_own_camera_holds_it_although_its_file_is_gone(trained, quiet, tmp_path):
    """The shot was moved, or the file belongs to another computer: the clip's camera would show another picture."""
    viewmat = trained.viewmats[7].clone()
    frames = []
    for n in (106, 107):
        viewmat[0, 3] += 0.3
        frames.append(CameraFrame(n, viewmat.flatten().tolist(), [80.0, 80.0, 30.0, 25.0], "blender"))
    write_json(tmp_path / "own.json", CameraPath(*SIZE, frames).to_json())
    params = FreezeParams(
        take="own", t_star=105, detail="off", develop="off", camera_path=str(tmp_path / "own.json"), width=SIZE[0]
    )
    before = camera_of(Usd.Stage.Open(freeze_shot(trained.shot, params, quiet())["usd"]), 107)
    (tmp_path / "own.json").unlink()
    (written,) = export_splats(trained.shot, "usd", tmp_path / "out", "own")
    stage = Usd.Stage.Open(str(written))
    for now, then in zip(camera_of(stage, 107), before, strict=True):
        np.testing.assert_allclose(now, then, rtol=1e-4, atol=1e-4)
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (106, 107)


@pytest.mark.parametrize("kind", ["ply", "usd"])
def test_a_take_of_a_former_solve_is_not_placed_with_the_new_one(taken, tmp_path, kind):
    shot, _ = taken
    kept = shot.cameras.read_text()
    solved = json.loads(kept)
    for frame in solved["frames"]:
        frame["viewmat"][3::4] = [1.3 * v for v in frame["viewmat"][3:12:4]] + [1.0]
    try:
        shot.cameras.write_text(json.dumps(solved))
        with pytest.raises(JobError, match="solved again"):
            export_splats(shot, kind, tmp_path, "placed")
    finally:
        shot.cameras.write_text(kept)
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_exported_is_said(taken, tmp_path):
    shot, _ = taken
    with pytest.raises(JobError, match="Take none of .* has no splats"):
        export_splats(shot, "ply", tmp_path, "none")
    with pytest.raises(UserError, match="format is"):
        export_splats(shot, "abc", tmp_path, "placed")


def test_an_environment_without_usd_freezes_all_the_same(taken, quiet, tmp_path, monkeypatch):
    """An environment of an earlier version lacks USD: a warning is shown, and an old stage file is removed."""
    shot, facts = taken

    def missing(name: str):
        raise ImportError(name)

    monkeypatch.setattr("torch_backend.freeze.usd.importlib.import_module", missing)
    (tmp_path / "frozen.usdc").write_bytes(b"old")
    report = quiet()
    splats_file = tmp_path / "frozen.usdc"
    write_stage(splats_file, read_ply(facts["ply"]), load_cameras(shot), Placement(), 25.0, report)
    assert not splats_file.exists() and "usd-core" in report.events[0][1]
    with pytest.raises(JobError, match="usd-core"):
        export_splats(shot, "usd", tmp_path, "placed")
