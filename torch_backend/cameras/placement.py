"""Transforms points and cameras of a solve to the axes and units of a scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..contract import CAMERAS_FILE, CameraPath, Placement, UserError, file_digest
from ..shot import Shot


@dataclass(frozen=True)
class Similarity:
    """x -> scale * rotation @ x + translation."""

    rotation: NDArray[np.float64]
    """[3, 3], orthonormal, determinant 1."""
    scale: float
    """Above 0."""
    translation: NDArray[np.float64]
    """[3]."""

    @staticmethod
    def of(placement: Placement) -> Similarity:
        """The similarity from solve units to scene units, with an orthonormal rotation."""
        matrix = np.array(placement.scene_from_solve, np.float64).reshape(4, 4)
        # Blender's matrices are float32: this makes the rotation orthonormal to float64 precision.
        left, _, right = np.linalg.svd(matrix[:3, :3])
        return Similarity(left @ right, placement.scale, matrix[:3, 3])

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The similarity as a homogeneous matrix [4, 4]."""
        result = np.eye(4)
        result[:3, :3], result[:3, 3] = self.scale * self.rotation, self.translation
        return result

    def after(self, first: Similarity) -> Similarity:
        """The composition that applies `first`, then this similarity."""
        return Similarity(
            self.rotation @ first.rotation,
            self.scale * first.scale,
            self.scale * self.rotation @ first.translation + self.translation,
        )

    def inverse(self) -> Similarity:
        """The inverse similarity."""
        return Similarity(self.rotation.T, 1.0 / self.scale, -self.rotation.T @ self.translation / self.scale)

    def points(self, xyz: NDArray[Any]) -> NDArray[np.float64]:
        """Transformed points [..., 3]."""
        return self.scale * np.asarray(xyz, np.float64) @ self.rotation.T + self.translation

    def viewmats(self, viewmats: NDArray[Any]) -> NDArray[np.float64]:
        """World-to-camera matrices [F, 4, 4] of the cameras in the transformed world; rigid, OpenCV axes."""
        result = np.array(viewmats, np.float64)
        result[:, :3, :3] = result[:, :3, :3] @ self.rotation.T
        result[:, :3, 3] = self.scale * result[:, :3, 3] - result[:, :3, :3] @ self.translation
        return result


def placement_for(shot: Shot, file: str = "") -> Placement:
    """The placement of a shot's solve in the scene of an export.

    Args:
        shot: a solved shot.
        file: JSON file of a `Placement`. Empty: the shot's placement as Blender last wrote it, if it belongs to the
            present solve; otherwise the default `Placement`, in solve units.

    Raises:
        FileNotFoundError: `file` is missing.
        ValueError: `file` holds no placement, or the placement of another solve.
    """
    solve = file_digest(shot.solve / CAMERAS_FILE)
    if file:
        placement = Placement.load(file)
        if placement.solve not in ("", solve):
            raise UserError(
                f"{file} belongs to another solve of this shot.",
                "Open the shot in Blender: the next step writes the file again.",
            )
        return placement
    if not shot.placement.is_file():
        return Placement()
    placement = Placement.load(shot.placement)
    return placement if placement.solve in ("", solve) else Placement()


def path_viewmats(path: CameraPath) -> NDArray[np.float64]:
    """World-to-camera matrices of a camera path, [F, 4, 4]."""
    return np.array([frame.viewmat for frame in path.frames], np.float64).reshape(-1, 4, 4)


def camera_to_world(viewmats: NDArray[Any]) -> NDArray[np.float64]:
    """Camera-to-world matrices [F, 4, 4] with x right, y up and the camera looking along -z, from OpenCV viewmats.

    These are the camera axes of Blender, USD and Nuke. World coordinates do not change.
    """
    viewmats = np.asarray(viewmats, np.float64)
    result = np.zeros_like(viewmats)
    rotation = np.swapaxes(viewmats[:, :3, :3], 1, 2)
    result[:, :3, :3] = rotation * [1.0, -1.0, -1.0]
    result[:, :3, 3] = -(rotation @ viewmats[:, :3, 3:])[..., 0]
    result[:, 3, 3] = 1.0
    return result


@dataclass(frozen=True)
class Lens:
    """A pinhole camera described by focal length, sensor size and lens shift, as in Blender, USD and Nuke."""

    focal_mm: float
    """Focal length in mm for a sensor `SENSOR_MM` wide."""
    sensor_height_mm: float
    """Height of the sensor in mm; takes pixels that are not square into account."""
    shift_x: float
    """Offset of the picture to the right, as a share of its width."""
    shift_y: float
    """Offset of the picture upwards, as a share of its width."""


SENSOR_MM = 36.0
"""Width in mm of the sensor of every exported `Lens`: full frame, Blender's default. Only ratios to it matter."""


def lens_of(K: list[float], width: int, height: int) -> Lens:
    """The lens for K = (fx, fy, cx, cy) in pixels, pixel centres at +0.5, and pictures of width x height pixels."""
    fx, fy, cx, cy = K
    tall = fx / fy  # height of a pixel over its width
    return Lens(
        fx * SENSOR_MM / width,
        SENSOR_MM * height * tall / width,
        (width / 2.0 - cx) / width,
        (cy - height / 2.0) * tall / width,
    )
