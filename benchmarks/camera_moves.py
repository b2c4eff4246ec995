"""How much steadier is a smoothed camera move? The solved path of shots, and what *Smooth Move* makes of it.

    python -m benchmarks.camera_moves SHOT... --amounts 0.25 0.5 1

A line per shot and amount: how many times smaller the path's second difference is (RMS over all frames), of positions
and of rotations, and how far the camera leaves the clip's path at most, as a share of the median depth of the points
that the first frame shows.
"""

from __future__ import annotations

import argparse
import importlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from splannequin_addon import run_in_bpy
from torch_backend.contract import CameraPath, ShotFolder


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shots", nargs="+", type=Path)
    parser.add_argument("--amounts", nargs="+", type=float, default=[0.25, 0.5, 1.0])
    args = parser.parse_args()
    for shot in args.shots:
        for amount in args.amounts:
            print(json.dumps({"shot": shot.name, "amount": amount, **measured(shot, amount)}), flush=True)
    return 0


def measured(shot: Path, amount: float) -> dict[str, float]:
    """Figures of a shot smoothed by an amount, by name."""
    moves, axes = (_addon(name) for name in ("freeze.moves", "scene.axes"))
    path = CameraPath.load(ShotFolder(shot).cameras)
    numbers = np.array([f.frame for f in path.frames], dtype=np.float64)
    poses = moves.filled(numbers, axes.poses(path))
    smooth = moves.smoothed(poses, amount, amount)
    before, after = moves.unsteadiness(poses), moves.unsteadiness(smooth)
    with np.load(ShotFolder(shot).points) as stored:
        xyz = stored["xyz"].astype(np.float64)
    depth = moves.depth_of_points(poses[0], path.frames[0].K, (path.width, path.height), xyz)
    away = np.linalg.norm(smooth[:, :3, 3] - poses[:, :3, 3], axis=1).max()
    return {
        "position_times": round(before[0] / after[0], 1),
        "rotation_times": round(before[1] / after[1], 1),
        "away_share": round(float(away) / depth, 3),
    }


def _addon(name: str) -> Any:
    """A module of the add-on that knows no bpy."""
    return importlib.import_module(f"{run_in_bpy.load_package().__name__}.splannequin_addon.{name}")


if __name__ == "__main__":
    raise SystemExit(main())
