"""What F is worth: frozen still pixels judged by plates and by truth. `python -m benchmarks.still_truth SCENE ...`

F holds a frozen frame against the plate of its pose where motion mattes see nothing move (`benchmarks.model`). People
who hold still sway by less than mattes see: a frozen frame that shows them as they stood at t* then differs from the
plate, and a model without time, which shows their mean, differs less. On a clip nobody can tell that from harm. In a
scene of benchmarks/synthetic both can be measured: on the very same pixels, a frame is held against the plate of its
pose, as F does, and against the frozen truth.

`auto` and `static` are trained for equal steps, in DIR, if they are not there; every 8th frame is held out, the fifth
first, so that half of the poses that have a truth are none of training's. Only those are judged, at least a quarter of
the clip from t*, at the size of the run, on the pixels that F counts for both. DIR gets still-NAME.json.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import torch
from torch import Tensor

from benchmarks.bench import RunSpec, train_spec
from benchmarks.detail_clip import DetailClip, over
from benchmarks.detail_figures import induced_places, inside, sampled, still_pixels
from benchmarks.sources import load_source
from torch_backend.contract import JobError
from torch_backend.freeze.frozen import FrozenGaussians
from torch_backend.native import default_threads
from torch_backend.report.metrics import psnr_of
from torch_backend.report.truth import TruthScene
from torch_backend.shot import write_json
from torch_backend.train import load_run

METHODS = {"auto": "support", "static": "none"}
"""Compared, with what supervises them."""
KINDS = ("field", "developed")
"""As trained, and as a freeze develops it."""
PHASE = 4
"""Which of every 8 frames are held out: of those that have a truth, but no instant."""
_MARGIN = 8 / 640


def runs_of(truth: TruthScene, source: str, args: argparse.Namespace, seed: int) -> dict[str, DetailClip]:
    """Method -> its run, trained first if it is not. RuntimeError if that fails."""
    found = {}
    for method, supervision in METHODS.items():
        spec = RunSpec(
            source, truth.key, method, supervision, "preview", seed=seed, iterations=args.iterations,
            max_gaussians=args.gaussians, holdout_phase=PHASE,
        )  # fmt: skip
        code, _, _ = train_spec(spec, truth, 1)
        if code:
            raise RuntimeError(f"the run of {truth.name} could not be trained (exit code {code})")
        width = load_run(truth.shot, spec.run_name).width
        found[method] = DetailClip(truth.shot, spec.run_name, width)
    return found


def counted(clip: DetailClip, frozen: FrozenGaussians, pose: int, t_star: int) -> Tensor:
    """bool [H, W]: the pixels that F counts of a frozen frame."""
    own, of_t_star = clip.matte(pose), clip.matte(t_star)
    if own is None or of_t_star is None:
        raise ValueError("the shot has no motion mattes: solve it anew")
    image = clip.splats(pose, t_star, frozen)
    places, depth = induced_places(image.depth, *clip.camera(pose), *clip.camera(t_star))
    known = inside(places, clip.width, clip.height, 0.0) & (depth > 0)
    mover = torch.where(known, sampled(of_t_star, places, nearest=True), 0.0) > 0.75
    return still_pixels(own, mover, max(1, round(_MARGIN * clip.width)))


def judge(truth: TruthScene, clips: dict[str, DetailClip], t_stars: Sequence[int]) -> list[dict[str, Any]]:
    """[{t_star, pose, kind, and what `compared` says}]."""
    rows: list[dict[str, Any]] = []
    first = next(iter(clips.values()))
    size, far = (first.width, first.height), len(first.frames) / 4
    for t_star in t_stars:
        poses = [pose for pose in truth.poses(t_star, []) if pose in first.held_out() and abs(pose - t_star) >= far]
        for kind in KINDS:
            scenes = {
                name: clip.field(t_star) if kind == "field" else clip.frozen(t_star) for name, clip in clips.items()
            }
            for pose in poses:
                where = torch.stack([counted(clips[name], s, pose, t_star) for name, s in scenes.items()]).all(0)
                target, moves = truth.truth(t_star, pose, *size), truth.regions(t_star, pose, *size)["moving"]
                images = {name: clips[name].splats(pose, t_star, scene) for name, scene in scenes.items()}
                shown = {name: over(image.color, image.alpha) for name, image in images.items()}
                row = {"t_star": t_star, "pose": pose, "kind": kind}
                row |= compared(shown, first.plate(pose), target, where, moves)
                rows.append(row)
    return rows


def compared(shown: dict[str, Tensor], plate: Tensor, target: Tensor, where: Tensor, moves: Tensor) -> dict[str, Any]:
    """{sways, method: {plate, truth, held, sway}} of the same frozen frame by several methods, in dB.

    Args:
        shown: method -> [H, W, 3]. `plate` and the frozen truth `target` are as large.
        where: bool [H, W], the pixels that F counts.
        moves: bool [H, W], what moves by truth. `sways` is its share of what is counted; `held` and `sway` are `truth`
            on the pixels that do not and on those that do; None where these are too few.
    """
    row: dict[str, Any] = {"sways": float((where & moves).sum() / where.sum().clamp_min(1))}
    for method, image in shown.items():
        row[method] = {
            "plate": _psnr(image, plate, where), "truth": _psnr(image, target, where),
            "held": _psnr(image, target, where & ~moves), "sway": _psnr(image, target, where & moves),
        }  # fmt: skip
    return row


def _psnr(image: Tensor, target: Tensor, where: Tensor) -> float | None:
    error = (image.clamp(0.0, 1.0) - target).double().square().mean(2)[where]
    return psnr_of(float(error.mean())) if len(error) > 50 else None


def gains(rows: Sequence[dict[str, Any]], kind: str, by: str) -> list[float]:
    """dB by which `auto` is ahead of `static`, frame by frame."""
    pairs = [(row["auto"][by], row["static"][by]) for row in rows if row["kind"] == kind]
    return [auto - static for auto, static in pairs if auto is not None and static is not None]


def _text(values: Sequence[float]) -> str:
    if not values:
        return "-"
    error = statistics.stdev(values) / len(values) ** 0.5 if len(values) > 1 else float("nan")
    return f"{statistics.fmean(values):+.2f} +- {error:.2f}"


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; returns an exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+", metavar="SCENE")
    parser.add_argument("--results", type=Path, required=True, metavar="DIR")
    parser.add_argument("--iterations", type=int, default=2000)
    parser.add_argument("--gaussians", type=int, default=0, help="budget (0: the preset's)")
    parser.add_argument("--seeds", type=int, default=2, help="training seeds 0 to N - 1")
    args = parser.parse_args(argv)
    torch.set_num_threads(default_threads())
    print("`auto` less `static`, dB: frozen still pixels by plates (F) | by truth | of them held still | that sway")
    for folder in args.scenes:
        rows: list[dict[str, Any]] = []
        try:
            truth = load_source(f"exact:{folder}", args.results)
            for seed in range(args.seeds):
                found = judge(truth, runs_of(truth, f"exact:{folder}", args, seed), truth.t_stars)
                rows += [{"seed": seed, **row} for row in found]
        except (JobError, OSError, RuntimeError, ValueError) as error:
            print(f"{folder}: {error}", file=sys.stderr)
            return 1
        write_json(args.results / f"still-{truth.name.replace(' ', '-')}.json", {"rows": rows})
        sways = statistics.fmean(row["sways"] for row in rows)
        for kind in KINDS:
            of = " | ".join(_text(gains(rows, kind, by)) for by in ("plate", "truth", "held", "sway"))
            print(f"{truth.name}, {kind}: {of} ({100 * sways:.1f} % of them sway)", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
