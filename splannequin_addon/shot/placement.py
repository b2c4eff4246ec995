"""Where a shot stands in its scene, written into the shot folder for what leaves it: splats and cameras."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

from ...torch_backend import contract
from . import scene_objects


def placement_in(scene: bpy.types.Scene, shot: Path) -> contract.Placement | None:
    """The placement of a shot's solve by its root, z up; None if the scene has no root of it, or there is no solve.

    A root that was stretched or mirrored by hand gives its turn, its place and its mean scale.
    """
    root, cameras = scene_objects.placed_root(scene, shot), contract.ShotFolder(shot).cameras
    if root is None or not cameras.is_file():
        return None
    place, turn, stretch = root.matrix_world.decompose()
    scale = sum(abs(value) for value in stretch) / 3.0
    # In float64: in single precision a large scale would fail the test for a uniform scale.
    matrix = np.eye(4)
    matrix[:3, :3] = scale * _orthonormal(np.array(turn.to_matrix(), dtype=np.float64))
    matrix[:3, 3] = place[:]
    units = scene.unit_settings
    metres = units.scale_length if units.system != "NONE" else 1.0
    return contract.Placement(matrix.ravel().tolist(), float(metres), contract.file_digest(cameras))


def write(scene: bpy.types.Scene, shot: Path) -> None:
    """Writes the placement of a shot into its folder, if it stands in the scene. OSError if it cannot be written."""
    placement = placement_in(scene, shot)
    if placement is not None:
        contract.write_json(contract.ShotFolder(shot).placement, placement.to_json(), parents=False)


def in_solve(placement: contract.Placement) -> Matrix:
    """The inverse of a placement: what stands in a scene's units, under a root that is the solve's."""
    return Matrix(np.array(placement.scene_from_solve).reshape(4, 4).tolist()).inverted()


def _orthonormal(turn: np.ndarray) -> np.ndarray:
    """The columns of a rotation [3, 3], square to each other in float64 (Gram and Schmidt)."""
    x = turn[:, 0] / np.sqrt((turn[:, 0] ** 2).sum())
    y = turn[:, 1] - x * (x * turn[:, 1]).sum()
    y = y / np.sqrt((y**2).sum())
    return np.stack([x, y, np.cross(x, y)], axis=1)
