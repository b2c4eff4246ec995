"""Detects a camera that only rotates, from the homographies between its frames. Needs only numpy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FOCALS = (0.4, 2.5)
"""Range of focal lengths that are tried, as shares of the picture's width: views 103 to 23 degrees wide."""
FOCAL_TOLERANCE = 1.2
"""Factor by which a known focal length is varied in both directions, which compensates for lens distortion."""
_STEPS = 48
WIDEST = 0.25
"""Share of the pairs that is tested: the pairs with the largest shifts."""
TRAVELLED = 0.2
"""Largest share of the shift between two frames that translation may cause if the camera counts as only rotating.
Measured in a rendered room: 0.02 when turning, 0.5 to 0.7 when walking past its walls."""
# Deviation from a rotation caused by noise alone: ratio of the largest to the smallest singular value, minus 1.
_NOISE = 0.004


def is_pure_rotation(
    homographies: NDArray[np.float64], shifts: NDArray[np.float64], size: tuple[int, int], focal: float = 0.0
) -> bool:
    """True if some focal length turns the homographies of the pairs with the largest shifts into rotations.

    The homography of a rotating camera is K R K^-1. If the camera moves past a plane, it is K (R + t n^T / d) K^-1.
    Its singular values then differ by the distance travelled, relative to the distance of the plane.

    Args:
        homographies: [N, 3, 3], pixels to pixels, of the pairs of frames that a homography explains.
        shifts: [N], median displacement of the pair's matches in pixels.
        size: width and height of the frames in pixels; the principal point is the centre.
        focal: focal length in pixels if it is known; 0: the usual range is tried.
    """
    if not len(homographies):
        return False
    order = np.argsort(shifts)[-max(1, round(WIDEST * len(shifts))) :]
    shift = float(np.median(shifts[order]))
    ends = (focal / FOCAL_TOLERANCE, focal * FOCAL_TOLERANCE) if focal else (FOCALS[0] * size[0], FOCALS[1] * size[0])
    for value in np.geomspace(*ends, _STEPS).tolist():
        lens = np.array([[value, 0.0, 0.5 * size[0]], [0.0, value, 0.5 * size[1]], [0.0, 0.0, 1.0]])
        singular = np.linalg.svd(np.linalg.inv(lens) @ homographies[order] @ lens, compute_uv=False)
        spread = float(np.median(singular[:, 0] / np.maximum(singular[:, 2], 1e-12) - 1.0))
        if spread < max(TRAVELLED * shift / value, _NOISE):
            return True
    return False
