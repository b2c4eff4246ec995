"""Distance of a take's surface from the truth: `python -m benchmarks.surface SCENE ... --results DIR`.

SCENE is a folder of benchmarks/synthetic (seeds 0 to 9 for tuning, 100 to 109 for reporting). Its shot and an `auto`
run for each training seed are made in DIR if missing. Each instant is frozen (every `--every`-th frame) and its surface
made as by *Add Frozen Surface*. Requires exact cameras, whose solve unit is a metre.

The figure is the distance to the nearest point of the true surface, relative to that point's depth in the nearest plate
that sees it. A vertex counts only if two of the clip's plates see the true point; other points are guessed, not
measured. The room and people (movers of the clip) are judged separately. The same figures of the frames' depth points
show what fusion adds. The surface is also judged at the frames' pixels, because vertices are distributed by area.

A ball is placed on the true surface at three points, under a lamp. From the first, middle and last pose, its shadow on
the surface is compared with the one on the truth: SSIM within the shadows. Writes surface-NAME.json to DIR.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
from numpy.typing import NDArray

from benchmarks.detail_truth import scene_arguments, trained_scenes
from benchmarks.shadow import Set, likeness, places_of
from benchmarks.sources import Log, SyntheticTruth, in_words
from benchmarks.synthetic.rays import RayScene
from benchmarks.synthetic.regions import Geometry, View
from torch_backend.cameras.placement import Similarity
from torch_backend.contract import FreezeParams, SurfaceParams, TakeFolder, placement_of, read_json
from torch_backend.freeze import freeze_shot
from torch_backend.freeze.surface.job import make_surface, read_surface, view_of
from torch_backend.freeze.surface.volume import SurfaceConfig, unprojected
from torch_backend.freeze.take.folder import frames_of
from torch_backend.shot import write_json

BEYOND = 0.01
"""Target for the median relative distance."""
THINNED = 7
"""Stride of the judged pixels of frames."""
PLATES = 2
"""Least number of plates that must see a point of the true surface."""


def distance_from_truth(places: NDArray[np.float64], truth: RayScene, views: Sequence[View]) -> NDArray[np.float64]:
    """[V] distance from the true surface, relative to its depth; inf if fewer than `PLATES` views see the true point.

    Args:
        places: [V, 3] in metres.
        truth: the true surface.
        views: the plates' cameras.
    """
    found = truth.nearest(places)
    count, least = np.zeros(len(places), int), np.full(len(places), np.inf)
    for view in views:
        pixels, depth = view.project(found)
        rows = np.flatnonzero(view.shows(pixels, depth))
        rows = rows[truth.sees(view.eye, found[rows])]
        count[rows] += 1
        least[rows] = np.minimum(least[rows], depth[rows])
    return np.where(count >= PLATES, np.linalg.norm(places - found, axis=1) / least, np.inf)


def figures(distances: NDArray[np.float64]) -> dict[str, float]:
    """Number of points, share seen by plates; of these, median and 90th percentile of distance, share `BEYOND`."""
    seen = distances[np.isfinite(distances)]
    row = {"points": float(len(distances)), "seen": len(seen) / max(len(distances), 1)}
    if len(seen):
        row |= {"median": float(np.median(seen)), "ninth tenth": float(np.quantile(seen, 0.9))}
        row["beyond"] = float((seen > BEYOND).mean())
    return row


def judge(truth: SyntheticTruth, run: str, t_star: int, every: int) -> dict[str, dict[str, float]]:
    """{part: `figures`} for room and people: of the surface, of the surface at frames' pixels, of the frames' depth.

    "shadow" has the number of its pictures, and mean and worst likeness.
    """
    shot, scene, take = truth.shot, truth.scene, f"surface-{run}-{t_star}"
    folder = TakeFolder(shot.take(take))
    params = FreezeParams(run=run, take=take, t_star=t_star, step=every, only_missing=True)
    freeze_shot(shot, params, Log())
    make_surface(shot, SurfaceParams(take=take), Log())
    vertices, triangles = read_surface(folder.surface)
    back = Similarity.of(placement_of(read_json(folder.facts))).inverse()
    places = back.points(np.stack([vertices[axis] for axis in "xyz"], -1))
    standing = Geometry.load(scene.root).at(scene.frames.index(t_star))
    views = [View(scene.world_to_camera[n], scene.K, scene.width, scene.height) for n in scene.frames]
    corners = np.stack([triangles[name] for name in "abc"], -1)
    parts = {
        name: places[np.unique(corners[(triangles["people"] > 0) == people])]
        for name, people in (("room", False), ("people", True))
    }
    surface = RayScene(places, corners)
    points, eyes, moves = points_of(folder)
    reached = surface.cast(eyes, points - eyes).distance[:, None]
    shown = np.where(np.isfinite(reached), eyes + (points - eyes) * reached, np.nan)
    for kind, of in (("at pixels", shown), ("frames", points)):
        known = np.isfinite(of[:, 0])
        parts |= {f"room, {kind}": of[~moves & known], f"people, {kind}": of[moves & known]}
    rows = {name: figures(distance_from_truth(of, standing, views)) for name, of in parts.items()}
    return rows | {"shadow": shadows(surface, standing, views)}


def points_of(folder: TakeFolder) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """(points [P, 3] from a take's depth, their eyes [P, 3], bool [P] movers), of every `THINNED`-th pixel."""
    points: list[NDArray[np.float64]] = []
    eyes: list[NDArray[np.float64]] = []
    moves: list[NDArray[np.bool_]] = []
    for number in frames_of(folder):
        view = view_of(folder.frame(number), SurfaceConfig())
        found, rows, columns = unprojected(view)
        points.append(found[::THINNED])
        eyes.append(np.broadcast_to(-view.viewmat[:3, :3].T @ view.viewmat[:3, 3], points[-1].shape))
        moves.append(view.motion[rows, columns][::THINNED] > 0.5)
    return np.concatenate(points), np.concatenate(eyes), np.concatenate(moves)


def shadows(surface: RayScene, truth: RayScene, views: Sequence[View]) -> dict[str, float]:
    """Number of pictures with a ball's shadow from the first, middle and last view; mean and worst likeness."""
    middle = len(views) // 2
    found = [
        likeness(surface, truth, view, Set.on(place))
        for place in places_of(truth, views[middle])
        for view in (views[0], views[middle], views[-1])
    ]
    known = [one for one in found if one is not None]
    row = {"pictures": float(len(known))}
    return row | ({"mean": float(np.mean(known)), "worst": min(known)} if known else {})


@in_words
def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    scene_arguments(parser)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], metavar="N", help="training seeds")
    args = parser.parse_args(argv)
    rows = [
        "| scene | seed | t* | part | points | seen by two plates | median, % | 90th percentile, % | beyond 1 %, % |"
    ]
    rows.append("|---|---:|---:|---|---:|---:|---:|---:|---:|")
    ends = [""]
    if args.cameras != "exact":
        raise ValueError("the surface is judged in metres: only exact cameras have them")
    for truth, runs in trained_scenes(args, args.seeds):
        results: dict[str, Any] = {}
        for seed, run in runs.items():
            for t_star in args.t_star or truth.t_stars:
                found = results[f"seed {seed}, t* {t_star}"] = judge(truth, run, t_star, args.every)
                shaded = found["shadow"]
                cells = [f"{shaded[k]:.3f}" if k in shaded else "–" for k in ("mean", "worst")]
                where = f"{truth.name}, seed {seed}, t* {t_star}"
                ends.append(f"{where}: shadows {cells[0]}, worst {cells[1]} of {shaded['pictures']:.0f}")
                for part, of in found.items():
                    if part == "shadow":
                        continue
                    cells = [f"{100 * of[k]:.2f}" if k in of else "–" for k in ("median", "ninth tenth", "beyond")]
                    where = f"{truth.name} | {seed} | {t_star} | {part} | {of['points']:.0f} | {of['seen']:.2f}"
                    rows.append(f"| {where} | {' | '.join(cells)} |")
                    print(rows[-1], flush=True)
        write_json(args.results.absolute() / f"surface-{truth.name.replace(' ', '-')}.json", {"version": 1, **results})
    print("\n".join(["", *rows, *ends]))


if __name__ == "__main__":
    sys.exit(main())
