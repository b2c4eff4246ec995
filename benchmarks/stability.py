"""Stability over whole runs: many seeds of every host on one tiny scene, seconds each.

    taskset -c 0 python -m benchmarks.stability SHOT [--seeds 20] [--results FILE]

SHOT is a solved shot folder, which stays unchanged, or a scene of benchmarks/synthetic, whose shot with exact cameras
is made in FILE's folder. Every run uses the product's loop, schedules, growth and gate with the numbers in `CHANGES`.
FILE keeps each finished run, so an interrupted benchmark continues where it stopped. The table gives held-out PSNR at
the frames' own times, and numbers of steps skipped as non-finite, of repair warnings, and of diverged runs, which ended
more than 3 dB below the median of their row.
"""

import argparse
import dataclasses
import os
import pathlib
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")
sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1]))

import torch

from benchmarks.sources import Warnings
from benchmarks.synthetic.folder import SyntheticScene
from benchmarks.synthetic.shot import exact_shot
from torch_backend.contract import JobError, TrainParams, read_json
from torch_backend.native import default_threads
from torch_backend.scene import Scene, load_images, load_scene, split_frames
from torch_backend.shot import SHOT_SUFFIX, Shot, content_key, write_json
from torch_backend.train import TrainConfig, config_from_params
from torch_backend.train.config import config_to_json
from torch_backend.train.identity import solve_key
from torch_backend.train.loop import train_to_end
from torch_backend.train.metrics import moving_share
from torch_backend.train.pictures import training_size
from torch_backend.train.trainer import Trainer

METHODS = ("hexplane", "mlp", "control_points", "auto")
"""The hosts with all Gaussians moving, and the default `auto`: hexplane with the gate. All use `support`."""
CHANGES = {"iterations": 160, "max_gaussians": 1500, "width": 96, "holdout": 3}
"""Changes to preset `preview`, in addition to growth every 20 steps, which makes four rounds."""
_EVERY = 20
DIVERGED_DB = 3.0
"""A run this many dB below the median of its row counts as diverged."""


@dataclasses.dataclass
class Outcome:
    """One run."""

    method: str
    """Value of `--method`."""
    seed: int
    """Seed of every random draw."""
    psnr_db: float | None
    """Mean PSNR over the held-out frames at their own times; None if the run ended early."""
    skipped_steps: int
    """Number of steps skipped because they were not finite."""
    warnings: list[str]
    """Warnings of the run."""
    finite: bool
    """True if every parameter is finite at the end."""
    gaussians: int
    """Number of Gaussians at the end."""
    moving_share: float
    """Share of the Gaussians that the field moves."""
    seconds: float
    """Seconds of training."""


class Watched(Trainer):
    """A trainer on the CPU that counts skipped steps."""

    skipped_steps = 0

    def step(self) -> torch.Tensor:
        loss = super().step()
        self.skipped_steps += not bool(self.optimizer.applied)
        return loss


def configuration(method: str, seed: int, **changes: Any) -> TrainConfig:
    """The configuration of a run; `changes` override `CHANGES`."""
    config = config_from_params(TrainParams(method=method, seed=seed, **{**CHANGES, **changes}))
    config.densify.every = _EVERY
    return config


def train_once(scene: Scene, config: TrainConfig) -> Outcome:
    """A whole run. After a JobError the PSNR is None, and the warnings include the error."""
    width, height = training_size(scene, config.width)
    train, test = split_frames(scene.solved, config.holdout, config.holdout_phase)
    images = load_images(scene, train + test, width, height)
    listener, since = Warnings(), time.perf_counter()
    trainer = Watched(scene, images[: len(train)], train, config, listener)
    value = None
    with tempfile.TemporaryDirectory() as folder:
        try:
            train_to_end(trainer, pathlib.Path(folder) / "checkpoint.safetensors", lambda _: None)
            value = trainer.heldout_psnr(test, images[len(train) :])
        except JobError as error:
            listener.warnings.append(str(error))
    named = [*trainer.model.gaussians.params.values(), trainer.model.exposure.values]
    named += [] if trainer.model.field is None else list(trainer.model.field.parameters())
    return Outcome(
        config.method,
        config.seed,
        None if value is None else round(value, 3),
        trainer.skipped_steps,
        listener.warnings,
        all(bool(torch.isfinite(p).all()) for p in named),
        len(trainer.model.gaussians),
        round(moving_share(trainer.model), 4),
        round(time.perf_counter() - since, 2),
    )


def table(outcomes: Sequence[Outcome]) -> list[str]:
    """Markdown table with a row per method."""
    lines = [
        "| method | runs | PSNR, dB: mean | std | min | max | diverged | not finite | skipped steps | warnings | s |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for method in dict.fromkeys(outcome.method for outcome in outcomes):
        runs = [outcome for outcome in outcomes if outcome.method == method]
        ended = [run.psnr_db for run in runs if run.psnr_db is not None]
        middle = statistics.median(ended) if ended else float("nan")
        spread = statistics.stdev(ended) if len(ended) > 1 else float("nan")
        diverged = len(runs) - sum(value >= middle - DIVERGED_DB for value in ended)
        lines.append(
            f"| {method} | {len(runs)} | {statistics.fmean(ended or [middle]):.2f} | {spread:.2f} | "
            f"{min(ended, default=middle):.2f} | {max(ended, default=middle):.2f} | {diverged} | "
            f"{sum(not run.finite for run in runs)} | {sum(run.skipped_steps for run in runs)} | "
            f"{sum(len(run.warnings) for run in runs)} | {statistics.fmean(run.seconds for run in runs):.1f} |"
        )
    return lines


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shot", type=pathlib.Path)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--results", type=pathlib.Path, default=pathlib.Path("stability.json"), metavar="FILE")
    args = parser.parse_args()
    torch.set_num_threads(default_threads())
    if (args.shot / "scene.json").is_file():
        synthetic = SyntheticScene.load(args.shot)
        place = args.results.absolute().parent / f"{synthetic.size}-{synthetic.name}-exact{SHOT_SUFFIX}"
        shot = exact_shot(synthetic, place, Warnings())
    else:
        shot = Shot.open(args.shot)
    scene, kept = load_scene(shot), read_json(args.results)["runs"] if args.results.is_file() else {}
    outcomes = []
    for seed in range(args.seeds):
        for method in args.methods:
            config = configuration(method, seed)
            key = content_key(config_to_json(config), solve_key(shot))
            if key not in kept:
                kept[key] = dataclasses.asdict(train_once(scene, config))
                write_json(args.results, {"version": 1, "runs": kept})
                print(kept[key], flush=True)
            outcomes.append(Outcome(**kept[key]))
    print("\n".join(table(outcomes)))


if __name__ == "__main__":
    main()
