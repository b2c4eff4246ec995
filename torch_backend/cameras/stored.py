"""Loads the files of a solve from the shot. An error names the damaged file and the step that recreates it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..contract import (
    CAMERAS_FILE,
    POINTS_FILE,
    SOLVE_FILE,
    CameraPath,
    ExitCode,
    JobError,
    check_version,
    open_arrays,
    read_json,
)
from ..shot import Shot

_POINTS = {"xyz": ("f", (3,)), "rgb": ("u", (3,)), "error": ("f", ()), "track": ("iu", ())}
"""Array of points.npz -> (allowed numpy dtype kinds, shape of a row)."""


def load_cameras(shot: Shot) -> CameraPath:
    """The contents of cameras.json.

    Raises JobError (SOLVE) if the shot is not solved or the file is damaged, ValueError if the file is too new.
    """
    path = _existing(shot, CAMERAS_FILE)
    data = _object(path)
    check_version(data, path.name)
    try:
        cameras = CameraPath.from_json(data)
        poses = np.array([[*frame.viewmat, *frame.K] for frame in cameras.frames], np.float64)
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        raise damaged(path, error) from error
    if poses.ndim != 2 or poses.shape[1] != 20 or not np.isfinite(poses).all() or not (poses[:, 16:18] > 0).all():
        raise damaged(path, "a frame's viewmat and K should be 16 and 4 finite numbers, its focal lengths above 0")
    return cameras


def load_record(shot: Shot) -> dict[str, Any]:
    """The contents of solve.json. Raises JobError (SOLVE) if the shot is not solved or the file is damaged."""
    return _object(_existing(shot, SOLVE_FILE))


def load_points(shot: Shot) -> dict[str, NDArray[Any]]:
    """Arrays of points.npz: xyz float32 [P, 3] solve units, rgb uint8 [P, 3], error float32 [P] px, track uint16 [P].

    Raises JobError (SOLVE) if the shot is not solved or the file is damaged.
    """
    path = _existing(shot, POINTS_FILE)
    try:
        with open_arrays(path) as handle, np.load(handle, allow_pickle=False) as data:
            points = {name: data[name] for name in _POINTS}
    except Exception as error:  # zipfile, zlib and numpy raise many types, with messages unfit for users
        raise damaged(path, "it cannot be read") from error
    count = len(points["xyz"]) if points["xyz"].ndim else 0
    for name, (kinds, shape) in _POINTS.items():
        if points[name].dtype.kind not in kinds or points[name].shape != (count, *shape):
            raise damaged(path, f"{name} is {points[name].dtype} {points[name].shape}")
    if not np.isfinite(points["xyz"]).all():
        raise damaged(path, "a point is not finite")
    return points


def damaged(path: Path, why: Exception | str) -> JobError:
    """The error for a damaged file of the solve."""
    reason = " ".join(str(why).split()) or type(why).__name__
    return JobError(f"{path} is damaged ({reason[:200]}).", "Solve the camera again.", ExitCode.SOLVE)


def _existing(shot: Shot, name: str) -> Path:
    path = shot.solve / name
    if not path.is_file():
        raise JobError(f"{shot.root.name} has no cameras yet.", "Run the camera step first.", ExitCode.SOLVE)
    return path


def _object(path: Path) -> dict[str, Any]:
    try:
        return read_json(path)
    except ValueError as error:
        raise damaged(path, error) from error
