"""What the gate saves: `python -m benchmarks.gate SCENE`, SCENE a folder of benchmarks/synthetic, its cameras exact.

Three models train side by side: static, `auto`, and the same host without the gate. After the gate has hardened, rounds
of steps and of frozen views are timed in turn. One thread; the shot is made in a temporary folder.
"""

import argparse
import os
import statistics
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import torch

from benchmarks.sources import load_source
from benchmarks.training_step import _Silent
from torch_backend.contract import TrainParams
from torch_backend.freeze.frozen import freeze_at, render_frozen
from torch_backend.raster.cpu import warm_up
from torch_backend.scene import load_images, load_scene, split_frames
from torch_backend.shot import Shot
from torch_backend.train import config_from_params
from torch_backend.train.pictures import training_size
from torch_backend.train.trainer import Trainer

ROWS = {"static": ("static", "none"), "gate": ("auto", "support"), "open": ("hexplane", "support")}
"""Name -> method, supervision."""
_SHARE = 14 / 15
"""Of the run, trained before the rounds: growth is over by then."""


def trained(shot: Shot, method: str, supervision: str, args: argparse.Namespace) -> tuple[Trainer, float]:
    """A trainer after `_SHARE` of its run, and the mean milliseconds of a step on the way."""
    params = TrainParams(
        method=method, supervision=supervision, holdout=8, iterations=args.iterations, max_gaussians=args.gaussians,
        width=args.width,
    )  # fmt: skip
    config, scene = config_from_params(params), load_scene(shot)
    width, height = training_size(scene, config.width)
    train, _ = split_frames(scene.solved, 8)
    trainer = Trainer(scene, load_images(scene, train, width, height), train, config, _Silent())
    since = time.perf_counter()
    while trainer.iteration < _SHARE * args.iterations:
        trainer.schedule_events()
        trainer.step()
        trainer.iteration += 1
    return trainer, 1e3 * (time.perf_counter() - since) / trainer.iteration


def print_summary(name: str, values: list[float]) -> None:
    """One line: median and range."""
    print(f"{name}: {statistics.median(values):.2f} [{min(values):.2f}, {max(values):.2f}]", flush=True)


def main() -> None:
    """Trains the three, times them in turn, prints medians and ranges."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scene")
    parser.add_argument("--iterations", type=int, default=1500)
    parser.add_argument("--gaussians", type=int, default=10_000)
    parser.add_argument("--width", type=int, default=240)
    parser.add_argument("--rounds", type=int, default=9)
    args = parser.parse_args()
    torch.set_num_threads(1)
    warm_up()
    with tempfile.TemporaryDirectory(prefix="splannequin-gate-") as folder:
        shot = load_source(f"exact:{args.scene}", Path(folder)).shot
        runs = {}
        for name, (method, supervision) in ROWS.items():
            runs[name], mean = trained(shot, method, supervision, args)
            model = runs[name].model
            print(
                f"{name}: mean step of the run {mean:.2f} ms; {len(model.open_rows())} of {len(model.gaussians)} open"
            )
        steps, views = {name: [] for name in runs}, {name: [] for name in runs}
        for _ in range(args.rounds):
            for name, trainer in runs.items():
                since = time.perf_counter()
                for _ in range(24):
                    trainer.step()
                steps[name].append(1e3 * (time.perf_counter() - since) / 24)
        frozen = {name: freeze_at(t.model, 0.5, t.seconds) for name, t in runs.items()}
        for _ in range(args.rounds):
            for name, t in runs.items():
                Ks, since = t.scene.camera_at(t.width, t.height), time.perf_counter()
                for i in range(0, 40, 4):
                    render_frozen(frozen[name], t.scene.viewmats[i], Ks[i], t.width, t.height, t.model.exposure, 0.5)
                views[name].append(1e3 * (time.perf_counter() - since) / 10)
    for name in runs:
        print_summary(f"step, ms, {name}", steps[name])
        print_summary(f"frozen view, ms, {name}", views[name])
    print_summary("step, open / gate", [a / b for a, b in zip(steps["open"], steps["gate"], strict=True)])


if __name__ == "__main__":
    main()
