"""Plate detail against rendered truth: `python -m benchmarks.detail_truth SCENE ... --results DIR`.

SCENE is a folder of benchmarks/synthetic (seeds 0 to 9 for tuning, 100 to 109 for reporting). Its shot, with exact
cameras by default, and an `auto` run are made in DIR if missing. Prints mean PSNR by region over all poses and instants
with truth, for splats -> developed -> withheld (without the plate of the pose) -> delivered, and the gains. Prints
ST-LPIPS as well if its weights are installed; this metric tolerates shifts of two pixels. For scenes with a small mover
it also prints the mover's recall (`benchmarks/report/things.py`). The pose of t* itself is excluded, because plate t*
is its truth. Writes truth-NAME.json to DIR.

Pictures are judged at the run's size, or with `--delivered` at plate size, as delivered to the artist.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import torch
from torch import Tensor

from benchmarks.bench import RunSpec, hold_out_phase, train_spec
from benchmarks.detail import develop_argument
from benchmarks.detail_clip import DetailClip, over
from benchmarks.report.metrics import WHOLE, score
from benchmarks.report.records import DELIVERED, DEVELOPED, SPLATS, WITHHELD
from benchmarks.report.setting import plain
from benchmarks.report.things import overall, recall_of
from benchmarks.report.truth import HELD, REGIONS, TruthScene
from benchmarks.sources import SyntheticTruth, in_words, load_synthetic
from torch_backend.shot import write_json
from torch_backend.train import load_run

VARIANTS = (SPLATS, DEVELOPED, WITHHELD, DELIVERED)
PERCEIVED = "st_lpips"
"""Key of a row: figures by ST-LPIPS, lower is better."""
RECALLED = "recalled"
"""Key of a row: {variant: {thing: [pixels that show it, pixels that should]}}; {} for scenes without a small mover."""


def trained(truth: TruthScene, source: str, seed: int, iterations: int, gaussians: int) -> str:
    """Name of the scene's run, trained if missing. RuntimeError if training fails."""
    spec = RunSpec(
        source, truth.key, "auto", "support", "preview", seed=seed, iterations=iterations, max_gaussians=gaussians,
        holdout_phase=hold_out_phase(truth),
    )  # fmt: skip
    code, _, _ = train_spec(spec, truth, 1)
    if code:
        raise RuntimeError(f"the run of {truth.name} could not be trained (exit code {code})")
    return spec.run_name


def trained_scenes(args: argparse.Namespace, seeds: Sequence[int]) -> Iterator[tuple[SyntheticTruth, dict[int, str]]]:
    """Yields each scene of `scene_arguments` and the names of its runs by training seed. Trains missing runs."""
    for folder in args.scenes:
        truth, source = load_synthetic(folder, args.results, args.cameras), f"{args.cameras}:{folder.absolute()}"
        yield truth, {seed: trained(truth, source, seed, args.iterations, args.gaussians) for seed in seeds}


def judge(
    truth: TruthScene, run_name: str, t_stars: Sequence[int], every: int = 1, develop: bool = True, width: int = 0
) -> list[dict[str, Any]]:
    """Rows for every pose of every instant: [{t_star, pose, variant: {region: dB or None}, `PERCEIVED`, `RECALLED`}].

    Without development, `developed` equals `splats`. The pose of t* is excluded: its delivered frame is plate t*, which
    is byte for byte the truth. `width`: pixels of the pictures; 0 uses the plates' size.
    """
    clip, rows = DetailClip(truth.shot, run_name, width, develop), []
    size = clip.width, clip.height
    for t_star in t_stars:
        for pose in [pose for pose in truth.poses(t_star, []) if pose != t_star][::every]:
            target, regions = truth.truth(t_star, pose, *size), truth.regions(t_star, pose, *size)
            behind, pictures = truth.behind(t_star, pose, *size), _pictures(clip, pose, t_star)
            scores = {name: score(image, target, regions) for name, image in pictures.items()}
            row: dict[str, Any] = {"t_star": t_star, "pose": pose}
            row |= {v: {region: of["psnr_db"] for region, of in found.items()} for v, found in scores.items()}
            row[PERCEIVED] = {v: {region: of[PERCEIVED] for region, of in found.items()} for v, found in scores.items()}
            row[RECALLED] = {name: recall_of(behind, image, target, regions) for name, image in pictures.items()}
            rows.append(row)
        print(f"{truth.name}, t* {t_star}: {gains_text(means(rows)[WHOLE])} dB whole so far", flush=True)
    return rows


def _pictures(clip: DetailClip, pose: int, t_star: int) -> dict[str, Tensor]:
    """A frozen frame in each of `VARIANTS`, [H, W, 3] in 0..1."""
    field, image = clip.splats(pose, t_star, clip.field(t_star)), clip.splats(pose, t_star)
    withheld, delivered = (clip.view(pose, t_star, without, image) for without in ((pose,), ()))
    return {
        SPLATS: over(field.color, field.alpha), DEVELOPED: delivered.splats, WITHHELD: withheld.picture,
        DELIVERED: delivered.picture,
    }  # fmt: skip


def perceived(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """`means` of ST-LPIPS; empty without its weights."""
    return means([row[PERCEIVED] for row in rows])


def means(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """{region: {variant: mean dB over poses where the region is not empty}}; regions that are always empty are left
    out."""
    found = {}
    for region in (WHOLE, *REGIONS, HELD):
        known = [row for row in rows if row[SPLATS].get(region) is not None]
        if known:
            found[region] = {v: statistics.fmean(row[v][region] for row in known) for v in VARIANTS}
    return found


def gains_text(of: dict[str, float]) -> str:
    """Text of the dB of each of `VARIANTS`."""
    return " -> ".join(f"{of[v]:.2f}" for v in VARIANTS)


def table(found: dict[str, dict[str, dict[str, float]]]) -> list[str]:
    """Means by scene and region in Markdown."""
    lines = [
        "| scene | region | splats -> developed -> withheld -> delivered, dB | developed | withheld | delivered |",
        "|---|---|---|---:|---:|---:|",
    ]
    for scene, regions in found.items():
        for region, of in regions.items():
            gains = [f"{of[v] - of[SPLATS]:+.2f}" for v in VARIANTS[1:]]
            lines.append(f"| {scene} | {region} | {gains_text(of)} | {' | '.join(gains)} |")
    return lines


def perceived_table(found: dict[str, dict[str, dict[str, float]]]) -> list[str]:
    """Mean ST-LPIPS by scene and region in Markdown; [] if it was not measured."""
    lines = [
        f"| {scene} | {region} | {' -> '.join(f'{of[v]:.4f}' for v in VARIANTS)} |"
        for scene, regions in found.items()
        for region, of in regions.items()
    ]
    head = ["", "| scene | region | ST-LPIPS, lower is better |", "|---|---|---|"]
    return [*head, *lines] if lines else []


def recalls(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, tuple[float | None, float | None]]]:
    """{thing: {variant: share of its pixels that are shown, over all poses and in the worst one}}."""
    objects = dict.fromkeys(name for row in rows for of in row[RECALLED].values() for name in of)
    return {
        name: {v: overall([row[RECALLED][v][name] for row in rows if name in row[RECALLED][v]]) for v in VARIANTS}
        for name in objects
    }


def recall_table(found: dict[str, dict[str, dict[str, tuple[float | None, float | None]]]]) -> list[str]:
    """Recall by scene and thing in Markdown; [] without a small mover."""
    lines = [
        f"| {scene} | {name} | {' -> '.join(' / '.join(plain(s, 3) for s in of[v]) for v in VARIANTS)} |"
        for scene, objects in found.items()
        for name, of in objects.items()
    ]
    head = ["", "| scene | object | recall: all poses / worst pose |", "|---|---|---|"]
    return [*head, *lines] if lines else []


def scene_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of every benchmark that trains on synthetic scenes and judges their frozen frames."""
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE")
    parser.add_argument("--results", type=Path, required=True, metavar="DIR")
    parser.add_argument("--cameras", choices=("exact", "solved"), default="exact")
    parser.add_argument(
        "--t-star", type=int, nargs="+", metavar="N", help="judge these instants (default: all of the scene)"
    )
    parser.add_argument("--every", type=int, default=1, metavar="K", help="judge every K-th pose")
    parser.add_argument("--iterations", type=int, default=1500)
    parser.add_argument("--gaussians", type=int, default=10_000)


@in_words
def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    scene_arguments(parser)
    parser.add_argument("--seed", type=int, default=0, help="training seed")
    develop_argument(parser)
    parser.add_argument("--delivered", action="store_true", help="judge at the resolution of the plates")
    parser.add_argument("--train-only", action="store_true")
    args = parser.parse_args(argv)
    found, seen, recalled, results = {}, {}, {}, args.results.absolute()
    for truth, runs in trained_scenes(args, [args.seed]):
        run = runs[args.seed]
        print(f"{truth.name}: {truth.shot.run(run)}", flush=True)
        if args.train_only:
            continue
        width = 0 if args.delivered else load_run(truth.shot, run, torch.device("cpu")).width
        rows = judge(truth, run, args.t_star or truth.t_stars, args.every, args.develop == "on", width)
        found[truth.name], seen[truth.name], recalled[truth.name] = means(rows), perceived(rows), recalls(rows)
        name = truth.name.replace(" ", "-")
        facts = {"version": 1, "scene": truth.name, "run": str(truth.shot.run(run))}
        write_json(results / f"truth-{name}.json", {**facts, "mean": found[truth.name], "frames": rows})
    if found:
        print("\n".join(["", *table(found), *perceived_table(seen), *recall_table(recalled)]))


if __name__ == "__main__":
    sys.exit(main())
