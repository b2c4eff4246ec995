"""Prints the reprojection errors of COLMAP models as JSON: `python -m benchmarks.synthetic.residuals MODEL...`.

One list per model of [image name, x, y of the keypoint, error in pixels]. It is a separate process for the reasons
given in torch_backend/sfm/worker.py.
"""

from __future__ import annotations

import json
import sys

import numpy as np
import pycolmap


def residuals(folder: str) -> list[tuple[str, float, float, float]]:
    """(image name, x, y, error) of every observation of a triangulated point, in pixels."""
    model = pycolmap.Reconstruction(folder)
    found: list[tuple[str, float, float, float]] = []
    for point in model.points3D.values():
        for element in point.track.elements:
            image = model.images[element.image_id]
            at, seen = image.project_point(point.xyz), image.points2D[element.point2D_idx].xy
            if at is not None:
                found.append(
                    (image.name, round(float(seen[0]), 2), round(float(seen[1]), 2), float(np.hypot(*(at - seen))))
                )
    return found


if __name__ == "__main__":
    print(json.dumps([residuals(folder) for folder in sys.argv[1:]]))
