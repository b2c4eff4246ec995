"""What depth maps are worth: `python -m benchmarks.depth_maps SCENE ... --results DIR`.

SCENE is a folder of benchmarks/synthetic. Of each frame of its clip a depth map is made from truth, times 0.4, plus
0.1, with 2 % noise, as 16-bit PNG. For each training seed a `preview` run is trained without and with these maps (exact
cameras). Judged are the depth that takes write (`benchmarks.depth`) and the pictures (`benchmarks.detail_truth`), each
in the region that moves and in the one that stands still. DIR gets depth-maps-NAME.json.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import cv2
import numpy as np

from benchmarks import depth as depth_bench
from benchmarks import detail_truth
from benchmarks.report.records import DELIVERED, SPLATS
from benchmarks.sources import Log, SyntheticTruth, in_words, load_synthetic
from benchmarks.synthetic.folder import SyntheticScene
from torch_backend.contract import TrainParams
from torch_backend.shot import make_folder, write_atomic, write_json
from torch_backend.train import train_shot

SCALE, SHIFT, NOISE = 0.4, 0.1, 0.02
"""Of the maps: what truth in metres is multiplied by, what is added, and the noise as a share of depth."""
FARTHEST = 100.0
"""Metres beyond which a map holds nothing, sky included: a sensor's range, and what 16 bits hold."""


def write_maps(scene: SyntheticScene, folder: Path, seed: int = 0) -> Path:
    """Writes a depth map of every frame of the clip, and returns their folder."""
    make_folder(folder)
    noise = np.random.default_rng(seed)
    for frame in scene.frames:
        metres = scene.frame_depth(frame).astype(np.float64)
        metres = metres * (1.0 + NOISE * noise.standard_normal(metres.shape))
        values = np.where(metres < FARTHEST, SCALE * metres + SHIFT, 0.0) / (SCALE * FARTHEST + SHIFT) * 65535.0
        packed, data = cv2.imencode(".png", np.rint(np.clip(values, 0.0, 65535.0)).astype(np.uint16))
        if not packed:
            raise OSError(f"the depth map of frame {frame} cannot be packed as PNG")
        write_atomic(folder / f"{frame:06d}.png", data.tobytes())
    return folder


def judged(truth: SyntheticTruth, run: str, every: int, t_stars: Sequence[int]) -> dict[str, Any]:
    """Depth and pictures of a run: {region: {median, beyond, splats_db, delivered_db}}."""
    depths = depth_bench.judge(truth, run, t_stars, every)
    pictures = detail_truth.means(detail_truth.judge(truth, run, t_stars, every))
    found: dict[str, Any] = {}
    for region, of in (("moving", "moving"), ("still", "static")):
        found[region] = {name: depths[region][name] for name in ("median", "beyond", "within_2_sigma")}
        found[region] |= {f"{name}_db": pictures.get(of, {}).get(name) for name in (SPLATS, DELIVERED)}
    return found


def table(found: dict[str, dict[str, Any]]) -> list[str]:
    """{scene and seed: {without, with: `judged`}} in Markdown."""
    lines = [
        "| scene, seed | region | median error, % | beyond 1 %, % | splats, dB | delivered, dB |",
        "|---|---|---:|---:|---:|---:|",
    ]
    for name, of in found.items():
        for region in ("moving", "still"):
            one, other = of["without"][region], of["with"][region]
            cells = (
                f"{unit * one[key]:.2f} to {unit * other[key]:.2f}" if None not in (one[key], other[key]) else "–"
                for key, unit in (("median", 100), ("beyond", 100), (f"{SPLATS}_db", 1), (f"{DELIVERED}_db", 1))
            )
            lines.append(f"| {name} | {region} | {' | '.join(cells)} |")
    return lines


@in_words
def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+", metavar="SCENE")
    parser.add_argument("--results", type=Path, required=True, metavar="DIR")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1], metavar="N", help="of the trainings")
    parser.add_argument("--t-star", type=int, nargs="*", default=[], metavar="N", help="only these instants")
    parser.add_argument("--every", type=int, default=3, metavar="N", help="judge every n-th pose")
    parser.add_argument("--iterations", type=int, default=0, metavar="N", help="training steps; 0: the preset's")
    args = parser.parse_args(argv)
    results, found = args.results.absolute(), dict[str, dict[str, Any]]()
    for folder in args.scenes:
        truth = load_synthetic(folder, results)
        maps = write_maps(SyntheticScene.load(folder), results / "maps" / truth.name.replace(" ", "-"))
        for seed in args.seeds:
            of: dict[str, Any] = {}
            for way, source in (("without", ""), ("with", str(maps))):
                run = f"maps-{way}-{seed}"
                params = TrainParams(run=run, seed=seed, iterations=args.iterations, depth=source)
                train_shot(truth.shot, params, Log())
                of[way] = judged(truth, run, args.every, args.t_star or truth.t_stars)
            found[f"{truth.name}, {seed}"] = of
        write_json(results / f"depth-maps-{truth.name.replace(' ', '-')}.json", {"version": 1, "found": found})
    print("\n".join(["", *table(found)]))


if __name__ == "__main__":
    sys.exit(main())
