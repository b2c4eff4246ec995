"""Places what leaves a shot: points and cameras of the solve in the axes and units of a scene."""

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
        """The similarity from solve units to the scene's; its rotation orthonormal to the last bit of float64."""
        matrix = np.array(placement.scene_from_solve, np.float64).reshape(4, 4)
        left, _, right = np.linalg.svd(matrix[:3, :3])
        return Similarity(left @ right, placement.scale, matrix[:3, 3])

    @property
    def matrix(self) -> NDArray[np.float64]:
        """[4, 4]."""
        result = np.eye(4)
        result[:3, :3], result[:3, 3] = self.scale * self.rotation, self.translation
        return result

    def after(self, first: Similarity) -> Similarity:
        """`first`, and then this."""
        return Similarity(
            self.rotation @ first.rotation,
            self.scale * first.scale,
            self.scale * self.rotation @ first.translation + self.translation,
        )

    def inverse(self) -> Similarity:
        """The way back."""
        return Similarity(self.rotation.T, 1.0 / self.scale, -self.rotation.T @ self.translation / self.scale)

    def points(self, xyz: NDArray[Any]) -> NDArray[np.float64]:
        """Points [..., 3] of the one space in the other."""
        return self.scale * np.asarray(xyz, np.float64) @ self.rotation.T + self.translation

    def viewmats(self, viewmats: NDArray[Any]) -> NDArray[np.float64]:
        """World-to-camera matrices [F, 4, 4] of the same cameras after the world was moved; rigid, OpenCV axes."""
        result = np.array(viewmats, np.float64)
        result[:, :3, :3] = result[:, :3, :3] @ self.rotation.T
        result[:, :3, 3] = self.scale * result[:, :3, 3] - result[:, :3, :3] @ self.translation
        return result


def placement_for(shot: Shot, file: str = "") -> Placement:
    """Where a shot's solve stands in the scene that things leave for.

    Args:
        shot: a solved shot.
        file: JSON file of a `Placement`; empty: the shot's own, as Blender wrote it last, if it is of the present
            solve; else upright, in solve units.

    Raises:
        FileNotFoundError, ValueError: `file` is missing or holds no placement, or is one of another solve.
    """
    solve = file_digest(shot.solve / CAMERAS_FILE)
    if file:
        placement = Placement.load(file)
        if placement.solve not in ("", solve):
            raise UserError(
                f"{file} places another solve of this shot.",
                "Open the shot in Blender: it is written anew with the next step.",
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
    """Camera-to-world matrices [F, 4, 4] with x right, y up and the camera looking along -z, of OpenCV's viewmats.

    These are the camera axes of Blender, USD and Nuke. The world stays as it is.
    """
    viewmats = np.asarray(viewmats, np.float64)
    result = np.zeros_like(viewmats)
    turned = np.swapaxes(viewmats[:, :3, :3], 1, 2)
    result[:, :3, :3] = turned * [1.0, -1.0, -1.0]
    result[:, :3, 3] = -(turned @ viewmats[:, :3, 3:])[..., 0]
    result[:, 3, 3] = 1.0
    return result


@dataclass(frozen=True)
class Lens:
    """A pinhole camera as programs with a film back keep it."""

    focal_mm: float
    """Focal length in mm for a sensor `SENSOR_MM` wide."""
    sensor_height_mm: float
    """Height in mm of what the picture shows of that sensor; pixels that are not square are counted in."""
    shift_x: float
    """Offset of the picture to the right, in widths of the picture."""
    shift_y: float
    """Offset of the picture upwards, in widths of the picture."""


SENSOR_MM = 36.0
"""Width in mm of the sensor that lenses are written for: Blender's default, full frame. Only ratios to it matter."""


def lens_of(K: list[float], width: int, height: int) -> Lens:
    """The lens of K = (fx, fy, cx, cy) in pixels, pixel centres at +0.5, for pictures of width x height pixels."""
    fx, fy, cx, cy = K
    tall = fx / fy  # height of a pixel over its width
    return Lens(
        fx * SENSOR_MM / width,
        SENSOR_MM * height * tall / width,
        (width / 2.0 - cx) / width,
        (cy - height / 2.0) * tall / width,
    )
