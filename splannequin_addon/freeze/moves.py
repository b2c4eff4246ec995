"""Camera moves computed from a clip's path: smoothed, retimed, held, orbit. Plain numpy, no bpy.

A path is one pose per frame, camera-to-world, [F, 4, 4] float64, Blender's camera axes (x right, y up, looking along
-z), solve units. Positions and rotations are processed separately. Rotations are unit quaternions (w, x, y, z).
Multiplying them by a fixed rotation from either side is an orthogonal map. Results therefore do not depend on the
choice of world or camera axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Timing:
    """The clip pose for each output frame."""

    frames: Array
    """[N] fractional frame number of the clip."""
    stop_fraction: Array
    """[N] elapsed fraction of the stop, 0..1: 0 before it, 1 after it."""


def smoothed(poses: Array, position: float, rotation: float) -> Array:
    """A path without sway. The first and the last pose stay.

    Each coordinate y minimises |y - x|^2 + b |y''|^2 (a Whittaker smoother). Motion of the period p keeps the fraction
    1 / (1 + (c / p)^4). The cutoff period c, at which half remains, is the amount times the length of the path.

    Args:
        poses: [F, 4, 4], evenly spaced in time.
        position: smoothing of positions, 0..1. At 1, motion that repeats within the path is removed.
        rotation: smoothing of rotations, 0..1.

    Returns:
        [F, 4, 4] float64.
    """
    result = np.array(poses, dtype=np.float64)
    result[:, :3, 3] = _low_pass(result[:, :3, 3], position * (len(poses) - 1))
    turns = _low_pass(quaternions(result), rotation * (len(poses) - 1))
    result[:, :3, :3] = rotations(turns)
    return result


def retimed(first: int, last: int, stop: float, ease_in: float, hold: float, ease_out: float) -> Timing:
    """The clip's path with a stop: normal speed, deceleration, standstill, acceleration, normal speed.

    The speed changes as a smoothstep, so it has no kink. An ease covers half its length in clip frames. An ease that is
    too long for its side of the stop is shortened.

    Args:
        first: first frame of the clip.
        last: last frame of the clip.
        stop: frame of the clip at which the camera stands still, within first..last.
        ease_in: frames of the deceleration.
        hold: frames of the standstill.
        ease_out: frames of the acceleration.
    """
    ease_in, ease_out = min(ease_in, 2.0 * (stop - first)), min(ease_out, 2.0 * (last - stop))
    slower = stop - first - ease_in / 2.0
    still = slower + ease_in
    faster = still + hold
    length = faster + ease_out / 2.0 + last - stop
    time = np.arange(int(np.ceil(length - 1e-9)) + 1, dtype=np.float64)
    into = np.clip((time - slower) / max(ease_in, 1e-9), 0.0, 1.0)
    out = np.clip((time - faster) / max(ease_out, 1e-9), 0.0, 1.0)
    frames = first + np.minimum(time, slower)
    frames += ease_in * (into - into**3 + into**4 / 2.0)  # the integral of 1 - smoothstep
    frames += ease_out * (out**3 - out**4 / 2.0)
    frames += np.maximum(time - faster - ease_out, 0.0)
    stop_fraction = np.clip((time - still) / hold, 0.0, 1.0) if hold > 0 else (time >= still).astype(np.float64)
    return Timing(np.minimum(frames, last), stop_fraction)


def filled(numbers: Array, poses: Array) -> Array:
    """A pose for every frame from first to last, [F, 4, 4], linearly interpolated.

    Args:
        numbers: [K] ascending frame numbers.
        poses: [K, 4, 4].
    """
    wanted = np.arange(numbers[0], numbers[-1] + 1, dtype=np.float64)
    values = np.concatenate([poses[:, :3, 3], quaternions(poses)], axis=1)
    return _poses(between(wanted, numbers, values))


def between(wanted: Array, numbers: Array, values: Array) -> Array:
    """Columns [K, C] given at ascending numbers [K], linearly interpolated at the wanted numbers: [N, C]."""
    result = np.empty((len(wanted), values.shape[1]))
    for i in range(values.shape[1]):
        result[:, i] = np.interp(wanted, numbers, values[:, i])
    return result


def at(poses: Array, places: Array) -> Array:
    """Poses at fractional indices of a path, on a Catmull-Rom spline through the path, so that the speed has no kinks.

    Args:
        poses: [F, 4, 4].
        places: [N] fractional indices, 0..F-1.

    Returns:
        [N, 4, 4] float64.
    """
    values = np.concatenate([poses[:, :3, 3], quaternions(poses)], axis=1)
    if len(values) == 1:
        return np.repeat(_poses(values), len(places), axis=0)
    slopes = np.gradient(values, axis=0)
    index = np.clip(np.floor(places).astype(int), 0, len(poses) - 2)
    share = (places - index)[:, None]
    square, cube = share**2, share**3
    ends = values[index] * (2 * cube - 3 * square + 1) + values[index + 1] * (3 * square - 2 * cube)
    return _poses(ends + slopes[index] * (cube - 2 * square + share) + slopes[index + 1] * (cube - square))


def orbit(poses: Array, stop_fraction: Array, pivot: Array, up: Array, angles: tuple[float, float]) -> Array:
    """A path with an orbit around a point, there and back, during its stop.

    Args:
        poses: [N, 4, 4].
        stop_fraction: [N], see `Timing`. The swing is largest at 0.5. At 0 and 1 the swing and its speed are 0.
        pivot: centre of the orbit, [3].
        up: axis of the orbit, unit vector [3].
        angles: largest rotations in radians: around `up`, and around the camera's right axis.

    Returns:
        [N, 4, 4] float64.
    """
    swing = (1.0 - np.cos(2.0 * np.pi * stop_fraction)) / 2.0
    result = np.array(poses, dtype=np.float64)
    for axes, angle in ((result[:, :3, 0].copy(), angles[1]), (np.broadcast_to(up, (len(poses), 3)), angles[0])):
        turn = rotations(_quaternion_of(axes, swing * angle))
        result[:, :3, 3] = pivot + _apply(turn, result[:, :3, 3] - pivot)
        result[:, :3, :3] = np.stack([_apply(turn, result[:, :3, i]) for i in range(3)], axis=2)
    return result


def in_the_middle(pose: Array, lens: tuple[float, float, float, float], size: tuple[int, int], depth: float) -> Array:
    """The 3D point in the middle of an image, [3].

    Args:
        pose: [4, 4].
        lens: fx, fy, cx, cy in pixels.
        size: width and height in pixels.
        depth: depth of the point along the camera's axis, solve units.
    """
    fx, fy, cx, cy = lens
    ray = np.array([(size[0] / 2.0 - cx) / fx, -(size[1] / 2.0 - cy) / fy, -1.0])
    return pose[:3, 3] + depth * (pose[:3, :3] * ray).sum(axis=1)


def depth_of_points(pose: Array, lens: tuple[float, float, float, float], size: tuple[int, int], xyz: Array) -> float:
    """Median depth of the points inside an image, solve units; 0 without such points.

    Args:
        pose: [4, 4].
        lens: fx, fy, cx, cy in pixels.
        size: width and height in pixels.
        xyz: [P, 3].
    """
    seen = ((xyz - pose[:3, 3])[:, :, None] * pose[:3, :3]).sum(axis=1)
    depth = -seen[:, 2]
    seen, depth = seen[depth > 1e-6], depth[depth > 1e-6]
    x, y = lens[2] + lens[0] * seen[:, 0] / depth, lens[3] - lens[1] * seen[:, 1] / depth
    depth = np.sort(depth[(x >= 0) & (x <= size[0]) & (y >= 0) & (y <= size[1])])
    return float(depth[len(depth) // 2]) if len(depth) else 0.0


def unsteadiness(poses: Array) -> tuple[float, float]:
    """RMS of a path's second difference: of positions in units per frame^2, of rotations in radians per frame^2."""
    places, turns = poses[:, :3, 3], poses[:, :3, :3]
    steps = (turns[1:, :, None, :] * turns[:-1, None, :, :]).sum(axis=-1)  # R[i + 1] R[i]^T
    rates = _logarithm(steps)
    seconds = np.diff(places, n=2, axis=0), np.diff(rates, axis=0)
    values = [float(np.sqrt((s * s).sum(axis=1).mean())) if len(s) else 0.0 for s in seconds]
    return values[0], values[1]


# ------------------------------------------------------------------------------------------------- rotations


def quaternions(poses: Array) -> Array:
    """Unit quaternions of poses, [F, 4]. Signs are chosen for continuity, because q and -q are the same rotation."""
    m = np.asarray(poses, dtype=np.float64)[:, :3, :3]
    # 4 q q^T. The column with the largest diagonal element is the most accurate (Shepperd's method).
    products = np.empty((len(m), 4, 4))
    trace = m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2]
    products[:, 0, 0] = 1.0 + trace
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        products[:, i + 1, i + 1] = 1.0 + 2.0 * m[:, i, i] - trace
        products[:, 0, i + 1] = products[:, i + 1, 0] = m[:, k, j] - m[:, j, k]
        products[:, j + 1, k + 1] = products[:, k + 1, j + 1] = m[:, j, k] + m[:, k, j]
    best = np.argmax(np.diagonal(products, axis1=1, axis2=2), axis=1)
    result = _of_length_1(products[np.arange(len(m)), best])
    same_side = (result[1:] * result[:-1]).sum(axis=1) >= 0
    result[1:] *= np.cumprod(np.where(same_side, 1.0, -1.0))[:, None]
    return result


def rotations(q: Array) -> Array:
    """Rotation matrices [F, 3, 3] of quaternions [F, 4] of any length."""
    w, x, y, z = _of_length_1(q).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def _quaternion_of(axes: Array, angles: Array) -> Array:
    """Quaternions [N, 4] of rotations by angles [N] (radians) around unit axes [N, 3]."""
    return np.concatenate([np.cos(angles / 2)[:, None], np.sin(angles / 2)[:, None] * axes], axis=1)


def _logarithm(matrices: Array) -> Array:
    """Rotation vectors [N, 3] of rotation matrices, radians."""
    q = quaternions(matrices)
    q = np.where(q[:, :1] < 0, -q, q)
    sine = np.sqrt((q[:, 1:] ** 2).sum(axis=1))
    factor = np.where(sine > 1e-12, 2.0 * np.arctan2(sine, q[:, 0]) / np.maximum(sine, 1e-12), 2.0)
    return q[:, 1:] * factor[:, None]


def _apply(turns: Array, vectors: Array) -> Array:
    """Vectors [N, 3], each rotated by its matrix [N, 3, 3]."""
    return (turns * vectors[:, None, :]).sum(axis=2)


def _of_length_1(values: Array) -> Array:
    return values / np.sqrt((values * values).sum(axis=-1, keepdims=True))


def _poses(values: Array) -> Array:
    """Poses [N, 4, 4] from positions and quaternions of any length, [N, 7]."""
    result = np.zeros((len(values), 4, 4))
    result[:, :3, :3], result[:, :3, 3], result[:, 3, 3] = rotations(values[:, 3:]), values[:, :3], 1.0
    return result


# ------------------------------------------------------------------------------------------------- low-pass


def _low_pass(values: Array, period: float) -> Array:
    """Columns [F, C] after a low-pass filter with a cutoff period in frames, of which half remains. The end values
    stay."""
    count = len(values) - 2
    if count < 1 or period <= 0:
        return np.array(values, dtype=np.float64)
    weight = (period / (2.0 * np.pi)) ** 4
    # The normal equations of the inner values have five diagonals.
    second = np.zeros((3, count + 2))  # weights of y[i - 1], y[i], y[i + 1] in the second difference at i
    second[:, 1:-1] = np.array([1.0, -2.0, 1.0])[:, None]
    diagonal, one, two = 1.0 + np.zeros(count + 2), np.zeros(count + 2), np.zeros(count + 2)
    for shift in range(3):
        where = np.arange(1, count + 1) + shift - 1
        np.add.at(diagonal, where, weight * second[shift, 1:-1] ** 2)
        if shift < 2:
            np.add.at(one, where, weight * second[shift, 1:-1] * second[shift + 1, 1:-1])
        if shift < 1:
            np.add.at(two, where, weight * second[shift, 1:-1] * second[shift + 2, 1:-1])
    wanted = np.array(values[1:-1], dtype=np.float64)
    first, last = values[0], values[-1]
    wanted[0] -= one[0] * first
    wanted[-1] -= one[count] * last
    if count > 1:
        wanted[1] -= two[0] * first
        wanted[-2] -= two[count - 1] * last
    inner = _solve(diagonal[1:-1], one[1:count], two[1 : count - 1], wanted)
    return np.concatenate([values[:1], inner, values[-1:]])


def _solve(diagonal: Array, one: Array, two: Array, wanted: Array) -> Array:
    """Solution x of A x = wanted [N, C], by L D L^T. A is symmetric positive definite with the diagonals [N], [N-1],
    [N-2].
    """
    # Without LAPACK, whose threads block Blender's main thread on a busy machine (see `axes.camera_to_world`).
    count = len(diagonal)
    d, low, lower = np.zeros(count), np.zeros(count), np.zeros(count)
    result = np.array(wanted, dtype=np.float64)
    for i in range(count):
        if i > 1:
            lower[i] = two[i - 2] / d[i - 2]
        if i > 0:
            coupled = lower[i] * d[i - 2] * low[i - 1] if i > 1 else 0.0
            low[i] = (one[i - 1] - coupled) / d[i - 1]
        d[i] = diagonal[i] - (low[i] ** 2 * d[i - 1] if i > 0 else 0.0) - (lower[i] ** 2 * d[i - 2] if i > 1 else 0.0)
        if i > 0:
            result[i] -= low[i] * result[i - 1]
        if i > 1:
            result[i] -= lower[i] * result[i - 2]
    result /= d[:, None]
    for i in range(count - 2, -1, -1):
        result[i] -= low[i + 1] * result[i + 1]
        if i + 2 < count:
            result[i] -= lower[i + 2] * result[i + 2]
    return result
