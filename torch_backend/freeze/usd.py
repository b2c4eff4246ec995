"""Splats and the animated camera as one USD stage, for Houdini, Solaris, Nuke, Omniverse and Blender.

The splats are a `ParticleField3DGaussianSplat` (OpenUSD 26.03; https://openusd.org/release/user_guides/schemas/usdVol/):
scales are linear, opacities between 0 and 1, harmonics grouped by particle, in the order and signs of 3DGS. Z is up;
lengths are the scene's, and the stage says how many metres one is.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cameras.placement import SENSOR_MM, Similarity, camera_to_world, lens_of, path_viewmats
from ..contract import CameraPath
from ..gaussians.ply import PlyGaussians
from ..shot import atomic_path
from .exr import write_error

ROOT, SPLATS, CAMERA = "/frozen", "/frozen/splats", "/frozen/camera"
"""Paths of the prims."""
REACH = 3.0
"""Standard deviations of a Gaussian that the stage's extent counts in: 0.3 % of it lie beyond."""


class NoUsdError(RuntimeError):
    """The backend's environment has no usd-core: it was set up by an earlier version."""


def write_usd(
    path: Path,
    gaussians: PlyGaussians | None,
    cameras: CameraPath,
    where: Similarity,
    metres_per_unit: float,
    fps: float,
) -> Path:
    """Writes a stage (.usdc, .usda) beside its place, then renames it.

    Args:
        path: file.
        gaussians: in the scene's axes and units already; None: the camera alone.
        cameras: the animated camera in solve units; its frame numbers are the stage's time codes.
        where: from solve units to the scene.
        metres_per_unit: length in metres of a unit of the scene.
        fps: frames per second.

    Returns:
        The path.

    Raises:
        NoUsdError: usd-core is not installed.
        OSError: the file cannot be written.
    """
    # Through importlib: usd-core has no types, so everything of it is Any.
    try:
        Gf, Sdf, Tf, Usd, UsdGeom, UsdVol, Vt = (
            importlib.import_module(f"pxr.{name}") for name in ("Gf", "Sdf", "Tf", "Usd", "UsdGeom", "UsdVol", "Vt")
        )
    except ImportError as error:
        raise NoUsdError(str(error)) from error
    with atomic_path(path) as partial:
        try:
            layer: Any = Sdf.Layer.CreateAnonymous(path.suffix)  # a layer of that path may be open in this process
            stage: Any = Usd.Stage.Open(layer)
            _describe(stage, UsdGeom, cameras, metres_per_unit, fps)
            stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, ROOT).GetPrim())
            _add_camera(UsdGeom.Camera.Define(stage, CAMERA), Gf, cameras, where, metres_per_unit)
            if gaussians is not None:
                _add_splats(UsdVol.ParticleField3DGaussianSplat.Define(stage, SPLATS), Vt, gaussians)
            written = layer.Export(str(partial), args={"format": path.suffix.removeprefix(".")})
        except Tf.ErrorException as error:
            raise write_error(str(error), path, _size_of(gaussians)) from error
        if not written:
            raise write_error("", path, _size_of(gaussians))
    return path


def _size_of(gaussians: PlyGaussians | None) -> int:
    """Bytes that a stage takes at least, about; one block of a disk more."""
    return 4096 + (0 if gaussians is None else gaussians.means.nbytes + gaussians.sh.nbytes)


def _describe(stage: Any, geometry: Any, cameras: CameraPath, metres_per_unit: float, fps: float) -> None:
    geometry.SetStageUpAxis(stage, geometry.Tokens.z)
    geometry.SetStageMetersPerUnit(stage, metres_per_unit)
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)
    stage.SetStartTimeCode(cameras.frames[0].frame)
    stage.SetEndTimeCode(cameras.frames[-1].frame)


def _add_camera(camera: Any, vectors: Any, path: CameraPath, where: Similarity, metres_per_unit: float) -> None:
    """Keys a camera on every frame of the path. Film backs of USD are in tenths of a stage unit, whatever it is."""
    per_mm = 0.01 / metres_per_unit
    to_world = camera_to_world(where.viewmats(path_viewmats(path)))
    turns = camera.AddTransformOp()
    varying = {
        "focalLength": camera.CreateFocalLengthAttr(),
        "horizontalApertureOffset": camera.CreateHorizontalApertureOffsetAttr(),
        "verticalApertureOffset": camera.CreateVerticalApertureOffsetAttr(),
        "verticalAperture": camera.CreateVerticalApertureAttr(),
    }
    camera.CreateHorizontalApertureAttr(SENSOR_MM * per_mm)
    lenses = [lens_of(frame.K, path.width, path.height) for frame in path.frames]
    is_fixed = all(lens == lenses[0] for lens in lenses)
    for frame, matrix, lens in zip(path.frames, to_world, lenses, strict=True):
        turns.Set(vectors.Matrix4d(*matrix.T.ravel().tolist()), frame.frame)  # USD multiplies rows
        if is_fixed and frame is not path.frames[0]:
            continue
        values = {
            "focalLength": lens.focal_mm,
            "horizontalApertureOffset": lens.shift_x * SENSOR_MM,
            "verticalApertureOffset": lens.shift_y * SENSOR_MM,
            "verticalAperture": lens.sensor_height_mm,
        }
        for name, value in values.items():
            varying[name].Set(value * per_mm, *([] if is_fixed else [frame.frame]))


def _add_splats(field: Any, arrays: Any, gaussians: PlyGaussians) -> None:
    """Fills a particle field."""
    count, bases = gaussians.sh.shape[:2]
    scales = np.exp(gaussians.log_scales)
    quats = gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    opacities = 1.0 / (1.0 + np.exp(-gaussians.opacity_logits.astype(np.float64)))
    field.CreatePositionsAttr(arrays.Vec3fArray.FromNumpy(_packed(gaussians.means)))
    field.CreateOrientationsAttr(arrays.QuatfArray.FromNumpy(_packed(quats[:, [1, 2, 3, 0]])))  # in memory xyzw
    field.CreateScalesAttr(arrays.Vec3fArray.FromNumpy(_packed(scales)))
    field.CreateOpacitiesAttr(arrays.FloatArray.FromNumpy(_packed(opacities)))
    field.CreateRadianceSphericalHarmonicsDegreeAttr(round(bases**0.5) - 1)
    field.CreateRadianceSphericalHarmonicsCoefficientsAttr(
        arrays.Vec3fArray.FromNumpy(_packed(gaussians.sh.reshape(count * bases, 3)))
    )
    reach = REACH * scales.max(axis=1, keepdims=True)
    if count:
        ends = (gaussians.means - reach).min(axis=0), (gaussians.means + reach).max(axis=0)
        field.CreateExtentAttr(arrays.Vec3fArray.FromNumpy(_packed(np.array(ends))))


def _packed(values: NDArray[Any]) -> NDArray[np.float32]:
    return np.ascontiguousarray(values, dtype=np.float32)
