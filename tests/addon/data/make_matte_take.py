"""Train the tiny test world for a few steps and freeze it at frame 105; run by the backend's Python.

python make_matte_take.py ROOT_OF_THE_REPOSITORY FOLDER
"""

import sys
from pathlib import Path

import numpy as np


def main() -> None:
    root, folder = Path(sys.argv[1]), Path(sys.argv[2])
    sys.path.insert(0, str(root))
    from tests.backend.conftest import Quiet, build_world, outline, paint_motion
    from torch_backend.contract import FreezeParams, TrainParams
    from torch_backend.freeze import freeze_shot
    from torch_backend.shot import write_json
    from torch_backend.train import train_shot

    world = build_world(folder)
    write_json(world.shot.solve_record, {"version": 1, "quality": "A good solve.", "frames": 16})
    paint_motion(world)
    train_shot(world.shot, TrainParams(iterations=250, holdout=0, max_gaussians=1500), Quiet())
    freeze_shot(world.shot, FreezeParams(t_star=105, first=104, last=110, detail="off", develop="off"), Quiet())
    masks = {frame: (world.patch(frame - 101, 4 / 15) > 0.5).astype(np.uint8) for frame in range(104, 111)}
    facts = {"masks": {str(n): m.tolist() for n, m in masks.items()}, "outline": outline(masks[107])[::2]}
    write_json(folder / "truth.json", facts)


if __name__ == "__main__":
    main()
