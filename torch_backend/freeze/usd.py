"""Writes splats and the animated camera as one USD stage, for Houdini, Solaris, Nuke, Omniverse and Blender.

The splats are a `ParticleField3DGaussianSplat` (OpenUSD 26.03; https://openusd.org/release/user_guides/schemas/usdVol/):
scales are linear, opacities between 0 and 1, harmonics grouped by particle, in the order and signs of 3DGS. Z is up.
Lengths are in units of the scene; the stage's `metersPerUnit` states their size.
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
NEAREST = 0.01
"""Distance at which the camera starts to see, as a share of the splats' median distance from it."""
REACH = 3.0
"""Radius of a Gaussian in the stage's extent, in standard deviations; 0.3 % of a Gaussian lies outside."""


class NoUsdError(RuntimeError):
    """Raised if the backend's environment has no usd-core, because an earlier version set it up."""


def write_usd(
    path: Path,
    gaussians: PlyGaussians | None,
    cameras: CameraPath,
    transform: Similarity,
    metres_per_unit: float,
    fps: float,
) -> Path:
    """Writes a stage (.usdc, .usda) atomically.

    Args:
        path: output file.
        gaussians: splats in the scene's axes and units; None: only the camera is written.
        cameras: the animated camera in solve units; its frame numbers become time codes of the stage.
        transform: similarity from solve units to the scene.
        metres_per_unit: length of a scene unit in metres.
        fps: frames per second.

    Returns:
        The path.

    Raises:
        NoUsdError: usd-core is not installed.
        OSError: the file cannot be written.
    """
    # importlib is used because usd-core has no type stubs; all its names become Any.
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
            camera: Any = UsdGeom.Camera.Define(stage, CAMERA)
            _add_camera(camera, Gf, cameras, transform, metres_per_unit)
            if gaussians is not None:
                _add_clipping(camera, Gf, cameras, transform, gaussians)
                _add_splats(UsdVol.ParticleField3DGaussianSplat.Define(stage, SPLATS), Vt, gaussians)
            written = layer.Export(str(partial), args={"format": path.suffix.removeprefix(".")})
        except Tf.ErrorException as error:
            raise write_error(str(error), path, _size_of(gaussians)) from error
        if not written:
            raise write_error("", path, _size_of(gaussians))
    return path


def _size_of(gaussians: PlyGaussians | None) -> int:
    """Approximate lower bound of a stage's size in bytes, plus one disk block."""
    return 4096 + (0 if gaussians is None else gaussians.means.nbytes + gaussians.sh.nbytes)


def _describe(stage: Any, geometry: Any, cameras: CameraPath, metres_per_unit: float, fps: float) -> None:
    geometry.SetStageUpAxis(stage, geometry.Tokens.z)
    geometry.SetStageMetersPerUnit(stage, metres_per_unit)
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)
    stage.SetStartTimeCode(cameras.frames[0].frame)
    stage.SetEndTimeCode(cameras.frames[-1].frame)


def _add_camera(camera: Any, vectors: Any, path: CameraPath, transform: Similarity, metres_per_unit: float) -> None:
    """Adds keys for every frame of the path to a camera. USD film backs are in tenths of a stage unit."""
    per_mm = 0.01 / metres_per_unit
    to_world = camera_to_world(transform.viewmats(path_viewmats(path)))
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
        turns.Set(vectors.Matrix4d(*matrix.T.ravel().tolist()), frame.frame)  # USD uses row vectors
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


def _add_clipping(
    camera: Any, vectors: Any, path: CameraPath, transform: Similarity, gaussians: PlyGaussians
) -> None:  # fmt: skip
    """Sets the range of distances that a camera sees. USD's default starts at one unit, which hides what is nearer."""
    centres = camera_to_world(transform.viewmats(path_viewmats(path)))[:, :3, 3]
    distances = np.linalg.norm(gaussians.means - centres.mean(axis=0), axis=1)
    if len(distances) and np.median(distances) > 0.0:
        far = 2.0 * (distances.max() + np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
        camera.CreateClippingRangeAttr(vectors.Vec2f(float(NEAREST * np.median(distances)), float(far)))


def _add_splats(field: Any, arrays: Any, gaussians: PlyGaussians) -> None:
    """Writes Gaussians to a particle field."""
    count, bases = gaussians.sh.shape[:2]
    scales = np.exp(gaussians.log_scales)
    quats = gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    opacities = 1.0 / (1.0 + np.exp(-gaussians.opacity_logits.astype(np.float64)))
    field.CreatePositionsAttr(arrays.Vec3fArray.FromNumpy(_packed(gaussians.means)))
    field.CreateOrientationsAttr(arrays.QuatfArray.FromNumpy(_packed(quats[:, [1, 2, 3, 0]])))  # USD stores xyzw
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
