"""Distance of a take's surface to the truth: `python -m benchmarks.surface SCENE ... --results DIR`.

SCENE is a folder of benchmarks/synthetic (seeds 0 to 9 to tune on, 100 to 109 to report on). Its shot and an `auto` run
for each training seed are made in DIR if they are missing; each instant is frozen (every `--every`-th frame), and its
surface is made as *Add Frozen Surface* makes it. Only exact cameras: solve units are metres.

A vertex is judged in every pose that has a truth, by |its depth - truth| / truth at the pixel it falls on: it is as
far off as in the second best of them, so that two poses have to agree and one that sees something in front of it does
not count. Vertices of the room and of people (what moves in the clip) apart. DIR gets surface-NAME.json.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.detail_truth import scene_arguments, trained
from benchmarks.sources import Log, SyntheticTruth, load_source
from torch_backend.contract import (
    CameraPath,
    FreezeParams,
    JobError,
    SurfaceParams,
    TakeFolder,
    placement_of,
    read_json,
)
from torch_backend.freeze import freeze_shot
from torch_backend.freeze.surface.job import make_surface, read_surface
from torch_backend.native import default_threads
from torch_backend.shot import write_json
from torch_backend.solve.placement import Similarity

BEYOND = 0.01
"""Relative distance that was wanted in the median."""
PARTS = ("room", "people")


def off_truth(places: NDArray[np.float64], views: Sequence[tuple[NDArray[Any], NDArray[Any], NDArray[Any]]]) -> Any:
    """[V] relative distance of places from the true surface: the second least of all views; inf where fewer see it.

    Args:
        places: [V, 3] in metres.
        views: (viewmat [4, 4], K [3, 3], true depth [H, W] in metres, inf for sky) of each pose.
    """
    found: list[NDArray[np.float64]] = []
    for viewmat, K, depth in views:
        seen = places @ viewmat[:3, :3].T + viewmat[:3, 3]
        ahead = np.maximum(seen[:, 2], 1e-6)
        column, row = (np.floor(K[i, i] * seen[:, i] / ahead + K[i, 2]).astype(int) for i in (0, 1))
        height, width = depth.shape
        within = (seen[:, 2] > 1e-6) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        true = depth[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
        within &= np.isfinite(true)
        found.append(np.where(within, np.abs(seen[:, 2] - true) / np.where(within, true, 1.0), np.inf))
    return np.sort(np.stack(found), axis=0)[1]


def judge(truth: SyntheticTruth, run: str, t_star: int, every: int) -> dict[str, dict[str, float]]:
    """Part of the surface -> vertices, seen (share that two poses see), median and ninth tenth of their distance."""
    shot, take = truth.shot, f"surface-{run}-{t_star}"
    folder = TakeFolder(shot.take(take))
    params = FreezeParams(run=run, take=take, t_star=t_star, step=every, only_missing=True)
    freeze_shot(shot, params, Log())
    make_surface(shot, SurfaceParams(take=take), Log())
    vertices, triangles = read_surface(folder.surface)
    back = Similarity.of(placement_of(read_json(folder.facts))).inverse()
    places = back.points(np.stack([vertices[axis] for axis in "xyz"], -1))
    cameras = {camera.frame: camera for camera in CameraPath.load(shot.cameras).frames}
    path = CameraPath.load(shot.cameras)
    views: list[tuple[NDArray[Any], NDArray[Any], NDArray[Any]]] = []
    for pose in truth.poses(t_star, []):
        fx, fy, cx, cy = cameras[pose].K
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        viewmat = np.reshape(cameras[pose].viewmat, (4, 4))
        views.append((viewmat, K, truth.depth(t_star, pose, path.width, path.height).numpy()))
    off = off_truth(places, views)
    corners = np.stack([triangles[name] for name in "abc"], -1)
    found: dict[str, dict[str, float]] = {}
    for part, people in zip(PARTS, (False, True), strict=True):
        rows = np.unique(corners[(triangles["people"] > 0) == people])
        seen = off[rows][np.isfinite(off[rows])]
        told = {"vertices": float(len(rows)), "seen": len(seen) / max(len(rows), 1)}
        if len(seen):
            told |= {"median": float(np.median(seen)), "ninth tenth": float(np.quantile(seen, 0.9))}
            told["beyond"] = float((seen > BEYOND).mean())
        found[part] = told
    return found


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; returns an exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    scene_arguments(parser)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], metavar="N", help="of the trainings")
    args = parser.parse_args(argv)
    torch.set_num_threads(default_threads())
    rows = ["| scene | seed | t* | part | vertices | seen by two | median, % | ninth tenth, % | beyond 1 %, % |"]
    rows.append("|---|---:|---:|---|---:|---:|---:|---:|---:|")
    try:
        if args.cameras != "exact":
            raise ValueError("the surface is judged in metres: only exact cameras have them")
        for folder in args.scenes:
            source = f"exact:{folder.absolute()}"
            truth = load_source(source, args.results.absolute())
            if not isinstance(truth, SyntheticTruth):
                raise ValueError(f"{folder}: depth is only known of scenes of benchmarks/synthetic")
            told: dict[str, Any] = {}
            for seed in args.seeds:
                run = trained(truth, source, argparse.Namespace(**{**vars(args), "seed": seed}))
                for t_star in args.t_star or truth.t_stars:
                    found = told[f"seed {seed}, t* {t_star}"] = judge(truth, run, t_star, args.every)
                    for part, of in found.items():
                        cells = [f"{100 * of[k]:.2f}" if k in of else "–" for k in ("median", "ninth tenth", "beyond")]
                        where = f"{truth.name} | {seed} | {t_star} | {part} | {of['vertices']:.0f} | {of['seen']:.2f}"
                        rows.append(f"| {where} | {' | '.join(cells)} |")
                        print(rows[-1], flush=True)
            write_json(args.results.absolute() / f"surface-{truth.name.replace(' ', '-')}.json", {"version": 1, **told})
    except (FileNotFoundError, JobError, RuntimeError, ValueError) as error:
        print(f"Error: {error}", file=sys.stderr)
        return 1
    print("\n".join(["", *rows]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
