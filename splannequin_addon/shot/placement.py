"""The placement of a shot in its scene, written into the shot folder for exported splats and cameras."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

from ...torch_backend import contract
from . import scene_objects


def placement_in(scene: bpy.types.Scene, shot: Path) -> contract.Placement | None:
    """The placement of a shot's solve, from its root, z up; None without a root in the scene or without a solve.

    For a root that was stretched or mirrored by hand, uses its rotation, location and mean scale.
    """
    root, cameras = scene_objects.placed_root(scene, shot), contract.ShotFolder(shot).cameras
    if root is None or not cameras.is_file():
        return None
    place, turn, stretch = root.matrix_world.decompose()
    scale = sum(abs(value) for value in stretch) / 3.0
    # Uses float64: in single precision a large scale would fail the test for a uniform scale.
    matrix = np.eye(4)
    matrix[:3, :3] = scale * _orthonormal(np.array(turn.to_matrix(), dtype=np.float64))
    matrix[:3, 3] = place[:]
    units = scene.unit_settings
    metres = units.scale_length if units.system != "NONE" else 1.0
    return contract.Placement(matrix.ravel().tolist(), float(metres), contract.file_digest(cameras))


def write(scene: bpy.types.Scene, shot: Path) -> None:
    """Writes the placement of a shot into its folder, if the scene has its root. Raises OSError if it cannot be
    written."""
    placement = placement_in(scene, shot)
    if placement is not None:
        contract.write_json(contract.ShotFolder(shot).placement, placement.to_json(), parents=False)


def in_solve(placement: contract.Placement) -> Matrix:
    """The inverse of a placement: converts scene coordinates to solve coordinates, for objects under the root."""
    return Matrix(np.array(placement.scene_from_solve).reshape(4, 4).tolist()).inverted()


def _orthonormal(turn: np.ndarray) -> np.ndarray:
    """A rotation [3, 3] with columns made orthonormal in float64 (Gram-Schmidt)."""
    x = turn[:, 0] / np.sqrt((turn[:, 0] ** 2).sum())
    y = turn[:, 1] - x * (x * turn[:, 1]).sum()
    y = y / np.sqrt((y**2).sum())
    return np.stack([x, y, np.cross(x, y)], axis=1)
