"""Child process that triangulates a clip with known cameras: `python -m benchmarks.synthetic.triangulate REQUEST`.

COLMAP extracts features and matches as in the product's solve, and triangulates with fixed poses. It is a separate
process for the reasons given in torch_backend/sfm/worker.py. The request is the worker's plus "K" [fx, fy, cx, cy],
"width", "height" and "cameras" {file: 4x4 world-to-camera}. Writes points.npz to the request's folder, like the worker.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from pathlib import Path

import numpy as np
import pycolmap

from torch_backend.sfm.answers import write_points
from torch_backend.sfm.mapping import triangulate
from torch_backend.sfm.request import SEED, Request


def main(path: str) -> int:
    """Runs the request; returns 1 if no point could be triangulated, else 0."""
    threading.Thread(target=_die_with_parent, daemon=True).start()
    request = Request(Path(path))
    data = json.loads(Path(path).read_text(encoding="utf-8"))
    pycolmap.set_random_seed(SEED)
    camera = pycolmap.Camera(model="PINHOLE", width=data["width"], height=data["height"], params=data["K"])
    poses = {name: (0, np.array(matrix)[:3]) for name, matrix in data["cameras"].items()}
    model = triangulate(request, [camera], poses)
    if not model.num_points3D():
        return 1
    write_points(request, model)
    return 0


def _die_with_parent() -> None:
    while os.read(0, 64):
        pass
    os._exit(1)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1]))
