"""Detects a flat scene, such as a filmed photograph, which has no depth to freeze. Needs only numpy."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

THICKNESS = 0.01
"""Largest distance of a point from the common plane, as a share of the points' spread."""
FLAT_SHARE = 0.9
"""Smallest share of the points in one plane that makes a scene flat. Measured: 0.04 to 0.06 in rooms, 0.99 in a pan
over a photograph."""
_TRIES = 500
_SAMPLE = 4000


def plane_share(xyz: NDArray[Any]) -> float:
    """Largest share of points [P, 3] that lie in one plane, found by random triples; 0 for fewer than four points."""
    if len(xyz) < 4:
        return 0.0
    rng = np.random.default_rng(0)
    points = xyz if len(xyz) <= _SAMPLE else xyz[rng.choice(len(xyz), _SAMPLE, replace=False)]
    points = points - np.median(points, axis=0)
    limit = THICKNESS * float(np.median(np.linalg.norm(points, axis=1)))
    best = 0.0
    for _ in range(_TRIES):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length > 0.0:
            best = max(best, float((np.abs((points - a) @ normal) <= limit * length).mean()))
    return best


def flat_words(xyz: NDArray[Any]) -> tuple[str, str] | None:
    """(message, hint) if the points lie in one plane; None for a scene with depth."""
    share = plane_share(xyz)
    if share < FLAT_SHARE:
        return None
    return (
        f"The scene is flat: {round(100 * share)} % of its points lie in one plane, as in a pan over a still picture.",
        "A freeze needs depth: film people in a room, with a camera that moves sideways.",
    )
