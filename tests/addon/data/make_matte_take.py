"""Train the tiny test world for a few steps and freeze it at frame 105; run by the backend's Python.

python make_matte_take.py ROOT_OF_THE_REPOSITORY FOLDER
"""

import sys
from pathlib import Path

import cv2
import numpy as np


def main() -> None:
    root, folder = Path(sys.argv[1]), Path(sys.argv[2])
    sys.path.insert(0, str(root))
    from tests.backend.conftest import Quiet, build_world, paint_motion
    from torch_backend.contract import FreezeParams, TrainParams
    from torch_backend.freeze import freeze_shot
    from torch_backend.raster import rasterize
    from torch_backend.shot import write_json
    from torch_backend.train import train_shot

    world = build_world(folder)
    write_json(world.shot.solve_record, {"version": 1, "quality": "A good solve.", "frames": 16})
    paint_motion(world)
    train_shot(world.shot, TrainParams(iterations=400, holdout=0, max_gaussians=1500), Quiet())
    freeze_shot(world.shot, FreezeParams(t_star=105, first=104, last=110, detail="off", develop="off"), Quiet())
    masks = {}
    for frame in range(104, 111):
        state = {name: value[world.moving] for name, value in world.at(4 / 15).items()}
        n = frame - 101
        shown = rasterize(**state, viewmats=world.viewmats[n : n + 1], Ks=world.K[None], width=64, height=48)
        masks[frame] = (shown.alphas[0].numpy() > 0.5).astype(np.uint8)
    outlines, _ = cv2.findContours(masks[107], cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outline = (max(outlines, key=len)[::2, 0] + 0.5).tolist()
    write_json(folder / "truth.json", {"masks": {str(n): m.tolist() for n, m in masks.items()}, "outline": outline})


if __name__ == "__main__":
    main()
