"""Mattes from one lasso against rendered truth: `python -m benchmarks.mattes SCENE ... --results DIR`.

SCENE is a folder of benchmarks/synthetic (seeds 0 to 9 for tuning, 100 to 109 for reporting). Its shot with exact
cameras, an `auto` run and a take for each instant are made in DIR if missing. Truth is the set of pixels whose centre
shows a person, found by rays through the scene's triangles.

Each person is lassoed once per instant, at the frame that shows the largest share of them. With `--lasso-at t-star` it
is the instant's frame, which may show only a sliver. The lasso is the outline of the truth in that frame, with a corner
every `--corner` pixels. Each corner is moved by up to `--sloppy` pixels in any direction. If an occluder splits a
person, each part with at least a twentieth of the pixels gets a polygon. All other frames of the take that show at
least `LEAST` pixels of the person are judged (every `--every`-th of the clip, including t*). The figure is the
intersection over union of truth and the matte, thresholded at 0.5. Seconds are given up to the job's first matte,
including loading the run, and per further frame with all its mattes.

Writes mattes-NAME.json to DIR.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.detail_truth import scene_arguments, trained_scenes
from benchmarks.sources import Log, in_words
from benchmarks.synthetic.folder import SyntheticScene
from benchmarks.synthetic.rays import RayScene
from benchmarks.synthetic.regions import Geometry, View
from torch_backend.contract import FreezeParams, MatteParams, TakeFolder
from torch_backend.freeze import freeze_shot
from torch_backend.freeze.mattes.files import matte_file, read_matte
from torch_backend.freeze.mattes.job import make_mattes
from torch_backend.freeze.take.folder import frames_of
from torch_backend.shot import Shot, write_json

LEAST = 200
"""Least pixels of a person for a judged pose; with fewer, half a pixel of outline is a tenth of the person."""
WIDE = 120
"""Width in pixels of the pictures on which silhouettes are counted."""
PERSON = "person"
"""Prefix of the names of movers that are people."""


def person_masks(scene: SyntheticScene, t_star: int, poses: Sequence[int]) -> dict[str, dict[int, NDArray[np.bool_]]]:
    """Person -> pose -> [H, W] mask of the pixels that show the person while time is frozen at frame `t_star`."""
    geometry, faces = Geometry.load(scene.root), faces_of_people(scene.root)
    standing = geometry.at(scene.frames.index(t_star))
    found: dict[str, dict[int, NDArray[np.bool_]]] = {name: {} for name in faces}
    for pose in poses:
        view = View(scene.world_to_camera[pose], scene.K, scene.width, scene.height)
        rays = view.rays()
        face = standing.cast(np.broadcast_to(view.eye, rays.shape), rays).face.reshape(scene.height, scene.width)
        for name, (first, last) in faces.items():
            found[name][pose] = (face >= first) & (face < last)
    return found


def best_poses(scene: SyntheticScene, t_star: int, masks: dict[str, dict[int, NDArray[np.bool_]]]) -> dict[str, int]:
    """Person -> the pose that shows the largest share of them, rounded to a twentieth; ties go to the most pixels.

    The share is relative to the full silhouette: unoccluded, and in a frame three times as wide and high.
    """
    geometry, small = Geometry.load(scene.root), WIDE / scene.width
    standing, K = geometry.at(scene.frames.index(t_star)), scene.K * [[small], [small], [1.0]]
    width, height = round(scene.width * small), round(scene.height * small)
    K[:2, 2] += width, height
    found: dict[str, int] = {}
    for name, (first, last) in faces_of_people(scene.root).items():
        person = RayScene(standing.vertices, standing.triangles[first:last])
        score: dict[int, tuple[float, int]] = {}
        for pose, mask in masks[name].items():
            view = View(scene.world_to_camera[pose], K, 3 * width, 3 * height)
            rays = view.rays()
            whole = int((person.cast(np.broadcast_to(view.eye, rays.shape), rays).face >= 0).sum())
            seen = int(mask.sum())
            score[pose] = round(20.0 * seen * small**2 / max(1, whole)) / 20.0, seen
        found[name] = max(score, key=lambda pose: score[pose])
    return found


def faces_of_people(folder: Path) -> dict[str, tuple[int, int]]:
    """Person -> (first triangle, one past the last) in `Geometry.triangles`."""
    plan = json.loads((folder / "plan.json").read_text(encoding="utf-8"))
    with np.load(folder / "geometry" / "static.npz", allow_pickle=False) as data:
        at = len(data["triangles"])
    found: dict[str, tuple[int, int]] = {}
    for mover in plan["movers"]:
        if not mover["in_view"]:
            continue
        with np.load(folder / "geometry" / f"{mover['name']}.npz", allow_pickle=False) as data:
            count = len(data["triangles"])
        if mover["name"].startswith(PERSON):
            found[mover["name"]] = at, at + count
        at += count
    return found


def lassos(mask: NDArray[np.bool_], corner: float, sloppy: float, seed: int) -> list[list[list[float]]]:
    """Hand-drawn polygons around a mask [H, W], corners [x, y] in pixels, each up to `sloppy` pixels from the outline.

    Each part with at least a twentieth of the mask gets one polygon, with a corner every `corner` pixels.
    """
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    large = [outline for outline in outlines if cv2.contourArea(outline) >= 0.05 * mask.sum()]
    return [_drawn(outline[:, 0].astype(np.float64) + 0.5, corner, sloppy, seed + n) for n, outline in enumerate(large)]


def _drawn(outline: NDArray[np.float64], corner: float, sloppy: float, seed: int) -> list[list[float]]:
    """A closed outline [P, 2] as drawn by hand."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))])
    at = np.arange(0.0, length[-1], corner)
    corners = np.stack([np.interp(at, length, outline[:, axis]) for axis in (0, 1)], axis=1)
    generator = np.random.default_rng(seed)
    turn, far = generator.uniform(0.0, 2.0 * np.pi, len(at)), sloppy * np.sqrt(generator.uniform(0.0, 1.0, len(at)))
    return (corners + far[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)).tolist()


def overlap(found: NDArray[np.bool_], truth: NDArray[np.bool_]) -> float:
    """Intersection over union of two masks; 1 if both are empty."""
    return float((found & truth).sum() / max(1, (found | truth).sum())) if (found | truth).any() else 1.0


class Watch(Log):
    """A reporter that records when each frame with mattes is finished."""

    def __init__(self) -> None:
        super().__init__()
        self.began, self.at = time.perf_counter(), list[float]()

    def progress(self, stage: str, done: float, total: float, message: str = "") -> None:
        if stage == "making mattes" and done:
            self.at.append(time.perf_counter())

    def metric(self, stage: str, values: Any) -> None:
        """Does nothing: the benchmark computes its own figures."""


@dataclass
class MatteTake:
    """A take of an instant with a matte of each person visible in that person's lassoed frame."""

    folder: TakeFolder
    masks: dict[str, dict[int, NDArray[np.bool_]]]
    """Truth, as returned by `person_masks`."""
    lassoed: dict[str, int]
    """Person -> the lassoed pose."""
    seconds: dict[str, float]
    """{first, others}: until the first frame with mattes, and per further frame."""

    def matte(self, name: str, pose: int) -> NDArray[np.bool_]:
        """[H, W] a person's matte, thresholded at 0.5."""
        return read_matte(matte_file(self.folder, name, pose, "exr"), (0, 0)) > 0.5


def make(shot: Shot, scene: SyntheticScene, run: str, t_star: int, args: argparse.Namespace) -> MatteTake:
    """Freezes an instant if its take is missing, and always makes its people's mattes again."""
    take = f"mattes{t_star}"
    freeze_shot(shot, FreezeParams(run=run, take=take, t_star=t_star, step=args.every, only_missing=True), Log())
    folder = TakeFolder(shot.take(take))
    masks = person_masks(scene, t_star, frames_of(folder))
    at = dict.fromkeys(masks, t_star) if args.lasso_at == "t-star" else best_poses(scene, t_star, masks)
    masks = {name: of for name, of in masks.items() if of[at[name]].sum() >= LEAST}
    rows = [
        {"name": name, "frame": at[name], "polygon": polygon}
        for seed, name in enumerate(masks)
        for polygon in lassos(masks[name][at[name]], args.corner, args.sloppy, 100 * seed)
    ]
    shutil.rmtree(folder.mattes, ignore_errors=True)  # existing mattes would be skipped and take no time
    path = args.results.absolute() / f"lassos-{shot.root.stem}-{t_star}.json"
    write_json(path, {"mattes": rows})
    watch = Watch()
    make_mattes(shot, MatteParams(take=take, polygons=str(path)), watch)
    steps = np.diff(watch.at)
    seconds = (
        {"first": round(watch.at[0] - watch.began, 2), "others": round(float(steps.mean()), 3)} if len(steps) else {}
    )
    return MatteTake(folder, masks, {name: at[name] for name in masks}, seconds)


def judge(shot: Shot, scene: SyntheticScene, run: str, t_star: int, args: argparse.Namespace) -> list[dict[str, Any]]:
    """One row per person and judged pose: {t_star, person, pose, pixels, iou, first, others}."""
    take = make(shot, scene, run, t_star, args)
    found: list[dict[str, Any]] = []
    for name, of in take.masks.items():
        for pose, mask in of.items():
            if pose == take.lassoed[name] or mask.sum() < LEAST:
                continue
            row = {"t_star": t_star, "person": name, "pose": pose, "pixels": int(mask.sum())}
            found.append({**row, "iou": round(overlap(take.matte(name, pose), mask), 4), **take.seconds})
    return found


def table(found: dict[str, list[dict[str, Any]]]) -> list[str]:
    """Mean and worst intersection over union, and seconds, by scene and person, in Markdown."""
    lines = [
        "| scene | person | poses | mean | worst | first matte, s | later mattes, s |",
        "|---|---|---:|---:|---:|---:|---:|",
    ]
    for scene, rows in found.items():
        for person in sorted({row["person"] for row in rows}):
            of = [row for row in rows if row["person"] == person]
            lines.append(f"| {scene} | {person} | {_cells(of)} |")
    everything = [row for rows in found.values() for row in rows]
    return [*lines, f"| all | | {_cells(everything)} |"] if everything else lines


def _cells(rows: Sequence[dict[str, Any]]) -> str:
    overlaps = [row["iou"] for row in rows]
    first, later = (statistics.fmean(row[name] for row in rows) for name in ("first", "others"))
    return f"{len(rows)} | {statistics.fmean(overlaps):.3f} | {min(overlaps):.3f} | {first:.1f} | {later:.2f}"


def matte_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of every benchmark that lassoes people in synthetic scenes."""
    scene_arguments(parser)
    parser.add_argument("--seed", type=int, default=0, help="training seed")
    parser.add_argument(
        "--corner", type=float, default=8.0, help="distance in pixels along the outline between two corners of a lasso"
    )
    parser.add_argument(
        "--sloppy", type=float, default=3.0, help="largest distance in pixels of a corner from the outline"
    )
    parser.add_argument(
        "--lasso-at",
        choices=("most", "t-star"),
        default="most",
        help="frame in which the lasso is drawn: where most of the person is visible, or t*",
    )


@in_words
def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    matte_arguments(parser)
    args = parser.parse_args(argv)
    if args.cameras != "exact":
        raise ValueError("people are only known by exact cameras")
    found: dict[str, list[dict[str, Any]]] = {}
    for truth, runs in trained_scenes(args, [args.seed]):
        rows = found[truth.name] = [
            row
            for t_star in args.t_star or truth.t_stars
            for row in judge(truth.shot, truth.scene, runs[args.seed], t_star, args)
        ]
        write_json(args.results / f"mattes-{truth.name.replace(' ', '-')}.json", {"version": 1, "rows": rows})
    print("\n".join(["", *table(found)]))


if __name__ == "__main__":
    sys.exit(main())
