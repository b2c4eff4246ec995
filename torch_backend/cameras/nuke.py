"""An animated camera for Nuke: a .chan table, or a .nk script to paste.

Nuke's world has y up: (x, y, z) of the scene, with z up, becomes (x, z, -y), in the scene's units. Rotations are in
degrees, in Nuke's default order ZXY: the matrix is Ry Rx Rz for column vectors (Foundry, Camera node, rot_order).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..contract import CameraPath
from .placement import SENSOR_MM, Lens, Similarity, camera_to_world, lens_of, path_viewmats

Y_UP = Similarity(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]), 1.0, np.zeros(3))
"""Transform from the scene's axes (z up) to Nuke's (y up)."""
# Gimbal-lock threshold. If the cosine of the x rotation is not above it, the z rotation is set to 0.
_LEVEL = 1e-9


def euler_zxy(rotations: NDArray[Any]) -> NDArray[np.float64]:
    """Euler angles in degrees about x, y and z, [F, 3], of rotations [F, 3, 3] = Ry Rx Rz.

    Unwrapped over the frames, so that no angle jumps by 360 degrees.
    """
    r = np.asarray(rotations, np.float64)
    about_x = np.arcsin(np.clip(-r[:, 1, 2], -1.0, 1.0))
    is_level = np.hypot(r[:, 1, 0], r[:, 1, 1]) > _LEVEL
    about_y = np.where(is_level, np.arctan2(r[:, 0, 2], r[:, 2, 2]), np.arctan2(-r[:, 2, 0], r[:, 0, 0]))
    about_z = np.where(is_level, np.arctan2(r[:, 1, 0], r[:, 1, 1]), 0.0)
    return np.degrees(np.unwrap(np.stack([about_x, about_y, about_z], axis=1), axis=0))


def poses(path: CameraPath, where: Similarity) -> tuple[NDArray[np.float64], NDArray[np.float64], list[Lens]]:
    """Positions [F, 3] and `euler_zxy` [F, 3] of a path's cameras in Nuke's world, and their lenses."""
    to_world = camera_to_world(Y_UP.after(where).viewmats(path_viewmats(path)))
    return (
        to_world[:, :3, 3],
        euler_zxy(to_world[:, :3, :3]),
        [lens_of(f.K, path.width, path.height) for f in path.frames],
    )


def chan_text(path: CameraPath, where: Similarity, name: str) -> str:
    """The camera as a .chan table.

    Each line holds: frame number, position x y z, rotation x y z, vertical field of view in degrees. The format cannot
    store an off-centre principal point or a name; `nk_text` stores both.

    Args:
        path: cameras in solve units.
        where: transform from solve units to the scene.
        name: name of the shot; not used.
    """
    places, turns, lenses = poses(path, where)
    views = [2.0 * np.degrees(np.arctan2(lens.sensor_height_mm / 2.0, lens.focal_mm)) for lens in lenses]
    rows = np.column_stack([places, turns, views])
    return "".join(
        f"{frame.frame}\t" + "\t".join(f"{v:.9g}" for v in row) + "\n"
        for frame, row in zip(path.frames, rows, strict=True)
    )


def nk_text(path: CameraPath, where: Similarity, name: str) -> str:
    """A .nk script with the animated camera, and an axis node that rotates splats (z up) into Nuke's world.

    Args:
        path: cameras in solve units.
        where: transform from solve units to the scene.
        name: name of the shot, from which the node names are built.
    """
    places, turns, lenses = poses(path, where)
    numbers = [frame.frame for frame in path.frames]

    def curve(values: Sequence[float] | NDArray[np.float64]) -> str:
        """An animation curve with linear interpolation, in Nuke's syntax."""
        keys = " ".join(f"x{number} {value:.9g}" for number, value in zip(numbers, values, strict=True))
        return f"{{curve L {keys}}}"

    def curves(columns: NDArray[np.float64]) -> str:
        return "{" + " ".join(curve(column) for column in columns.T) + "}"

    # Nuke's win_translate is in units of half the picture's width, in both directions.
    offset = np.array([[2.0 * lens.shift_x, 2.0 * lens.shift_y] for lens in lenses])
    camera = {
        "inputs": "0",
        "rot_order": "ZXY",
        "translate": curves(places),
        "rotate": curves(turns),
        "focal": "{" + curve([lens.focal_mm for lens in lenses]) + "}",
        "haperture": f"{SENSOR_MM:.9g}",
        "vaperture": f"{lenses[0].sensor_height_mm:.9g}",
        "win_translate": curves(offset),
        "name": f"{_node_name(name)}_camera",
    }
    axis = {"inputs": "0", "rot_order": "ZXY", "rotate": "{-90 0 0}", "name": f"{_node_name(name)}_splats"}
    return _node("Camera2", camera) + _node("Axis2", axis)


def _node(kind: str, knobs: dict[str, str]) -> str:
    return f"{kind} {{\n" + "".join(f" {knob} {value}\n" for knob, value in knobs.items()) + "}\n"


def _node_name(name: str) -> str:
    """A valid Nuke node name: letters, digits and underscores, with no leading digit."""
    plain = re.sub(r"\W", "_", name, flags=re.ASCII) or "shot"
    return f"_{plain}" if plain[0].isdigit() else plain
