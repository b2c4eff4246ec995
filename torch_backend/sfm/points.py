"""Selects the sparse points for training, and refuses solves whose triangulation angles are too small."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..contract import ExitCode, JobError

LEAST_ANGLE_DEG = 2.0
LEAST_POINTS = 100
POINT_MAX_ERROR_PX = 2.0
POINT_LEAST_TRACK = 3
POINT_FARTHEST = 20.0

STILL_HINT = "A freeze needs a clip in which the camera moves sideways by a step or more."


def filter_points(points: dict[str, NDArray[Any]], centres: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """The points to train from: error below 2 px, seen by 3 frames or more, in front of all cameras, no far outliers.

    `points` holds xyz [P, 3], rgb, error, track and depth [P] (smallest over a point's cameras). `centres` [C, 3] are
    camera centres. Far means 20 times the median distance from their median.
    """
    distance = np.linalg.norm(points["xyz"] - np.median(centres, axis=0), axis=1)
    keep = (points["error"] < POINT_MAX_ERROR_PX) & (points["track"] >= POINT_LEAST_TRACK) & (points["depth"] > 0)
    keep &= np.isfinite(points["xyz"]).all(axis=1)
    if keep.any():
        # Twenty times, to keep what is seen through windows.
        keep &= distance < POINT_FARTHEST * np.median(distance[keep])
    return {name: points[name][keep] for name in ("xyz", "rgb", "error", "track")}


def narrow_words(angle_deg: float) -> str:
    """Sentence that the triangulation angle, median in degrees, is too small for depth."""
    return (
        f"The camera moves too little for depth: the parallax of half of the points is {angle_deg:.1f} degrees or less."
    )


def refuse_narrow(angle_deg: float) -> None:
    """Raises JobError if the median triangulation angle in degrees is too small for depth."""
    if angle_deg < LEAST_ANGLE_DEG:
        raise JobError(narrow_words(angle_deg), STILL_HINT, ExitCode.SOLVE)
