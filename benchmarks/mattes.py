"""Mattes from one lasso against rendered truth: `python -m benchmarks.mattes SCENE ... --results DIR`.

SCENE is a folder of benchmarks/synthetic (seeds 0 to 9 to tune on, 100 to 109 to report on). Its shot with exact
cameras, an `auto` run and a take for each instant are made in DIR if they are missing. Truth are the pixels whose
centre shows a person, by rays through the scene's triangles.

Each person is lassoed once per instant, at the frame that shows the largest share of them (`--lasso-at t-star`: at
that of the instant, which may show a sliver). The lasso is the outline of the truth there, a corner every `--corner`
pixels, each moved by up to `--sloppy` pixels in any direction; a person whom something parts has a polygon for each
part of a twentieth or more. Judged are all other frames of the take (every `--every`-th of the clip, t* among them)
that show at least `LEAST` pixels of the person: intersection over union of truth and the matte, cut at half. Seconds
are those of the job up to its first matte, loading of the run included, and of each further frame with all its mattes.

DIR gets mattes-NAME.json.
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
"""Pixels of a person below which a pose says little: half a pixel of outline is a tenth of it."""
WIDE = 120
"""Width of the pictures, in pixels, on which silhouettes are counted."""
PERSON = "person"
"""What the names of movers that are people begin with."""


def person_masks(scene: SyntheticScene, t_star: int, poses: Sequence[int]) -> dict[str, dict[int, NDArray[np.bool_]]]:
    """Person -> pose -> [H, W]: the pixels that show them while time stands still at frame `t_star`."""
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
    """Person -> the pose that shows most of them: of those with the largest share seen, to a twentieth, the nearest.

    The share is that of their silhouette, as nothing hid it and as the frame went on for its size on all sides.
    """
    geometry, small = Geometry.load(scene.root), WIDE / scene.width
    standing, K = geometry.at(scene.frames.index(t_star)), scene.K * [[small], [small], [1.0]]
    width, height = round(scene.width * small), round(scene.height * small)
    K[:2, 2] += width, height
    found: dict[str, int] = {}
    for name, (first, last) in faces_of_people(scene.root).items():
        alone = RayScene(standing.vertices, standing.triangles[first:last])
        score: dict[int, tuple[float, int]] = {}
        for pose, mask in masks[name].items():
            view = View(scene.world_to_camera[pose], K, 3 * width, 3 * height)
            rays = view.rays()
            whole = int((alone.cast(np.broadcast_to(view.eye, rays.shape), rays).face >= 0).sum())
            seen = int(mask.sum())
            score[pose] = round(20.0 * seen * small**2 / max(1, whole)) / 20.0, seen
        found[name] = max(score, key=lambda pose: score[pose])
    return found


def faces_of_people(folder: Path) -> dict[str, tuple[int, int]]:
    """Person -> the first of their triangles in `Geometry.triangles`, and the one after the last."""
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
    """Polygons, corners [x, y] in pixels, that somebody draws around a mask [H, W], up to `sloppy` pixels off.

    One for each part of a twentieth of the mask or more, with a corner every `corner` pixels.
    """
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    large = [outline for outline in outlines if cv2.contourArea(outline) >= 0.05 * mask.sum()]
    return [_drawn(outline[:, 0].astype(np.float64) + 0.5, corner, sloppy, seed + n) for n, outline in enumerate(large)]


def _drawn(outline: NDArray[np.float64], corner: float, sloppy: float, seed: int) -> list[list[float]]:
    """A closed outline [P, 2] as somebody draws it."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))])
    at = np.arange(0.0, length[-1], corner)
    corners = np.stack([np.interp(at, length, outline[:, axis]) for axis in (0, 1)], axis=1)
    generator = np.random.default_rng(seed)
    turn, far = generator.uniform(0.0, 2.0 * np.pi, len(at)), sloppy * np.sqrt(generator.uniform(0.0, 1.0, len(at)))
    return (corners + far[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)).tolist()


def overlap(found: NDArray[np.bool_], truth: NDArray[np.bool_]) -> float:
    """Intersection over union of two masks; 1 where both are empty."""
    return float((found & truth).sum() / max(1, (found | truth).sum())) if (found | truth).any() else 1.0


class Watch(Log):
    """A reporter that notes when frames with mattes were done."""

    def __init__(self) -> None:
        super().__init__()
        self.began, self.at = time.perf_counter(), list[float]()

    def progress(self, stage: str, done: float, total: float, message: str = "") -> None:
        if stage == "making mattes" and done:
            self.at.append(time.perf_counter())

    def metric(self, stage: str, values: Any) -> None:
        """Nothing: figures are the benchmark's own."""


@dataclass
class MatteTake:
    """A take of an instant with a matte of each person whom its lassoed frame shows."""

    folder: TakeFolder
    masks: dict[str, dict[int, NDArray[np.bool_]]]
    """Truth, as of `person_masks`."""
    lassoed: dict[str, int]
    """Person -> the pose at which they were lassoed."""
    seconds: dict[str, float]
    """{first, others}: until the first frame with mattes, and per further frame."""

    def matte(self, name: str, pose: int) -> NDArray[np.bool_]:
        """[H, W]: a person's matte, cut at half."""
        return read_matte(matte_file(self.folder, name, pose, "exr"), (0, 0)) > 0.5


def make(shot: Shot, scene: SyntheticScene, run: str, t_star: int, args: argparse.Namespace) -> MatteTake:
    """Freezes an instant if its take is missing, and makes the mattes of its people anew."""
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
    shutil.rmtree(folder.mattes, ignore_errors=True)  # kept ones would take no time
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
    """One row per person and pose that is judged: {t_star, person, pose, pixels, iou, first, others}."""
    made = make(shot, scene, run, t_star, args)
    found: list[dict[str, Any]] = []
    for name, of in made.masks.items():
        for pose, mask in of.items():
            if pose == made.lassoed[name] or mask.sum() < LEAST:
                continue
            row = {"t_star": t_star, "person": name, "pose": pose, "pixels": int(mask.sum())}
            found.append({**row, "iou": round(overlap(made.matte(name, pose), mask), 4), **made.seconds})
    return found


def table(found: dict[str, list[dict[str, Any]]]) -> list[str]:
    """Mean and worst intersection over union, and seconds, by scene and person, in Markdown."""
    lines = [
        "| scene | person | poses | mean | worst | first matte, s | others, s |",
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
    first, others = (statistics.fmean(row[name] for row in rows) for name in ("first", "others"))
    return f"{len(rows)} | {statistics.fmean(overlaps):.3f} | {min(overlaps):.3f} | {first:.1f} | {others:.2f}"


def matte_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of every benchmark that lassoes people in synthetic scenes."""
    scene_arguments(parser)
    parser.add_argument("--seed", type=int, default=0, help="of the training")
    parser.add_argument("--corner", type=float, default=8.0, help="pixels of outline between two corners of a lasso")
    parser.add_argument("--sloppy", type=float, default=3.0, help="pixels by which a corner may be off the outline")
    parser.add_argument("--lasso-at", choices=("most", "t-star"), default="most", help="which frame of the take")


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
