"""Camera paths: a handheld camera that walks forward, pans, goes and returns, or orbits; or one that turns on a tripod.

World in metres, z up; camera axes as in OpenCV.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .noise import Array, stream, wander

FOCAL_PER_WIDTH = 0.85
"""Focal length relative to image width: a horizontal angle of 61 degrees, like a phone's main camera."""

PIVOT_METRES = 0.05
"""Distance of the lens in front of the rotation axis of a tripod's head."""


@dataclass(frozen=True)
class CameraMove:
    """The camera path of one scene as a function of time."""

    move: str
    """One of sizes.CAMERA_MOVES, or tripod: it turns about a pivot without a hand's tremble."""
    seed: int
    duration: float
    """Seconds of the clip, in which the path is walked once."""

    def eyes_and_targets(self, seconds: Array) -> tuple[Array, Array]:
        """([T, 3] positions, [T, 3] targets of the view), before the hand's tremble."""
        rng = stream(self.seed, "camera path")
        u = np.clip(seconds / self.duration, -0.2, 1.2)
        height = rng.uniform(1.45, 1.65)
        side, depth = rng.choice([-1.0, 1.0]), rng.uniform(-0.15, 0.15)
        if self.move == "forward":
            x0, x1 = side * rng.uniform(0.1, 0.45), -side * rng.uniform(0.1, 0.4)
            eye = np.stack([x0 + (x1 - x0) * u, -4.2 + depth + 3.1 * u], 1)
            target = np.stack([0.5 * x1 + 0.5 * np.sin(2.0 * u - 0.6) * side, eye[:, 1] + 4.0], 1)
        elif self.move == "pan":
            eye = np.stack([side * (-1.1 + 2.2 * u), -3.3 + depth + 0.5 * u], 1)
            yaw = side * np.radians(-24.0 + 48.0 * u)
            target = eye + 3.5 * np.stack([np.sin(yaw), np.cos(yaw)], 1)
        elif self.move == "return":
            sway = np.sin(np.pi * np.clip(u, -0.5, 1.5))
            eye = np.stack([side * (-1.3 + 2.6 * sway), -3.4 + depth + 0.7 * sway], 1)
            target = np.stack([side * (-0.4 + 0.7 * sway), np.full_like(u, 0.6)], 1)
        elif self.move == "orbit":
            angle = side * np.radians(-36.0 + 72.0 * u)
            radius = 3.6 + depth
            eye = np.stack([radius * np.sin(angle), 0.4 - radius * np.cos(angle)], 1)
            target = np.tile([0.0, 0.4], (len(u), 1))
        elif self.move == "tripod":
            yaw = side * np.radians(-16.0 + 32.0 * u)
            forward = np.stack([np.sin(yaw), np.cos(yaw)], 1)
            eye = np.array([0.0, -3.4 + depth]) + PIVOT_METRES * forward
            target = eye + 3.5 * forward
        else:
            raise ValueError(f"camera move {self.move!r} is none of forward, pan, return, orbit, tripod")
        walking = 0.015 * np.sin(2 * np.pi * 1.8 * seconds) if self.move not in ("pan", "tripod") else 0.0
        eyes = np.column_stack([eye, height + walking + np.zeros_like(u)])
        return eyes, np.column_stack([target, np.full_like(u, height - rng.uniform(0.25, 0.5))])

    def world_to_camera(self, seconds: Array) -> Array:
        """[T, 4, 4] including the hand's tremble: centimetres and half degrees, at walking pace and faster."""
        eyes, targets = self.eyes_and_targets(seconds)
        if self.move == "tripod":
            return np.array([_look_at(e, t, np.zeros(3)) for e, t in zip(eyes, targets, strict=True)])
        rng = stream(self.seed, "camera hand")
        eyes = eyes + 0.012 * wander(rng, seconds, 0.9, 3) + 0.002 * wander(rng, seconds, 0.25, 3)
        degrees = np.array([0.5, 0.5, 0.7]) * wander(rng, seconds, 1.1, 3) + 0.08 * wander(rng, seconds, 0.25, 3)
        return np.array([_look_at(e, t, np.radians(d)) for e, t, d in zip(eyes, targets, degrees, strict=True)])


def _look_at(eye: Array, target: Array, tremble: Array) -> Array:
    """[4, 4] world-to-camera from `eye` to `target`, then rotated by small angles about the camera's axes."""
    z = target - eye
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    cx, cy, cz = np.cos(tremble)
    sx, sy, sz = np.sin(tremble)
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    rotation = about_z @ about_y @ about_x @ rotation
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = -rotation @ eye
    return matrix


def intrinsics(width: int, height: int) -> Array:
    """[3, 3] in pixels, pixel centres at +0.5: square pixels, principal point at the centre."""
    focal = FOCAL_PER_WIDTH * width
    return np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
