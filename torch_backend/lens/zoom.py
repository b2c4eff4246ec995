"""Detects a zoom during the take, from the focal length that fits each frame best. Uses numpy only.

A solve has one focal length for all frames. If the lens zooms, the solve moves the cameras along their axes instead,
and the error stays small. Points at different depths distinguish a zoom from a camera move.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cameras.poses import quat_to_rotation

ZOOM = 0.02
"""Smallest change of focal length within the take that counts as a zoom, as a natural logarithm."""
# Minimum number of points to estimate the focal length of a frame.
_LEAST_POINTS = 30
_LEAST_FRAMES = 8
_STEPS = 20
# Largest change of focal length, as a natural logarithm; beyond it, the refinement has diverged.
_MOST = 2.0
# Threshold of the Huber weights, in pixels.
_OUTLIER_PX = 1.5


def focal_change(
    seen: NDArray[np.float64], points: NDArray[np.float64], pose: NDArray[np.float64], focal: float
) -> float:
    """Natural logarithm of the best focal length for one frame over the focal length of the solve; nan if unknown.

    Refines pose and focal length of the frame together, with fixed points (Gauss-Newton, Huber weights).

    Args:
        seen: [N, 2] undistorted observations of the points, as x/z and y/z for the solve's focal length.
        points: [N, 3] world.
        pose: [3, 4] world-to-camera.
        focal: focal length of the solve in pixels.
    """
    if len(points) < _LEAST_POINTS:
        return float("nan")
    rotation, shift, change = _part(pose[:, :3]), _part(pose[:, 3]), 0.0
    for _ in range(_STEPS):
        residual, jacobian = _linearised(seen, points, rotation, shift, focal, change)
        weight = 1.0 / np.maximum(1.0, np.linalg.norm(residual, axis=1) / _OUTLIER_PX)
        weighted = _part((jacobian * weight[:, None, None]).reshape(-1, 7))
        normal = _part(weighted.T @ jacobian.reshape(-1, 7))
        try:
            step = _part(-np.linalg.solve(normal, weighted.T @ residual.reshape(-1)))
            update = quat_to_rotation(np.array([1.0, *(0.5 * step[:3])]))  # a small turn, to first order
            rotation, shift = _part(update @ rotation), _part(update @ shift + step[3:6])
            change += float(step[6])
            if not abs(change) < _MOST:
                return float("nan")
            if abs(float(step[6])) < 1e-6:
                # A flat scene seen head-on does not determine the focal length: the estimate would be noise.
                noise = 1.48 * float(np.median(np.abs(residual)))
                known = noise * float(np.linalg.inv(normal)[6, 6]) ** 0.5 < 0.25 * ZOOM
                return change if known else float("nan")
        except np.linalg.LinAlgError:
            return float("nan")
    return float("nan")


def _part(values: NDArray[Any]) -> NDArray[np.float64]:
    """Values as float64, because numpy does not declare their type."""
    return np.asarray(values, np.float64)


def _linearised(
    seen: NDArray[np.float64],
    points: NDArray[np.float64],
    rotation: NDArray[np.float64],
    shift: NDArray[np.float64],
    focal: float,
    change: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(residuals [N, 2] in pixels, their Jacobian [N, 2, 7]).

    The parameters are a rotation vector [3], a shift [3] in camera axes and the logarithm of the focal length.
    """
    at = points @ rotation.T + shift
    flat = at[:, :2] / at[:, 2:]
    scale = focal * np.exp(change)
    by_shift = np.zeros((len(at), 2, 3))
    by_shift[:, 0, 0] = by_shift[:, 1, 1] = 1.0 / at[:, 2]
    by_shift[:, :, 2] = -flat / at[:, 2:]
    by_turn = by_shift @ -_cross(at)  # a rotation w moves a point p in camera axes by w x p = -[p]x w
    jacobian = scale * np.concatenate([by_turn, by_shift, flat[:, :, None]], axis=2)
    return _part(scale * flat - focal * seen), _part(jacobian)


def zoom_words(changes: Mapping[int, float]) -> tuple[str, str] | None:
    """(sentence, hint) for the artist if the focal length changes over the take; None if it does not.

    Args:
        changes: frame number -> `focal_change`.
    """
    known = [(frame, change) for frame, change in sorted(changes.items()) if np.isfinite(change)]
    if len(known) < _LEAST_FRAMES:
        return None
    frames, values = [frame for frame, _ in known], np.array([change for _, change in known])
    padded = np.pad(values, 2, mode="edge")
    smooth = np.median(np.lib.stride_tricks.sliding_window_view(padded, 5), axis=1)  # ignore single outliers
    whole = float(smooth.max() - smooth.min())
    if whole < ZOOM:
        return None
    first, last = _steady(smooth)
    percent = round(100 * (np.exp(whole) - 1.0))
    hint = f"Import frames {frames[first]} to {frames[last]}, in which it does not zoom, or film without zooming."
    if last - first + 1 < _LEAST_FRAMES:
        hint = "Film without zooming, or choose a range in which it does not."
    return (
        f"The lens zooms: its focal length changes by {percent} % or more during the take, but this solve has one "
        "for all frames. The camera path is wrong, even if its error is small.",
        hint,
    )


def _steady(values: NDArray[np.float64]) -> tuple[int, int]:
    """First and last index of the longest run whose values differ by less than half of `ZOOM`."""
    best, start = (0, 0), 0
    for end in range(len(values)):
        while np.ptp(values[start : end + 1]) > 0.5 * ZOOM:
            start += 1
        if end - start > best[1] - best[0]:
            best = (start, end)
    return best


def _cross(v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrices [..., 3, 3] of the cross product: `_cross(v) @ w` is v x w, for vectors v [..., 3]."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return out - np.swapaxes(out, -1, -2)
