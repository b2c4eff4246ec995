"""The child process that triangulates a clip with known cameras: `python -m benchmarks.synthetic.triangulate REQUEST`.

COLMAP's features and matches as in the product's solve, its triangulation with the poses held. A process of its own for
the reasons that torch_backend/solve/worker.py gives. The request is the worker's plus "K" [fx, fy, cx, cy], "width",
"height" and "cameras" {file: 4x4 world-to-camera}. Writes points.npz beside it, as the worker does.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from pathlib import Path

import numpy as np
import pycolmap

from torch_backend.solve import worker

LEAST_ANGLE_DEG = 1.0


def main(path: str) -> int:
    """Runs the request; 1 if nothing could be triangulated."""
    threading.Thread(target=_die_with_parent, daemon=True).start()
    request = worker.Request(Path(path))
    data = json.loads(Path(path).read_text(encoding="utf-8"))
    pycolmap.set_random_seed(worker.SEED)
    worker.extract(request, request.solved, None)
    worker.match(request)
    known = pycolmap.Reconstruction()
    with worker.closing_database(request) as database:
        number = database.read_all_cameras()[0].camera_id
        images = {image.name: image for image in database.read_all_images()}
    camera = pycolmap.Camera(
        model="PINHOLE", width=data["width"], height=data["height"], params=data["K"], camera_id=number
    )
    known.add_camera_with_trivial_rig(camera)
    for name, matrix in sorted(data["cameras"].items()):
        stored = images[name]
        image = pycolmap.Image(name=name, camera_id=number, image_id=stored.image_id)
        known.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.array(matrix)[:3]))
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = worker.SEED
    options.triangulation.min_angle = LEAST_ANGLE_DEG
    model_folder = request.scratch / "triangulated"
    model_folder.mkdir()
    model = pycolmap.triangulate_points(known, request.database, request.images, model_folder, True, options)
    points = [model.points3D[i] for i in sorted(model.points3D)]
    if not points:
        return 1
    np.savez(
        request.scratch / "points.npz",
        xyz=np.array([p.xyz for p in points], np.float32),
        rgb=np.array([p.color for p in points], np.uint8),
        error=np.array([p.error for p in points], np.float32),
        track=np.array([min(p.track.length(), 65535) for p in points], np.uint16),
        depth=worker.smallest_depths(model, points),
    )
    return 0


def _die_with_parent() -> None:
    while os.read(0, 64):
        pass
    os._exit(1)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1]))
