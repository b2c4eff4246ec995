"""Camera axes and lenses: the only module that converts them.

OpenCV: x right, y down, z forward; viewmat world-to-camera. Blender: x right, y up, looking along -z; camera-to-world.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...torch_backend import contract

if TYPE_CHECKING:
    from mathutils import Matrix

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""Converts OpenCV camera axes to Blender's, and back."""
SENSOR_MM = 36.0
"""Sensor width in mm of our cameras. Only its ratio to the focal length matters."""


def camera_to_world(viewmat: np.ndarray) -> np.ndarray:
    """Blender's camera matrices from rigid OpenCV view matrices.

    Args:
        viewmat: world-to-camera, OpenCV axes, [..., 4, 4] float64.

    Returns:
        Camera-to-world with Blender's camera axes, [..., 4, 4] float64, in the same world.
    """
    viewmat = np.asarray(viewmat, dtype=np.float64)
    turned = np.swapaxes(viewmat[..., :3, :3], -1, -2)
    result = np.zeros_like(viewmat)
    # Does not use LAPACK: on a busy machine its threads block Blender's main thread for milliseconds, once per frame.
    result[..., :3, :3] = turned
    result[..., :3, 3] = -(turned * viewmat[..., None, :3, 3]).sum(-1)
    result[..., 3, 3] = 1.0
    return result * np.diagonal(FLIP)


def poses(path: contract.CameraPath) -> np.ndarray:
    """`camera_to_world` of every frame of a path, [F, 4, 4]."""
    return camera_to_world(np.array([f.viewmat for f in path.frames], dtype=np.float64).reshape(-1, 4, 4))


def lens_from_k(k: tuple[float, float, float, float], width: int, height: int) -> tuple[float, float, float]:
    """(focal length in mm, shift_x, shift_y) for a camera with horizontal sensor fit and a sensor of `SENSOR_MM`.

    Args:
        k: fx, fy, cx, cy in pixels, pixel centres at +0.5.
        width: image width in pixels.
        height: image height in pixels.
    """
    fx, fy, cx, cy = k
    # Shifts are fractions of the image width, also vertically, where the pixel height is fx / fy.
    return fx * SENSOR_MM / width, (width / 2 - cx) / width, (cy - height / 2) * (fx / fy) / width


def pixel_aspect(k: tuple[float, float, float, float]) -> tuple[float, float]:
    """(pixel_aspect_x, pixel_aspect_y) of a render with focal lengths fx and fy. Blender requires both >= 1."""
    fx, fy = k[0], k[1]
    ratio = fx / fy
    if abs(ratio - 1.0) < 5e-4:  # less than half a pixel in a thousand
        return 1.0, 1.0
    return (1.0, ratio) if ratio > 1.0 else (1.0 / ratio, 1.0)


def in_solve(
    view_matrix: Matrix, window_matrix: Matrix, placed: np.ndarray, scale: float, size: tuple[int, int]
) -> tuple[list[float], list[float]]:
    """(viewmat, K) of a view in solve units.

    Args:
        view_matrix: world to view, Blender's axes, [4, 4].
        window_matrix: perspective projection, [4, 4].
        placed: placement of the solve in the world, [4, 4] float64.
        scale: scene units per solve unit.
        size: width and height of the image in pixels.

    Returns:
        viewmat: 16 floats, world-to-camera, row-major, OpenCV axes.
        K: fx, fy, cx, cy in pixels.
    """
    to_view = FLIP @ np.array(view_matrix, dtype=np.float64) @ placed
    to_view[:3] /= scale
    return to_view.ravel().tolist(), k_from_window(window_matrix, size)


def k_from_window(window_matrix: Matrix, size: tuple[int, int]) -> list[float]:
    """fx, fy, cx, cy in pixels, pixel centres at +0.5, of a perspective projection [4, 4] onto an image of `size`."""
    (width, height), window = size, np.array(window_matrix, dtype=np.float64)
    return [
        0.5 * width * window[0, 0],
        0.5 * height * window[1, 1],
        0.5 * width * (1.0 - window[0, 2]),
        0.5 * height * (1.0 + window[1, 2]),
    ]
