"""Picture of two combined instants against its rendered truth: `python -m benchmarks.two_instants SCENE ...`.

The full call is `python -m benchmarks.two_instants SCENE ... --results DIR`. SCENE and DIR are as for
`benchmarks.mattes`, which makes the takes and the mattes. For each ordered pair of instants (base, instant) and each
person visible in both lassoed frames, `combine` inserts the person as at `instant` into the take of `base`. The truth
is rendered from the scene with this one person at `instant`; this needs a Python with bpy (`--bpy`, or the one made by
set-up).

The loss of combining is the PSNR of the two separate takes minus that of the combined picture. Each pixel is assigned
to a take by `SAMPLES` squared rays: to the base if its instant shows the surfaces of the combined scene, else to the
instant if that does. The separate error of a pixel is that take's error against the truth of that take's instant. The
remaining pixels show a surface visible at neither instant: the person stands in front of somebody who moved, or was
hidden at `instant`. They are judged in the combined picture only, as *unknown*. Only poses with truth count.

Writes two-instants-NAME.json to DIR, and a picture of each frame (truth, combined, base, instant) to DIR/two-instants.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
from numpy.typing import NDArray

from benchmarks.detail_truth import trained_scenes
from benchmarks.mattes import LEAST, faces_of_people, make, matte_arguments, overlap
from benchmarks.report.metrics import psnr_of
from benchmarks.sources import Log, in_words
from benchmarks.synthetic.folder import SyntheticScene
from benchmarks.synthetic.make import find_bpy, render_pictures
from benchmarks.synthetic.rays import Hits, RayScene
from benchmarks.synthetic.regions import Geometry, View
from torch_backend.contract import CombineParams, TakeFolder
from torch_backend.footage.color import linear_to_srgb8
from torch_backend.footage.images import read_png, write_png
from torch_backend.freeze.exr import read_frozen_exr
from torch_backend.freeze.mattes.combined import combine
from torch_backend.freeze.take.folder import frames_of
from torch_backend.shot import Shot, write_json

SAMPLES = 3
"""Rays per side of a pixel. A pixel belongs to an instant only if all of its rays agree with that instant."""
SAME_METRES = 1e-3
"""Two hits of one ray closer than this in metres are one surface; people sway by more between two instants."""
BASE, INSTANT, UNKNOWN = range(3)
"""Owner of a pixel of the combined scene."""

Mask = NDArray[np.bool_]


def owners(scene: SyntheticScene, person: str, base: int, instant: int, pose: int) -> NDArray[np.uint8]:
    """[H, W] of `BASE`, `INSTANT`, `UNKNOWN`: the take whose truth equals the combined scene at a pose."""
    geometry, index = Geometry.load(scene.root), scene.frames.index
    first, last = faces_of_people(scene.root)[person]
    mixed = geometry.at(index(base))
    corners = np.unique(mixed.triangles[first:last])
    moved = mixed.vertices.copy()
    moved[corners] = geometry.at(index(instant)).vertices[corners]
    scenes = RayScene(moved, mixed.triangles), mixed, geometry.at(index(instant))
    view = View(scene.world_to_camera[pose], scene.K, scene.width, scene.height)
    shows = np.ones((2, view.height * view.width), bool)
    offsets = (np.arange(SAMPLES) + 0.5) / SAMPLES
    for dx, dy in itertools.product(offsets, offsets):
        rays = view.rays(dx, dy)
        truth, *each = (one.cast(np.broadcast_to(view.eye, rays.shape), rays) for one in scenes)
        shows &= np.stack([_same(truth, one) for one in each])
    return np.where(shows[0], BASE, np.where(shows[1], INSTANT, UNKNOWN)).astype(np.uint8).reshape(view.height, -1)


def _same(one: Hits, second: Hits) -> Mask:
    """[R] whether rays hit the same surface, or nothing, in two scenes."""
    near = np.abs(np.where(one.face < 0, 0.0, one.distance) - np.where(second.face < 0, 0.0, second.distance))
    return (one.face == second.face) & (near < SAME_METRES)


def rendered(scene: SyntheticScene, person: str, base: int, instant: int, args: argparse.Namespace) -> Path:
    """Folder of the pictures NNNNNN.png of `base` with one person at `instant`; missing pictures are rendered."""
    folder = args.results.absolute() / "two-instants" / f"{scene.name}-{person}-{base}-{instant}"
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("geometry", "textures", "meter.json"):
        if not (folder / name).exists():
            (folder / name).symlink_to(scene.root.absolute() / name)
    plan = json.loads((scene.root / "plan.json").read_text(encoding="utf-8"))
    start = f"truth/{base:06d}/"
    jobs = [job for job in plan["jobs"] if job["out"].startswith(start) and "box" not in job]
    elsewhen = {person: float(scene.frames.index(instant))}
    plan["jobs"] = [{**job, "out": job["out"].removeprefix(start), "elsewhen": elsewhen} for job in jobs]
    write_json(folder / "plan.json", plan)
    render_pictures(folder, find_bpy(args.bpy), lambda text: None)
    return folder


def picture_of(folder: TakeFolder, pose: int) -> NDArray[np.uint8]:
    """[H, W, 3] sRGB picture of a take's frame."""
    return linear_to_srgb8(np.clip(read_frozen_exr(folder.frame(pose)).rgba[..., :3], 0.0, 1.0))


def judge(
    shot: Shot, scene: SyntheticScene, person: str, takes: dict[int, TakeFolder], pair: tuple[int, int],
    args: argparse.Namespace,
) -> list[dict[str, Any]]:  # fmt: skip
    """One row per pose: {person, base, instant, pose, regions: {name: [pixels, squared error combined, separate]}}."""
    base, instant = pair
    name = f"two{base}-{instant}-{person}"
    replaced = f"{person}={takes[instant].root.name}"
    combine(shot, CombineParams(base=takes[base].root.name, things=replaced, take=name), Log())
    folder, pictures = TakeFolder(shot.take(name)), rendered(scene, person, base, instant, args)
    rows: list[dict[str, Any]] = []
    for pose in scene.poses:
        if pose not in frames_of(folder):
            continue
        owner, truth = owners(scene, person, base, instant, pose), read_png(pictures / f"{pose:06d}.png")
        shown, one, two = (picture_of(each, pose) for each in (folder, takes[base], takes[instant]))
        write_png(pictures / f"shown-{pose:06d}.png", np.concatenate([truth, shown, one, two], axis=1))
        error = _squares(shown, truth)
        separate = np.where(
            owner == BASE, _squares(one, scene.truth(base, pose)), _squares(two, scene.truth(instant, pose))
        )
        regions = {"whole": owner != UNKNOWN, "person": owner == INSTANT, "unknown": owner == UNKNOWN}
        found = {key: [int(of.sum()), float(error[of].sum()), float(separate[of].sum())] for key, of in regions.items()}
        rows.append({"person": person, "base": base, "instant": instant, "pose": pose, "regions": found})
    return rows


def _squares(one: NDArray[np.uint8], second: NDArray[np.uint8]) -> NDArray[np.float64]:
    """[H, W] mean squared difference of two pictures, in 0..1."""
    return np.square((one.astype(np.float64) - second) / 255.0).mean(-1)


def figures(rows: Sequence[dict[str, Any]], region: str) -> tuple[float, float] | None:
    """PSNR (combined, separate takes) of a region over the pixels of all poses; None if it is empty."""
    pixels, error, separate = np.sum([row["regions"][region] for row in rows], axis=0)
    return (psnr_of(error / pixels), psnr_of(separate / pixels)) if pixels else None


def table(found: dict[str, list[dict[str, Any]]]) -> list[str]:
    """Figures by scene, pair and person, in Markdown."""
    lines = [
        "| scene | base, instant | person | matte IoU | whole: separate, combined, loss "
        "| person: separate, combined, loss | unknown: share, combined |",
        "|---|---|---|---:|---:|---:|---:|",
    ]
    for scene, rows in found.items():
        for key in dict.fromkeys((row["base"], row["instant"], row["person"]) for row in rows):
            of = [row for row in rows if (row["base"], row["instant"], row["person"]) == key]
            iou = statistics.fmean(row["iou"] for row in of)
            cells = [_cell(figures(of, region)) for region in ("whole", "person")]
            pixels = {name: sum(row["regions"][name][0] for row in of) for name in ("whole", "unknown")}
            lone = figures(of, "unknown")
            unknown = f"{100.0 * pixels['unknown'] / sum(pixels.values()):.1f} %" + (f", {lone[0]:.2f}" if lone else "")
            lines.append(f"| {scene} | {key[0]}, {key[1]} | {key[2]} | {iou:.2f} | {' | '.join(cells)} | {unknown} |")
    return lines


def _cell(of: tuple[float, float] | None) -> str:
    return "" if of is None else f"{of[1]:.2f}, {of[0]:.2f}, {of[1] - of[0]:+.2f}"


@in_words
def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    matte_arguments(parser)
    parser.add_argument("--bpy", help="Python with bpy, for rendering the truth")
    args = parser.parse_args(argv)
    found: dict[str, list[dict[str, Any]]] = {}
    for truth, runs in trained_scenes(args, [args.seed]):
        scene, run = truth.scene, runs[args.seed]
        instants = {t: make(truth.shot, scene, run, t, args) for t in args.t_star or truth.t_stars}
        takes = {t: of.folder for t, of in instants.items()}
        rows = found[truth.name] = []
        for pair in itertools.permutations(takes, 2):
            for person in [name for name in instants[pair[0]].masks if name in instants[pair[1]].masks]:
                for row in judge(truth.shot, scene, person, takes, pair, args):
                    each = [
                        (instants[t].masks[person][row["pose"]], instants[t].matte(person, row["pose"])) for t in pair
                    ]
                    iou = [overlap(matte, mask) for mask, matte in each if mask.sum() >= LEAST]
                    rows.append({**row, "iou": statistics.fmean(iou) if iou else 1.0})
        write_json(args.results / f"two-instants-{truth.name.replace(' ', '-')}.json", {"version": 1, "rows": rows})
    print("\n".join(["", *table(found)]))


if __name__ == "__main__":
    sys.exit(main())
