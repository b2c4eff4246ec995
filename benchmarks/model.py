"""The model alone, against plates that it was not trained on: `python -m benchmarks.model SHOT --results DIR`.

Trains `--method` on a solved shot, of which nothing is written, and judges at the training size, in dB, means over the
held-out frames: S (still pixels: the motion matte says still, and no mover is within 8 px of 640), moving pixels and
the whole, each frame at its own time; and frozen still pixels, F: time stands still at each `--t-star`, seen from the
held-out frames at least a quarter of the clip away, where neither the matte of that frame nor that of t* has a mover.
Tune with `--phase` other than 0. Seconds are of the processor, training alone; one thread. `--set` changes any number
of the configuration: `--set gate.start=0.4 densify.budget=50000`.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import statistics
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import torch
from torch import Tensor
from torch.nn import functional as F

from benchmarks.detail_figures import induced_places, inside, sampled, still_pixels
from benchmarks.training_step import _Silent
from torch_backend.contract import JobError, TrainParams
from torch_backend.deformation import planes
from torch_backend.footage.images import write_png
from torch_backend.freeze.query import freeze_at, render_frozen
from torch_backend.raster import cpu as raster_cpu
from torch_backend.raster import ssim
from torch_backend.report.metrics import gradient_magnitude, psnr_of
from torch_backend.scene import load_images, load_scene, split_frames
from torch_backend.shot import Shot, write_json
from torch_backend.solve.motion import load_motion
from torch_backend.train import adam, config_from_params
from torch_backend.train.checkpoint import CHECKPOINT_FILE, read_meta
from torch_backend.train.config import TrainConfig, config_from_json, config_to_json
from torch_backend.train.movers import load_movers
from torch_backend.train.run import training_size
from torch_backend.train.trainer import Trainer

FIGURES = ("still", "moving", "whole", "frozen", "gradient")
"""S, M, whole and F in dB; gradient energy of the render at its own time over the plate's."""
_MARGIN = 8 / 640


def changed(config: TrainConfig, changes: Iterable[str]) -> TrainConfig:
    """The configuration with `a.b=value` applied; ValueError for what is not there."""
    for change in changes:
        path, _, value = change.partition("=")
        *parts, name = path.split(".")
        owner: Any = config
        for part in parts:
            owner = getattr(owner, part)
        if not hasattr(owner, name):
            raise ValueError(f"the configuration has no {path}")
        setattr(owner, name, json.loads(value))
    return config


class Judge:
    """Held-out frames of a shot at the training size, and what of them moves."""

    def __init__(self, shot: Shot, trainer: Trainer, test: list[int], images: Tensor) -> None:
        self.shot, self.trainer, self.test = shot, trainer, test
        self.images = dict(zip(test, images.float(), strict=True))
        self.size = (trainer.height, trainer.width)

    def matte(self, index: int) -> Tensor:
        """[H, W] in 0..1. ValueError without one."""
        found = load_motion(self.shot, self.trainer.scene.frames[index])
        if found is None:
            raise ValueError("the shot has no motion mattes: solve it anew")
        return F.interpolate(torch.from_numpy(found / 255.0).float()[None, None], self.size, mode="nearest-exact")[0, 0]

    def still(self, matte: Tensor, mover: Tensor | None = None) -> Tensor:
        """Pixels that stand still, bool [H, W]."""
        return still_pixels(matte, mover, max(1, round(_MARGIN * self.size[1])))

    def at_own_time(self) -> list[dict[str, float | None]]:
        """S, moving, whole and gradient energy, a row per held-out frame."""
        rows = []
        for index, plate in self.images.items():
            shown, matte = self.trainer.render_frame(index), self.matte(index)
            rows.append({
                "frame": self.trainer.scene.frames[index],
                "still": _psnr(shown, plate, self.still(matte)),
                "moving": _psnr(shown, plate, matte > 0.75),
                "whole": _psnr(shown, plate, torch.ones_like(matte) > 0),
                "gradient": gradient_magnitude(shown) / max(1e-9, gradient_magnitude(plate)),
            })  # fmt: skip
        return rows

    def frozen(self, t_star: int) -> list[dict[str, float | None]]:
        """F with time at the delivered frame of index `t_star`, a row per held-out frame far enough away."""
        t, scene = self.trainer, self.trainer.scene
        frozen = freeze_at(t.model, float(scene.times[t_star]), t.seconds)
        Ks, there, rows = scene.camera_at(t.width, t.height), self.matte(t_star), []
        for index, plate in self.images.items():
            if abs(index - t_star) < len(scene.frames) / 4:
                continue
            view = t.viewmats[index], Ks[index]
            image = render_frozen(frozen, *view, t.width, t.height, t.model.exposure, float(scene.times[index]))
            places, depth = induced_places(image.depth, *view, t.viewmats[t_star], Ks[t_star])
            known = inside(places, t.width, t.height, 0.0) & (depth > 0)
            mover = torch.where(known, sampled(there, places, nearest=True), 0.0) > 0.75
            shown = image.color + 0.5 * (1.0 - image.alpha[..., None])
            value = _psnr(shown, plate, self.still(self.matte(index), mover))
            rows.append({"frame": scene.frames[index], "frozen": value})
        return rows


def _psnr(image: Tensor, plate: Tensor, where: Tensor) -> float | None:
    error = (image.clamp(0.0, 1.0) - plate).double().square().mean(2)[where]
    return psnr_of(float(error.mean())) if len(error) > 50 else None


def mean(rows: Sequence[dict[str, Any]], name: str) -> float | None:
    """Of a figure over the rows that have it."""
    values = [row[name] for row in rows if row.get(name) is not None]
    return statistics.fmean(values) if values else None


def nearest_trained(trainer: Trainer, frame: int) -> int:
    """Index of the trained frame nearest to a frame's number."""
    return min(trainer.train_ids, key=lambda i: abs(trainer.scene.frames[i] - frame))


def strips(judge: Judge, folder: Path, t_stars: list[int]) -> None:
    """Plate, render at its own time, frozen at each t*: a picture per held-out frame, at 100 %."""
    t = judge.trainer
    frozen = [freeze_at(t.model, float(t.scene.times[i]), t.seconds) for i in t_stars]
    Ks = t.scene.camera_at(t.width, t.height)
    folder.mkdir(parents=True, exist_ok=True)
    for index, plate in judge.images.items():
        shown = [plate, t.render_frame(index)]
        for state in frozen:
            at = float(t.scene.times[index])
            image = render_frozen(state, t.viewmats[index], Ks[index], t.width, t.height, t.model.exposure, at)
            shown.append(image.color + 0.5 * (1.0 - image.alpha[..., None]))
        strip = torch.cat(shown, dim=1).clamp(0.0, 1.0)
        write_png(folder / f"{t.scene.frames[index]:06d}.png", (strip * 255.0).round().byte().contiguous().numpy())


def configured(args: argparse.Namespace, shot: Shot) -> TrainConfig:
    """The configuration that is asked for, or that of the trained run that is."""
    if args.run:
        return config_from_json(read_meta(shot.run(args.run) / CHECKPOINT_FILE)["config"])
    params = TrainParams(method=args.method, seed=args.seed, iterations=args.iterations, width=args.width, holdout=8)
    config = changed(config_from_params(params), args.set)
    config.holdout_phase = args.phase
    return config


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Trains and judges once."""
    shot = Shot.open(args.shot)
    config, scene = configured(args, shot), load_scene(shot)
    width, height = training_size(scene, config.width)
    train, test = split_frames(scene.solved, config.holdout, config.holdout_phase)
    images = load_images(scene, train + test, width, height)
    mattes = functools.partial(load_motion, shot)
    movers = None if args.no_mattes else load_movers(mattes, scene, train, width, height)
    for module in (raster_cpu, ssim, adam, planes):
        module.warm_up()
    since = time.process_time()
    trainer = Trainer(scene, images[: len(train)], train, config, _Silent(), movers=movers)  # type: ignore[arg-type]
    if args.run:
        trainer.restore(shot.run(args.run) / CHECKPOINT_FILE)
    else:
        trainer.run(args.results / f"{args.name}.safetensors", lambda _: None)
    seconds = time.process_time() - since
    judge = Judge(shot, trainer, test, images[len(train) :])
    own = judge.at_own_time()
    half = len(scene.frames) // 2
    first = nearest_trained(trainer, args.t_star)
    t_stars = [first, nearest_trained(trainer, scene.frames[(first + half) % len(scene.frames)])]
    frozen = [judge.frozen(i) for i in t_stars]
    if args.strips:
        strips(judge, args.results / f"strips-{args.name}", t_stars)
    figures = {name: mean(own, name) for name in FIGURES if name != "frozen"}
    figures["frozen"] = mean([row for rows in frozen for row in rows], "frozen")
    model = trainer.model
    return {
        "figures": figures, "cpu_seconds": seconds, "gaussians": len(model.gaussians), "open": len(model.open_rows()),
        "iterations": trainer.iteration, "sh_degree": model.sh_degree, "t_stars": t_stars, "own": own,
        "frozen": frozen, "needs": trainer.needs.state(), "config": config_to_json(config),
    }  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; returns an exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shot", type=Path)
    parser.add_argument("--results", type=Path, required=True, metavar="DIR")
    parser.add_argument("--name", default="model", help="of the result's files")
    parser.add_argument("--method", default="auto")
    parser.add_argument("--run", default="", metavar="NAME", help="train nothing: judge this run of the shot")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--phase", type=int, default=0, help="which of every 8 frames are held out; 0 only to report")
    parser.add_argument("--iterations", type=int, default=0, help="0: the preset's")
    parser.add_argument("--width", type=int, default=0, help="0: the preset's")
    parser.add_argument("--t-star", type=int, default=8, help="frame; the other instant is half a clip away")
    parser.add_argument("--no-mattes", action="store_true", help="train without the motion mattes (they still judge)")
    parser.add_argument("--strips", action="store_true", help="write pictures")
    parser.add_argument("--set", nargs="*", default=[], metavar="FIELD=VALUE")
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    args.results.mkdir(parents=True, exist_ok=True)
    try:
        result = run(args)
    except (JobError, ValueError) as error:
        print(f"Error: {error}", file=sys.stderr)
        return 1
    write_json(args.results / f"{args.name}.json", result)
    told = " ".join(f"{n} {v:.2f}" if v is not None else f"{n} -" for n, v in result["figures"].items())
    facts = f"{result['gaussians']} Gaussians, {result['open']} open, SH {result['sh_degree']}"
    print(f"{args.name}: {told}; {result['cpu_seconds']:.0f} s, {result['iterations']} steps, {facts}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
