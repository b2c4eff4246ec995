"""Interpolation between camera poses on SE(3): quaternions wxyz, OpenCV axes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def rotation_to_quat(rotation: NDArray[Any]) -> NDArray[np.float64]:
    """The unit quaternion wxyz (w >= 0) of a [3, 3] rotation."""
    r = np.asarray(rotation, np.float64)
    trace = r.trace()
    squares = np.array([trace, r[0, 0], r[1, 1], r[2, 2]])
    # The best conditioned of four formulas (Shepperd 1978): the others divide by numbers near 0.
    largest = int(np.argmax(squares))
    if largest == 0:
        quat = np.array([1.0 + trace, r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        quat = np.empty(4)
        quat[0] = r[k, j] - r[j, k]
        quat[1 + i] = 1.0 + r[i, i] - r[j, j] - r[k, k]
        quat[1 + j] = r[j, i] + r[i, j]
        quat[1 + k] = r[k, i] + r[i, k]
    quat /= np.linalg.norm(quat)
    return -quat if quat[0] < 0 else quat


def quat_to_rotation(quat: NDArray[Any]) -> NDArray[np.float64]:
    """The [3, 3] rotation of a quaternion wxyz of any non-zero length."""
    w, x, y, z = np.asarray(quat, np.float64) / np.linalg.norm(quat)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _multiply(a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.float64]:
    w, v = a[0] * b[0] - a[1:] @ b[1:], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])
    return np.concatenate([[w], v])


def slerp(a: NDArray[Any], b: NDArray[Any], share: float) -> NDArray[np.float64]:
    """Spherical interpolation between unit quaternions along the shorter arc: a exp(share log(a^-1 b))."""
    relative = _multiply(a * [1.0, -1.0, -1.0, -1.0], b)
    # q and -q are the same rotation; this sign gives the shorter arc.
    if relative[0] < 0:
        relative = -relative
    sine = float(np.linalg.norm(relative[1:]))
    half = share * np.arctan2(sine, relative[0])
    # sin(share x)/sin(x) -> share as x -> 0
    factor = share if sine < 1e-9 else np.sin(half) / sine
    moved = _multiply(a, np.concatenate([[np.cos(half)], factor * relative[1:]]))
    return moved / np.linalg.norm(moved)


def camera_centre(pose: NDArray[Any]) -> NDArray[np.float64]:
    """The camera centre in world coordinates (solve units) of a [3, 4] or [4, 4] world-to-camera pose."""
    return -pose[:3, :3].T @ pose[:3, 3]


def interpolate_pose(a: NDArray[Any], b: NDArray[Any], share: float) -> NDArray[np.float64]:
    """The [3, 4] world-to-camera pose at `share` in [0, 1] between `a` and `b`.

    Interpolates the rotation by `slerp` and the camera centre linearly.
    """
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    rotation = quat_to_rotation(slerp(rotation_to_quat(a[:3, :3]), rotation_to_quat(b[:3, :3]), share))
    centre = (1.0 - share) * camera_centre(a) + share * camera_centre(b)
    return np.concatenate([rotation, (-rotation @ centre)[:, None]], axis=1)


def fill_poses(seconds: NDArray[Any], known: dict[int, NDArray[Any]]) -> list[NDArray[np.float64]]:
    """A [3, 4] pose for each of N times, from known poses at some of the indices.

    Interpolates by time between the known neighbours. Before the first and after the last known pose, repeats that
    pose. `seconds` is [N], ascending. Raises ValueError if no pose is known.
    """
    if not known:
        raise ValueError("no pose is known: there is nothing to interpolate")
    indices = np.array(sorted(known))
    poses: list[NDArray[np.float64]] = []
    for i, time in enumerate(seconds):
        at = int(np.searchsorted(indices, i))
        if at < len(indices) and indices[at] == i:
            poses.append(np.asarray(known[i], np.float64)[:3])
        elif at == 0 or at == len(indices):
            poses.append(np.asarray(known[int(indices[0 if at == 0 else -1])], np.float64)[:3])
        else:
            before, after = int(indices[at - 1]), int(indices[at])
            span = float(seconds[after] - seconds[before])
            share = (time - seconds[before]) / span if span > 0 else (i - before) / (after - before)
            poses.append(interpolate_pose(known[before], known[after], float(share)))
    return poses
