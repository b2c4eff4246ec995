"""The scale of a shot in the scene: applies changes, and estimates the scale from the camera's height."""

from __future__ import annotations

import math
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

from ...torch_backend import contract
from ..access import camera_of, present
from ..process import steps
from ..scene import axes
from ..shot import inventory, scene_objects
from . import alignment

HAND_HEIGHT = 1.5
"""Typical height in metres of a handheld camera of a standing person."""
STEADY = 0.5
"""Maximum variation of such a camera's height, as a fraction of the height: from eye to waist level."""


def move(scene: bpy.types.Scene, shot: Path, change: np.ndarray) -> list[str]:
    """Applies a world change from `alignment` to a shot's root. Returns the further changes as sentences.

    Args:
        shot: shot folder; the scene has its root.
        change: [4, 4], multiplied onto the root's matrix from the left.
    """
    root, before = present(scene_objects.part(scene, shot, "root")), scene_objects.depth_scale(scene, shot)
    scale = root.scale[:]
    uniform = max(scale) - min(scale) <= 1e-5 * max(scale)
    root.matrix_world = Matrix((change @ np.array(root.matrix_world, dtype=np.float64)).tolist())
    if uniform:  # removes rounding errors of the matrix decomposition
        root.scale = [sum(root.scale[:]) / 3.0] * 3
    bpy.context.view_layer.update()
    grown = scene_objects.depth_scale(scene, shot) / before
    if abs(grown - 1.0) < 1e-6:
        return []
    camera = scene_objects.part(scene, shot, "camera")
    if camera is not None:
        lens = camera_of(camera)
        lens.clip_end *= grown
        lens.clip_start *= grown
    return [note for step in steps.STEPS.values() for note in step.scaled(scene, shot)]


def scaled(scene: bpy.types.Scene, shot: Path) -> bool:
    """True if the artist has set the shot's scale, by Set Scale or on its root. An estimated scale does not count."""
    entry = scene_objects.of(scene, shot)
    unscaled = guessed_scale(scene, shot) or 1.0
    return (entry is not None and entry.scaled) or abs(scene_objects.depth_scale(scene, shot) / unscaled - 1.0) > 1e-4


def guessed_scale(scene: bpy.types.Scene, shot: Path) -> float:
    """Scene units per solve unit that `guess_scale` estimated for a shot; 0 if it did not."""
    entry = scene_objects.of(scene, shot)
    return entry.guessed_scale if entry is not None else 0.0


def guess_scale(scene: bpy.types.Scene, shot: Path, is_new: bool) -> list[str]:
    """Scales a shot so that its camera has a typical handheld height above the floor. Returns the changes as sentences.

    A scale set by the artist stays, and so does an existing shot without an estimate. If the new solve has no floor, an
    earlier estimate is undone.

    Args:
        shot: shot folder; the scene has its root.
        is_new: the root is new.
    """
    entry = present(scene_objects.of(scene, shot))
    if is_new:
        entry.scaled, entry.guessed_scale = entry.world == contract.SCENE_WORLD, 0.0  # its scale is known
    before = entry.guessed_scale
    if scaled(scene, shot) or not (is_new or before):
        return []
    height = height_of_camera(shot)
    metre = 1.0 / scene.unit_settings.scale_length if scene.unit_settings.system != "NONE" else 1.0
    guess = 0.0 if height is None else HAND_HEIGHT * metre / height
    change = (guess or 1.0) / scene_objects.depth_scale(scene, shot)
    entry.guessed_scale = guess
    notes = move(scene, shot, np.diag([change] * 3 + [1.0]))
    if guess:
        notes.append(f"The scale is estimated: the camera is {HAND_HEIGHT:g} m above the floor.")
    return notes


def height_of_camera(shot: Path) -> float | None:
    """Median height of a shot's camera above the solve's floor, solve units.

    None without a floor, or if the height varies too much for a standing person's camera.
    """
    floor = inventory.floor(shot)
    if floor is None:
        return None
    path = contract.CameraPath.load(contract.ShotFolder(shot).cameras)
    heights = axes.poses(path)[:, :3, 3] @ np.array(floor[0], dtype=np.float64) - floor[1]
    middle = float(alignment.middle(heights))
    low, high = np.quantile(heights, (0.05, 0.95))
    if not (math.isfinite(middle) and middle > 0.0 and float(high - low) < STEADY * middle):
        return None
    return middle
