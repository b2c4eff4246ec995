"""Detects a camera that only rotates, from the homographies between its frames. numpy alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FOCALS = (0.4, 2.5)
"""Range of focal lengths that are tried, as shares of the picture's width: 103 to 23 degrees wide."""
GIVEN = 1.2
"""Times by which a known focal length may be off: with one, a bend of the lens is made up for."""
_STEPS = 48
WIDEST = 0.25
"""Share of the pairs that are tested: those with the largest shift."""
TRAVELLED = 0.2
"""Largest share of the shift between two frames that translation may cause for the camera to count as only rotating.
Measured in a rendered room: 0.02 turning, 0.5 to 0.7 walking past its walls."""
_NOISE = 0.004
"""How far from a rotation noise makes one, as the ratio of its largest to its smallest singular value, less one."""


def is_pure_rotation(
    homographies: NDArray[np.float64], shifts: NDArray[np.float64], size: tuple[int, int], focal: float = 0.0
) -> bool:
    """True if one focal length makes rotations of the homographies between the pairs that are farthest apart.

    A homography of a camera that turns is K R K^-1; one of a plane that a camera passes is R + t n^T / d between the
    Ks, whose singular values differ by the way travelled as a share of the distance.

    Args:
        homographies: [N, 3, 3], pixels to pixels, of pairs of frames that one explains.
        shifts: [N], median way in pixels of what the pair has in common.
        size: width and height of the frames, pixels; the axis goes through the middle.
        focal: focal length in pixels if it is known; 0: any usual one is tried.
    """
    if not len(homographies):
        return False
    order = np.argsort(shifts)[-max(1, round(WIDEST * len(shifts))) :]
    shift = float(np.median(shifts[order]))
    ends = (focal / GIVEN, focal * GIVEN) if focal else (FOCALS[0] * size[0], FOCALS[1] * size[0])
    for value in np.geomspace(*ends, _STEPS).tolist():
        lens = np.array([[value, 0.0, 0.5 * size[0]], [0.0, value, 0.5 * size[1]], [0.0, 0.0, 1.0]])
        singular = np.linalg.svd(np.linalg.inv(lens) @ homographies[order] @ lens, compute_uv=False)
        spread = float(np.median(singular[:, 0] / np.maximum(singular[:, 2], 1e-12) - 1.0))
        if spread < max(TRAVELLED * shift / value, _NOISE):
            return True
    return False
