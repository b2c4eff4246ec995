"""The model alone against plates held out of training: `python -m benchmarks.model SHOT --results DIR`.

Trains `--method` on a solved shot, which stays unchanged. Figures are in dB at the training size, means over the
held-out frames. Each frame at its own time gives S, moving and whole. S covers the pixels that the motion matte calls
still, with no mover within 8 px at a width of 640. F covers still pixels of frames frozen at each instant. These are
seen from the held-out frames at least a quarter of the clip away. A pixel with a mover in that frame's matte or in the
matte of t* is excluded. The instants are `--t-star` and one half a clip away. With `--develop` both are developed as
a freeze does, for any method. Then F, the best 90 % and the gradient energy of those frames are judged before and
after, at the training size and at `LARGE` pixels. `--held N` judges moving pixels of N held-out frames, with time
frozen at that frame; neither training nor development has used its plate. Tune with `--phase` other than 0. Seconds are
CPU time of one thread. `--set` changes any number of the configuration, for example `--set gate.start=0.4
densify.budget=50000`; `--develop-set` any of `DevelopConfig`. `--again` judges the training left in DIR by an earlier
call with the same `--name`.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import os
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
from benchmarks.report.metrics import best_share_psnr, gradient_magnitude, known_mean, psnr_of
from benchmarks.sources import in_words
from benchmarks.training_step import _Silent
from torch_backend.contract import TrainParams
from torch_backend.deformation import planes
from torch_backend.freeze.frozen import FrozenGaussians, FrozenImage, freeze_at, render_frozen
from torch_backend.freeze.instant.instants import config_for, developed
from torch_backend.freeze.instant.repairs import Moment, repaired, repairs
from torch_backend.freeze.views.source_views import motion_mattes
from torch_backend.motion.mattes import load_motion
from torch_backend.raster import cpu as raster_cpu
from torch_backend.raster import ssim
from torch_backend.scene import load_images, load_scene, split_frames
from torch_backend.sfm.masks import IGNORE, load_mask
from torch_backend.shot import Shot, write_json
from torch_backend.train import LoadedRun, adam, config_from_params
from torch_backend.train.checkpoint import CHECKPOINT_FILE, read_meta
from torch_backend.train.config import TrainConfig, config_from_json, config_to_json
from torch_backend.train.ignored import Masks, load_ignored
from torch_backend.train.loop import train_to_end
from torch_backend.train.movers import load_movers
from torch_backend.train.pictures import training_size
from torch_backend.train.resume import restore_run
from torch_backend.train.trainer import Trainer

FIGURES = ("still", "moving", "whole", "frozen", "gradient")
"""PSNR in dB of S, moving, whole and F; gradient energy of the render at its own time, relative to the plate's."""
LARGE = 640
"""Greatest width of the second size at which frozen frames are judged; equals the width of the working frames."""
OF_FROZEN = ("frozen", "best_90", "gradient")
"""Figures of a frozen frame at another pose: F and its best 90 % in dB; gradient energy relative to the plate's."""
_MARGIN = 8 / 640


def changed(config: TrainConfig, changes: Iterable[str]) -> TrainConfig:
    """The configuration with `a.b=value` applied. ValueError or AttributeError for an unknown field."""
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
    """Held-out frames of a shot at one size, and their moving regions."""

    def __init__(self, shot: Shot, trainer: Trainer, test: list[int], width: int) -> None:
        self.shot, self.trainer, self.scene, self.test = shot, trainer, trainer.scene, test
        self.width, self.height = training_size(self.scene, width)
        images = load_images(self.scene, test, self.width, self.height)
        self.images = dict(zip(test, images.float(), strict=True))
        self.Ks = self.scene.camera_at(self.width, self.height)
        self.ignored = load_ignored(masks_of(shot), self.scene, test, self.width, self.height)

    def judged(self, index: int, where: Tensor) -> Tensor:
        """The pixels of `where`, bool [H, W], without those masked as no part of the scene."""
        return where if index not in self.ignored else where & ~self.ignored[index]

    def matte(self, index: int) -> Tensor:
        """[H, W] motion matte of a frame in 0..1. ValueError if the shot has none."""
        found = load_motion(self.shot, self.scene.frames[index])
        if found is None:
            raise ValueError("the shot has no motion mattes: solve it anew")
        matte = torch.from_numpy(found / 255.0).float()[None, None]
        return F.interpolate(matte, (self.height, self.width), mode="nearest-exact")[0, 0]

    def still(self, matte: Tensor, mover: Tensor | None = None) -> Tensor:
        """bool [H, W] still pixels."""
        return still_pixels(matte, mover, max(1, round(_MARGIN * self.width)))

    def at_frame_time(self) -> list[dict[str, Any]]:
        """S, moving, whole and gradient energy, one row per held-out frame, at its own time."""
        rows = []
        for index, plate in self.images.items():
            shown, matte = self.trainer.render_frame(index), self.matte(index)
            rows.append({
                "frame": self.scene.frames[index],
                "still": _psnr(shown, plate, self.judged(index, self.still(matte))),
                "moving": _psnr(shown, plate, self.judged(index, matte > 0.75)),
                "whole": _psnr(shown, plate, self.judged(index, torch.ones_like(matte) > 0)),
                "gradient": gradient_magnitude(shown) / max(1e-9, gradient_magnitude(plate)),
            })  # fmt: skip
        return rows

    def seen(self, frozen: FrozenGaussians, index: int) -> FrozenImage:
        """A frozen scene rendered from a frame's camera."""
        t, at = self.trainer, float(self.scene.times[index])
        view = t.viewmats[index], self.Ks[index]
        return render_frozen(frozen, *view, self.width, self.height, t.model.exposure, at).cpu()

    def frozen(self, frozen: FrozenGaussians, t_star: int) -> list[dict[str, Any]]:
        """`OF_FROZEN` at the instant of frame index `t_star`, one row per held-out frame that is far enough away."""
        views, matte_t_star, rows = self.trainer.viewmats, self.matte(t_star), []
        for index, plate in self.images.items():
            if abs(index - t_star) < len(self.scene.frames) / 4:
                continue
            image = self.seen(frozen, index)
            cameras = views[index], self.Ks[index], views[t_star], self.Ks[t_star]
            places, depth = induced_places(image.depth, *cameras)
            known = inside(places, self.width, self.height, 0.0) & (depth > 0)
            mover = torch.where(known, sampled(matte_t_star, places, nearest=True), 0.0) > 0.75
            shown = over_grey(image)
            rows.append({
                "frame": self.scene.frames[index],
                "frozen": _psnr(shown, plate, self.judged(index, self.still(self.matte(index), mover))),
                "best_90": best_share_psnr(shown, plate),
                "gradient": gradient_magnitude(shown) / max(1e-9, gradient_magnitude(plate)),
            })  # fmt: skip
        return rows

    def moving_at(self, frozen: FrozenGaussians, index: int) -> float | None:
        """PSNR of the moving pixels of a held-out frame, for the scene frozen at this frame and seen from its pose."""
        moving = self.judged(index, self.matte(index) > 0.75)
        return _psnr(over_grey(self.seen(frozen, index)), self.images[index], moving)


def masks_of(shot: Shot) -> Masks:
    """Reader of the ignored regions of a shot's frames."""
    return functools.partial(load_mask, shot, IGNORE)


def over_grey(image: FrozenImage) -> Tensor:
    """[H, W, 3] over grey, as in previews."""
    return image.color + 0.5 * (1.0 - image.alpha[..., None])


def _psnr(image: Tensor, plate: Tensor, where: Tensor) -> float | None:
    error = (image.clamp(0.0, 1.0) - plate).double().square().mean(2)[where]
    return psnr_of(float(error.mean())) if len(error) > 50 else None


def mean(rows: Sequence[dict[str, Any]], name: str) -> float | None:
    """Mean of a figure over the rows where it is not None."""
    return known_mean(row.get(name) for row in rows)


def nearest_trained(trainer: Trainer, frame: int) -> int:
    """Index of the training frame nearest to a frame number."""
    return min(trainer.train_ids, key=lambda i: abs(trainer.scene.frames[i] - frame))


def configured(args: argparse.Namespace, shot: Shot) -> TrainConfig:
    """The requested configuration, or that of the requested trained run."""
    if args.run:
        return config_from_json(read_meta(shot.run(args.run) / CHECKPOINT_FILE)["config"])
    params = TrainParams(method=args.method, seed=args.seed, iterations=args.iterations, width=args.width, holdout=8)
    config = changed(config_from_params(params), args.set)
    config.holdout_phase = args.phase
    return config


def trained(args: argparse.Namespace, shot: Shot, config: TrainConfig) -> tuple[Trainer, list[int], float]:
    """(trainer after training, indices of held-out frames, CPU seconds of the training)."""
    scene = load_scene(shot)
    width, height = training_size(scene, config.width)
    train, test = split_frames(scene.solved, config.holdout, config.holdout_phase)
    images, mattes = load_images(scene, train, width, height), functools.partial(load_motion, shot)
    movers = load_movers(mattes, scene, train, width, height)
    for module in (raster_cpu, ssim, adam, planes):
        module.warm_up()
    since, left = time.process_time(), args.results / f"{args.name}.safetensors"
    ignored = load_ignored(masks_of(shot), scene, train, width, height)
    trainer = Trainer(scene, images, train, config, _Silent(), movers=movers, ignored=ignored)
    if args.run or args.again:
        restore_run(trainer, shot.run(args.run) / CHECKPOINT_FILE if args.run else left)
    else:
        train_to_end(trainer, left, lambda _: None)
    return trainer, test, time.process_time() - since


class Freezer:
    """Instants of a training, before and after development."""

    def __init__(self, args: argparse.Namespace, shot: Shot, trainer: Trainer) -> None:
        t, self.shot, self.trainer = trainer, shot, trainer
        frames = [t.scene.frames[i] for i in t.train_ids]
        self.run = LoadedRun(args.results / args.name, t.config, t.model, t.width, t.height, frames, args.name)
        changes = dict(change.split("=", 1) for change in args.develop_set)
        changes = {name: json.loads(value) for name, value in changes.items()}
        self.config = dataclasses.replace(config_for(self.run), **changes)
        self.seconds = 0.0

    def field(self, index: int) -> FrozenGaussians:
        """The trained instant of a frame, before development."""
        return freeze_at(self.trainer.model, float(self.trainer.scene.times[index]), self.trainer.seconds)

    def developed(self, index: int) -> FrozenGaussians:
        """The developed instant of a frame. A held-out frame gets the repairs without training on its plate."""
        scene, since = self.trainer.scene, time.process_time()
        frame, frozen = scene.frames[index], self.field(index)
        if frame in self.run.train_frames:
            instant = developed(self.shot, self.run, scene, frame, frozen, self.config, keep=False)
        else:
            moment = Moment(self.run, scene, frame, motion_mattes(self.shot))
            instant = repaired(frozen, moment, repairs(self.config))
        self.seconds += time.process_time() - since
        return instant


def spread(indices: Sequence[int], count: int) -> list[int]:
    """At most `count` of the indices, evenly spaced."""
    step = max(1.0, len(indices) / max(1, count))
    return [indices[int((n + 0.5) * step)] for n in range(min(count, len(indices)))]


def judged(args: argparse.Namespace, freezer: Freezer, judges: dict[str, Judge], t_stars: list[int]) -> dict[str, Any]:
    """Rows of the frozen frames by size, before and after development: {"field": {"small": [...], ...}, ...}."""
    rows: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for kind in ("field", "developed") if args.develop else ("field",):
        rows[kind] = {size: [] for size in judges}
        for index in t_stars:
            frozen = getattr(freezer, kind)(index)
            for size, judge in judges.items():
                rows[kind][size] += [{"t_star": index, **row} for row in judge.frozen(frozen, index)]
    return rows


def judge_held_out(
    args: argparse.Namespace, freezer: Freezer, judges: dict[str, Judge], test: list[int]
) -> list[dict[str, Any]]:
    """dB of moving pixels at instants held out of training, one row per held-out frame with moving pixels."""
    rows = []
    for index in spread([i for i in test if bool((judges["small"].matte(i) > 0.75).any())], args.held):
        row: dict[str, Any] = {"frame": freezer.trainer.scene.frames[index]}
        for kind in ("field", "developed") if args.develop else ("field",):
            frozen = getattr(freezer, kind)(index)
            row[kind] = {size: judge.moving_at(frozen, index) for size, judge in judges.items()}
        rows.append(row)
    return rows


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Trains and judges one configuration."""
    shot = Shot.open(args.shot)
    config = configured(args, shot)
    trainer, test, seconds = trained(args, shot, config)
    scene, model = trainer.scene, trainer.model
    judges = {"small": Judge(shot, trainer, test, config.width), "large": Judge(shot, trainer, test, LARGE)}
    half, first = len(scene.frames) // 2, nearest_trained(trainer, args.t_star)
    t_stars = [first, nearest_trained(trainer, scene.frames[(first + half) % len(scene.frames)])]
    freezer = Freezer(args, shot, trainer)
    in_time, frozen = judges["small"].at_frame_time(), judged(args, freezer, judges, t_stars)
    instants = judge_held_out(args, freezer, judges, test)
    figures = {name: mean(in_time, name) for name in FIGURES if name != "frozen"}
    figures["frozen"] = mean(frozen["field"]["small"], "frozen")
    for kind, sizes in frozen.items():
        figures |= {f"{kind}_{s}_{name}": mean(rows, name) for s, rows in sizes.items() for name in OF_FROZEN}
        for size in judges if instants else ():
            figures[f"{kind}_{size}_held"] = mean([row[kind] for row in instants], size)
    return {
        "figures": figures, "cpu_seconds": seconds, "develop_cpu_seconds": freezer.seconds,
        "gaussians": len(model.gaussians), "open": len(model.open_rows()),
        "iterations": trainer.iteration, "sh_degree": model.sh_degree, "t_stars": t_stars, "own": in_time,
        "frozen": frozen, "held": instants, "needs": trainer.policy.state(), "config": config_to_json(config),
        "develop_config": dataclasses.asdict(freezer.config),
    }  # fmt: skip


@in_words
def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shot", type=Path)
    parser.add_argument("--results", type=Path, required=True, metavar="DIR")
    parser.add_argument("--name", default="model", help="name of the result files")
    parser.add_argument("--method", default="auto")
    parser.add_argument("--run", default="", metavar="NAME", help="judge this run of the shot instead of training one")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--phase",
        type=int,
        default=0,
        help="offset of the held-out frames, every 8th of the clip; 0 is reserved for reports",
    )
    parser.add_argument("--iterations", type=int, default=0, help="0: the value of the preset")
    parser.add_argument("--width", type=int, default=0, help="0: the value of the preset")
    parser.add_argument(
        "--t-star", type=int, default=8, help="first instant as a frame number; the second is half a clip away"
    )
    parser.add_argument("--set", nargs="*", default=[], metavar="FIELD=VALUE")
    parser.add_argument("--again", action="store_true", help="judge the training of an earlier call")
    parser.add_argument("--develop", action="store_true", help="also develop the instants")
    parser.add_argument("--develop-set", nargs="*", default=[], metavar="FIELD=VALUE")
    parser.add_argument(
        "--held", type=int, default=0, metavar="N", help="number of instants whose frames are held out of training"
    )
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    args.results.mkdir(parents=True, exist_ok=True)
    result = run(args)
    write_json(args.results / f"{args.name}.json", result)
    figures = " ".join(f"{n} {v:.2f}" if v is not None else f"{n} -" for n, v in result["figures"].items())
    facts = f"{result['gaussians']} Gaussians, {result['open']} open, SH {result['sh_degree']}"
    print(f"{args.name}: {figures}; {result['cpu_seconds']:.0f} s, {result['iterations']} steps, {facts}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
