"""The USD stage, read back by usd-core: its splats equal the Gaussians, its camera projects like the solve's."""

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdVol

from torch_backend.cameras.placement import Similarity, path_viewmats
from torch_backend.contract import CameraFrame, CameraPath, Placement
from torch_backend.freeze import usd
from torch_backend.freeze.placed import placed
from torch_backend.freeze.usd import CAMERA, ROOT, SPLATS, write_usd
from torch_backend.gaussians.ply import PlyGaussians

WHERE = Similarity.of(Placement([0.0, -2.5, 0.0, 4.0, 0.0, 0.0, 2.5, 1.0, -2.5, 0.0, 0.0, 7.0, 0.0, 0.0, 0.0, 1.0]))


def cloud(count: int, degree: int) -> PlyGaussians:
    chance, bases = np.random.default_rng(degree), (degree + 1) ** 2
    arrays = [chance.standard_normal((count, *shape)) for shape in ((3,), (4,), (3,), (), (bases, 3))]
    return PlyGaussians(*(array.astype(np.float32) for array in arrays))


def path(varies: bool = False) -> CameraPath:
    frames = []
    for n in range(4):
        c, s = np.cos(0.1 * n), np.sin(0.1 * n)
        viewmat = [c, 0, s, 0.1 * n, 0, 1, 0, 0.2, -s, 0, c, 0.3, 0, 0, 0, 1]
        frames.append(CameraFrame(101 + n, viewmat, [900.0 + (10 * n if varies else 0), 880.0, 610.0, 350.0]))
    return CameraPath(1280, 720, frames)


@pytest.mark.parametrize("ending", [".usdc", ".usda"])
@pytest.mark.parametrize("degree", [0, 3])
def test_the_splats_are_the_gaussians(tmp_path, ending, degree):
    was = cloud(30, degree)
    file = write_usd(tmp_path / "Größe" / f"frozen{ending}", was, path(), WHERE, 0.01, 25.0)
    assert [p.name for p in file.parent.iterdir()] == [file.name]
    assert file.read_bytes().startswith(b"PXR-USDC") == (ending == ".usdc")
    stage = Usd.Stage.Open(str(file))
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Z", 0.01)
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (101, 104, 25)
    assert str(stage.GetDefaultPrim().GetPath()) == ROOT
    prim = stage.GetPrimAtPath(SPLATS)
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat" and prim.IsA(UsdVol.ParticleField)
    field = UsdVol.ParticleField3DGaussianSplat(prim)
    np.testing.assert_array_equal(np.array(field.GetPositionsAttr().Get()), was.means)
    np.testing.assert_allclose(np.array(field.GetScalesAttr().Get()), np.exp(was.log_scales), rtol=1e-6)
    np.testing.assert_allclose(
        np.array(field.GetOpacitiesAttr().Get()), 1 / (1 + np.exp(-was.opacity_logits)), rtol=1e-6
    )
    quats = np.array([[q.GetReal(), *q.GetImaginary()] for q in field.GetOrientationsAttr().Get()])
    np.testing.assert_allclose(quats, was.quats / np.linalg.norm(was.quats, axis=1, keepdims=True), atol=1e-6)
    assert field.GetRadianceSphericalHarmonicsDegreeAttr().Get() == degree
    sh = np.array(field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get()).reshape(was.sh.shape)
    np.testing.assert_array_equal(sh, was.sh)
    low, high = np.array(field.GetExtentAttr().Get())
    assert (was.means > low).all() and (was.means < high).all()
    for name in ("positions", "opacities", "radiance:sphericalHarmonicsCoefficients"):
        assert prim.GetAttribute(name).IsAuthored() and not prim.GetAttribute(name).IsCustom()


def seen(camera, frame: int, points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Pixels [P, 2] of points by USD's GfCamera frustum, y down, pixel centres at +0.5."""
    frustum = camera.GetCamera(Usd.TimeCode(frame)).frustum
    matrix = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
    ndc = np.array([tuple(matrix.Transform(Gf.Vec3d(*map(float, p)))) for p in points])
    return (ndc[:, :2] * [0.5, -0.5] + 0.5) * size


def test_the_camera_sees_splats_in_small_units(tmp_path):
    """The nearest splats are 0.2 units away. USD's default hides what is nearer than 1 unit."""
    small = Similarity(WHERE.rotation, 0.01, WHERE.translation)
    means = np.random.default_rng(1).uniform([-10, -10, 20], [10, 10, 40], (200, 3))
    splats = placed(cloud(200, 0)._replace(means=means), small)
    stage = Usd.Stage.Open(str(write_usd(tmp_path / "a.usdc", splats, path(), small, 1.0, 24.0)))
    frustum = UsdGeom.Camera.Get(stage, CAMERA).GetCamera(Usd.TimeCode(102)).frustum
    depths = [-frustum.ComputeViewMatrix().Transform(Gf.Vec3d(*map(float, p)))[2] for p in splats.means]
    assert 0.1 < min(depths) < 0.3
    assert frustum.nearFar.min < min(depths) and frustum.nearFar.max > max(depths)


@pytest.mark.parametrize("varies", [False, True])
@pytest.mark.parametrize("metres", [1.0, 0.01])
def test_the_camera_sees_what_the_solve_saw(tmp_path, varies, metres):
    cameras, points = path(varies), np.random.default_rng(2).normal([0, 0, 9], 1.0, (40, 3))
    stage = Usd.Stage.Open(str(write_usd(tmp_path / "a.usdc", None, cameras, WHERE, metres, 24.0)))
    assert not stage.GetPrimAtPath(SPLATS), "none were handed over"
    camera = UsdGeom.Camera.Get(stage, CAMERA)
    for frame, viewmat in zip(cameras.frames, path_viewmats(cameras), strict=True):
        local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
        fx, fy, cx, cy = frame.K
        truth = np.stack([fx * local[:, 0] / local[:, 2] + cx, fy * local[:, 1] / local[:, 2] + cy], 1)
        np.testing.assert_allclose(seen(camera, frame.frame, WHERE.points(points), (1280, 720)), truth, atol=2e-3)
    # Film backs are in tenths of a stage unit: 36 mm are 0.36 if the unit is a metre, 36 if it is a centimetre.
    assert camera.GetHorizontalApertureAttr().Get() == pytest.approx(0.36 / metres)
    assert len(camera.GetFocalLengthAttr().GetTimeSamples()) == (4 if varies else 0)


def test_missing_usd_gives_a_readable_error(tmp_path, monkeypatch):
    def missing(name: str):
        raise ImportError(f"No module named {name}")

    monkeypatch.setattr(usd.importlib, "import_module", missing)
    with pytest.raises(usd.NoUsdError, match="pxr"):
        write_usd(tmp_path / "a.usdc", None, path(), WHERE, 1.0, 24.0)
    assert list(tmp_path.iterdir()) == []
