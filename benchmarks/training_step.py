"""Breakdown of one training step before and after the gate opens: `python -m benchmarks.training_step SHOT`.

SHOT is a solved shot folder, which stays unchanged. One run of the preset trains with the tuning split (every 8th frame
held out, four frames later) and the shot's motion mattes. `--steps` steps are timed at each share of the run in `--at`.
Parts are means over these steps, in ms. The time of an inner part is subtracted from the outer one, and time outside of
all parts is listed as the rest.
Autograd traverses the graph in reverse order of construction. So the parts of the backward pass are separated by the
times at which the gradients of the images and of the Gaussians arrive.
"""

import argparse
import functools
import json
import os
import pathlib
import statistics
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")
sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1]))

import torch

from torch_backend.contract import Reporter, TrainParams
from torch_backend.motion.mattes import load_motion
from torch_backend.native import default_threads, torch_threads
from torch_backend.raster.cpu import warm_up
from torch_backend.scene import load_images, load_scene, split_frames
from torch_backend.sfm.masks import IGNORE, load_mask
from torch_backend.shot import Shot
from torch_backend.train import config_from_params, events
from torch_backend.train import trainer as trainer_module
from torch_backend.train.ignored import load_ignored
from torch_backend.train.movers import load_movers
from torch_backend.train.pictures import training_size
from torch_backend.train.trainer import Trainer


class _Silent(Reporter):
    """A reporter that only prints warnings."""

    def warning(self, message: str, hint: str = "") -> None:
        print(f"note: {message} {hint}")


class Parts:
    """Milliseconds per part of the current step, with the time of inner parts subtracted from outer ones."""

    def __init__(self) -> None:
        self.spent: dict[str, float] = defaultdict(float)
        self._inner = [0.0]
        self.mark = 0.0

    def timed(self, name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        """Wraps `call` to add its time to `name`."""

        def run(*args: Any, **kwargs: Any) -> Any:
            since = time.perf_counter()
            self._inner.append(0.0)
            try:
                return call(*args, **kwargs)
            finally:
                whole = time.perf_counter() - since
                self.spent[name] += 1e3 * (whole - self._inner.pop())
                self._inner[-1] += whole

        return run

    def lap(self, name: str) -> None:
        """Adds the time since the last mark to `name`, and sets the mark again, for sections of one backward pass."""
        now = time.perf_counter()
        self.spent[name] += 1e3 * (now - self.mark)
        self.mark = now


def watch(trainer: Trainer, parts: Parts) -> None:
    """Wraps the functions called by a step in timers. Call it again when the trainer has made its field."""
    module: Any = trainer_module
    model, patched = trainer.model, set(vars(trainer).get("_timed", ()))

    def patch(owner: Any, name: str, label: str) -> None:
        if (id(owner), name) not in patched:
            setattr(owner, name, parts.timed(label, getattr(owner, name)))
            patched.add((id(owner), name))

    for owner, name, label in (
        (trainer, "_deltas", "field, forward"),
        (model, "moved", "deltas applied"),
        (module, "anchored_pairs", "pairs to anchor drawn"),
        (model.exposure, "apply_at", "exposure, forward"),
        (trainer.softened, "loss", "L1 + SSIM, forward"),
        (trainer, "_regularisers", "penalties, forward"),
        (module, "stillness", "price of motion, forward"),
        (trainer, "_support_loss", "support loss, forward"),
        (trainer.optimizer, "zero_grad", "gradients cleared"),
        (trainer.optimizer, "step", "Adam"),
        (trainer, "_observe", "what a frame tells of the Gaussians"),
        (trainer, "_schedule_rates", "learning rates"),
        (events, "schedule_events", "densification and gate"),
        (trainer, "_step_inputs", "inputs of the step"),
    ):
        patch(owner, name, label)
    if model.field is not None:
        patch(model.field, "regularisation", "field's penalties, forward")
    if (id(module), "render") not in patched:
        render = parts.timed("rasterise, forward", module.render)
        hooks: list[Any] = []  # removed after each step, because an unmoved parameter stays the same tensor

        def watched(state: dict[str, torch.Tensor], *args: Any, **options: Any) -> Any:
            out = render(state, *args, **options)
            leaf = state["means"]
            if out.colors.requires_grad:
                out.colors.register_hook(lambda _: parts.lap("losses, penalties and exposure, backward"))
                hooks.append(leaf.register_hook(lambda _: parts.lap("rasterise, backward")))
            return out

        module.render = watched
        backward = torch.Tensor.backward

        def whole(self: torch.Tensor, *args: Any, **kwargs: Any) -> None:
            since = parts.mark = time.perf_counter()
            backward(self, *args, **kwargs)
            parts.lap("field and Gaussians, backward")
            parts._inner[-1] += time.perf_counter() - since
            while hooks:
                hooks.pop().remove()

        torch.Tensor.backward = whole  # type: ignore[method-assign]
        patched.add((id(module), "render"))
    vars(trainer)["_timed"] = patched


def measure(trainer: Trainer, parts: Parts, steps: int) -> dict[str, float]:
    """Mean ms per part over `steps` steps, and the median of whole steps."""
    watch(trainer, parts)
    parts.spent.clear()
    whole = []
    for _ in range(steps):
        since = time.perf_counter()
        events.schedule_events(trainer)
        trainer.step()
        trainer.iteration += 1
        whole.append(1e3 * (time.perf_counter() - since))
    found = {name: spent / steps for name, spent in parts.spent.items()}
    mean = statistics.fmean(whole)
    return {"whole step (median)": statistics.median(whole), "whole step (mean)": mean, **found,
            "the rest": mean - sum(found.values())}  # fmt: skip


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shot")
    parser.add_argument("--preset", default="preview")
    parser.add_argument("--iterations", type=int, default=0)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument(
        "--at",
        type=float,
        nargs=2,
        default=(0.15, 0.7),
        help="positions in the run at which steps are measured, as shares of it",
    )
    parser.add_argument("--threads", type=int, default=0, help="0: all cores")
    parser.add_argument("--json", metavar="FILE")
    args = parser.parse_args()
    shot = Shot.open(args.shot)
    config = config_from_params(TrainParams(preset=args.preset, iterations=args.iterations, holdout=8))
    config.holdout_phase = 4
    if args.threads:  # the backend uses all cores available to the process
        if not hasattr(os, "sched_setaffinity"):
            parser.error("--threads: this system does not let a program leave cores alone")
        os.sched_setaffinity(0, set(sorted(os.sched_getaffinity(0))[: args.threads]))
    torch.set_num_threads(default_threads())
    warm_up()
    scene = load_scene(shot)
    width, height = training_size(scene, config.width)
    train, _ = split_frames(scene.solved, config.holdout, config.holdout_phase)
    movers = load_movers(functools.partial(load_motion, shot), scene, train, width, height)
    ignored = load_ignored(functools.partial(load_mask, shot, IGNORE), scene, train, width, height)
    images = load_images(scene, train, width, height)
    trainer = Trainer(scene, images, train, config, _Silent(), movers=movers, ignored=ignored)
    parts, results = Parts(), {}
    with torch_threads(3 * width * height):  # as in `Trainer.run`
        for share in args.at:
            while trainer.progress < share:
                events.schedule_events(trainer)
                trainer.step()
                trainer.iteration += 1
            label = f"at {share:.0%}: {len(trainer.model.gaussians)} Gaussians, {len(trainer.model.open_rows())} open"
            results[label] = measure(trainer, parts, args.steps)
            print(f"\n{label}, {width}x{height}")
            for name, value in results[label].items():
                print(f"  {name:<44} {value:8.2f} ms")
    if args.json:
        pathlib.Path(args.json).write_text(json.dumps(results, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
