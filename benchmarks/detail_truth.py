"""Plate detail against rendered truth: `python -m benchmarks.detail_truth SCENE ... --results DIR`.

SCENE is a folder of benchmarks/synthetic (seeds 0 to 9 to tune on, 100 to 109 to report on). Its shot, with exact
cameras, and an `auto` run are made in DIR if they are not there. Printed is the mean PSNR of all poses and instants
that have a truth, splats -> developed -> plate of the pose withheld -> delivered, by region, and what is gained; and
their ST-LPIPS, if its weights are there: a metric of pictures that forgives a shift by two pixels. Of scenes with a
small mover it also tells how much of that is there (`benchmarks/report/things.py`). The pose of t* itself does not
count: plate t* is its truth. DIR gets truth-NAME.json.

Pictures are judged at the size of the run, or with `--delivered` as an artist gets them: at that of the plates.
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
from benchmarks.detail_clip import DetailClip, over
from benchmarks.report.metrics import WHOLE, score
from benchmarks.report.records import DELIVERED, DEVELOPED, SPLATS, WITHHELD
from benchmarks.report.things import overall, recall_of
from benchmarks.report.truth import HELD, REGIONS, TruthScene
from benchmarks.sources import SyntheticTruth, in_words, load_synthetic
from torch_backend.contract import SWITCH
from torch_backend.shot import write_json
from torch_backend.train import load_run

VARIANTS = (SPLATS, DEVELOPED, WITHHELD, DELIVERED)
PERCEIVED = "st_lpips"
"""In a row: the same by ST-LPIPS; less is better."""
RECALLED = "recalled"
"""In a row: {variant: {thing: [pixels that show it, pixels that should]}}, {} of scenes without a small mover."""


def trained(truth: TruthScene, source: str, seed: int, iterations: int, gaussians: int) -> str:
    """Name of the scene's run, trained first if it is not. RuntimeError if that fails."""
    spec = RunSpec(
        source, truth.key, "auto", "support", "preview", seed=seed, iterations=iterations, max_gaussians=gaussians,
        holdout_phase=hold_out_phase(truth),
    )  # fmt: skip
    code, _, _ = train_spec(spec, truth, 1)
    if code:
        raise RuntimeError(f"the run of {truth.name} could not be trained (exit code {code})")
    return spec.run_name


def trained_scenes(args: argparse.Namespace, seeds: Sequence[int]) -> Iterator[tuple[SyntheticTruth, dict[int, str]]]:
    """Each scene of `scene_arguments`, and the names of its runs by training seed; what is missing is trained."""
    for folder in args.scenes:
        truth, source = load_synthetic(folder, args.results, args.cameras), f"{args.cameras}:{folder.absolute()}"
        yield truth, {seed: trained(truth, source, seed, args.iterations, args.gaussians) for seed in seeds}


def judge(
    truth: TruthScene, run_name: str, t_stars: Sequence[int], every: int = 1, develop: bool = True, width: int = 0
) -> list[dict[str, Any]]:
    """Every pose of every instant: [{t_star, pose, variant: {region: dB or None}, `PERCEIVED`, `RECALLED`}].

    Not developed is as splats are. But for the pose of t* itself: what is delivered there is plate t*, which is the
    truth to the byte. `width`: pixels of the pictures; 0: the plates' own.
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
    """As `means`, of ST-LPIPS; empty where its weights are missing."""
    return means([row[PERCEIVED] for row in rows])


def means(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """{region: {variant: mean dB over the poses in which the region is not empty}}; regions that never are."""
    found = {}
    for region in (WHOLE, *REGIONS, HELD):
        known = [row for row in rows if row[SPLATS].get(region) is not None]
        if known:
            found[region] = {v: statistics.fmean(row[v][region] for row in known) for v in VARIANTS}
    return found


def gains_text(of: dict[str, float]) -> str:
    """Each of `VARIANTS`."""
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
    """Mean ST-LPIPS by scene and region in Markdown; nothing where it was not measured."""
    lines = [
        f"| {scene} | {region} | {' -> '.join(f'{of[v]:.4f}' for v in VARIANTS)} |"
        for scene, regions in found.items()
        for region, of in regions.items()
    ]
    head = ["", "| scene | region | ST-LPIPS, less is better |", "|---|---|---|"]
    return [*head, *lines] if lines else []


def recalls(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, tuple[float | None, float | None]]]:
    """{thing: {variant: share of its pixels that is there, in all poses and in the worst}}."""
    things = dict.fromkeys(thing for row in rows for of in row[RECALLED].values() for thing in of)
    return {
        thing: {v: overall([row[RECALLED][v][thing] for row in rows if thing in row[RECALLED][v]]) for v in VARIANTS}
        for thing in things
    }


def recall_table(found: dict[str, dict[str, dict[str, tuple[float | None, float | None]]]]) -> list[str]:
    """Recall by scene and thing in Markdown; nothing where there is no small mover."""
    lines = [
        f"| {scene} | {thing} | {' -> '.join(' / '.join(_share(s) for s in of[v]) for v in VARIANTS)} |"
        for scene, things in found.items()
        for thing, of in things.items()
    ]
    head = ["", "| scene | thing | recall: all poses / the worst |", "|---|---|---|"]
    return [*head, *lines] if lines else []


def _share(share: float | None) -> str:
    return "–" if share is None else f"{share:.3f}"


def scene_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of every benchmark that trains on synthetic scenes and judges their frozen frames."""
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE")
    parser.add_argument("--results", type=Path, required=True, metavar="DIR")
    parser.add_argument("--cameras", choices=("exact", "solved"), default="exact")
    parser.add_argument("--t-star", type=int, nargs="+", metavar="N", help="only these")
    parser.add_argument("--every", type=int, default=1, metavar="K", help="only every K-th pose")
    parser.add_argument("--iterations", type=int, default=1500)
    parser.add_argument("--gaussians", type=int, default=10_000)


@in_words
def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    scene_arguments(parser)
    parser.add_argument("--seed", type=int, default=0, help="of the training")
    parser.add_argument("--develop", default="on", choices=SWITCH, help="off: instants stay as the run has them")
    parser.add_argument("--delivered", action="store_true", help="judge at the size of the plates")
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
