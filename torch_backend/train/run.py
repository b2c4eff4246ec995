"""Training stage: trains a run for a solved shot and writes its folder."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..contract import (
    CONFIG_FILE,
    PREVIEWS_FOLDER,
    ExitCode,
    JobError,
    Reporter,
    TrainParams,
    UserError,
    read_json,
    sweep_half_written,
)
from ..deformation import host
from ..footage.depth_maps import find_depth
from ..motion.mattes import load_motion, motion_key
from ..native import default_threads
from ..raster import cpu as raster_cpu
from ..raster import ssim
from ..scene import IMAGE_MEMORY_BYTES, Scene, load_scene, split_frames
from ..sfm.masks import IGNORE, load_mask
from ..shot import Shot, need_disk, remove_file, write_json
from . import adam
from .anew import SUMMARY_FILE, drop_begun, finish_replacing, folder_for, replace_run
from .checkpoint import CHECKPOINT_FILE, read_meta
from .config import TrainConfig, config_from_json, config_from_params, config_to_json
from .depth import FittedDepth, depth_key, fitted_depth, load_fitted
from .device import choose_device
from .extend import EXTENSION_FILE, pending
from .identity import depth_identity, finished, has_changed_pictures, pictures_key, requested_identity, solve_key
from .ignored import load_ignored
from .loop import train_to_end
from .memory import MemoryPlan, free_bytes, plan_memory
from .metrics import Metrics, summarise
from .movers import load_movers
from .pictures import pictures_of
from .resume import restore_run, save_run
from .trainer import Trainer
from .verdict import warn_if_poor

# Bytes of a field with its moments, and of a run's small tensors (a preview's HexPlane has 4.4 MB).
_FIELD_BYTES = 14e6


@dataclass(frozen=True)
class _Prepared:
    """A training that is ready to start."""

    trainer: Trainer
    test: list[int]
    """Scene indices of the held-out frames."""
    held_out: Tensor
    """[T, H, W, 3] images of the held-out frames."""

    def trained(self, shot: Shot, run: str, folder: Path, checkpoint: Path, begun_at: int) -> dict[str, Any]:
        """Trains to the end, saving to the file `checkpoint`; returns the summary of the run named `run`.

        begun_at: iteration at which the run is resumed; -1: a new run.
        """
        metrics = Metrics(folder, self.trainer.report, begun_at)
        train_to_end(self.trainer, checkpoint, lambda trainer: metrics.add(trainer, self.test, self.held_out))
        mattes = functools.partial(load_motion, shot)
        return summarise(self.trainer, run, self.test, self.held_out, str(self.trainer.identity["key"]), mattes)


def train_shot(shot: Shot, params: TrainParams, report: Reporter) -> dict[str, Any]:
    """Trains one run. With `params.resume` it continues a checkpoint with the same settings; with `params.extend` it
    extends a finished run.

    An existing run that is trained with other settings, or from the start, is kept until the new one is done (`anew`).
    Returns the run's figures, which are also written to runs/<name>/summary.json. JobError if it cannot be trained.
    """
    if params.extend:
        return extend_run(shot, params, report)
    config_from_params(params)  # raises for invalid options before any work starts
    device = choose_device(params.device, report, "Training")
    run = shot.own(shot.run(params.run))
    shot.own(run / PREVIEWS_FOLDER)
    finish_replacing(run)
    scene = load_scene(shot)
    sequence = find_depth(shot, params.depth, report) if params.depth else None
    config, key, motion = requested_identity(shot, scene, run, params, device, report, depth_identity(shot, sequence))
    done = finished(run, key)
    if done is not None and params.resume:
        if sequence is not None:
            # The stored depth maps may have been removed.
            fitted_depth(sequence, scene, depth_key(sequence, solve_key(shot)), run, report)
        drop_begun(run, key)
        report.progress("training", 1, 1, "already trained")
        return done
    folder = shot.own(folder_for(run, key, params.resume))
    shot.own(folder / PREVIEWS_FOLDER)
    sweep_half_written(folder)
    need_disk(folder, checkpoint_bytes(config), "a training's checkpoint")
    if folder != run and params.resume:
        report.warning(
            "The run's settings, cameras or motion mattes changed: training starts again from the beginning.",
            "The existing run is kept until the new one is done.",
        )
    depth = None
    if sequence is not None:
        depth = fitted_depth(sequence, scene, depth_key(sequence, solve_key(shot)), folder, report)
    identity: dict[str, Any] = {"key": key, "solve": solve_key(shot), "motion": motion, "pictures": pictures_key(shot)}
    if depth is not None:
        identity["depth"] = {name: depth.facts[name] for name in ("key", "source")}
    prepared = _prepared(shot, scene, config, folder, identity, depth, device, report)
    checkpoint = folder / CHECKPOINT_FILE
    resumed = _resume(prepared.trainer, checkpoint, params.resume, report)
    for name in (SUMMARY_FILE, EXTENSION_FILE):  # both belong to the checkpoint that is about to be replaced
        remove_file(folder / name)
    write_json(folder / CONFIG_FILE, {"version": 1, **identity, "config": config_to_json(config)})
    begun_at = prepared.trainer.iteration if resumed else -1
    summary = prepared.trained(shot, params.run, folder, checkpoint, begun_at)
    write_json(folder / SUMMARY_FILE, summary)
    if folder != run:
        replace_run(run, folder)
    return _report_summary(summary, report)


def extend_run(shot: Shot, params: TrainParams, report: Reporter) -> dict[str, Any]:
    """Adds `params.extend` steps to a finished run, with the run's settings; continues an interrupted extension.

    The run stays unchanged and usable for freezing until the last step is done. Returns its new figures. JobError if
    there is no run to extend.
    """
    if params.extend < 0:
        raise UserError(f"extend is {params.extend}: it is a number of steps to add")
    folder = shot.own(shot.run(params.run))
    shot.own(folder / PREVIEWS_FOLDER)
    finish_replacing(folder)
    facts, before = _extendable(shot, params.run, folder)
    checkpoint, extension = folder / CHECKPOINT_FILE, folder / EXTENSION_FILE
    config, scene = config_from_json(facts["config"]), load_scene(shot)
    device = choose_device(params.device, report, "Training")
    need_disk(folder, checkpoint_bytes(config), "a training's checkpoint")
    identity = {name: facts.get(name) for name in ("key", "solve", "motion")} | {"pictures": pictures_key(shot)}
    depth = None
    if facts.get("depth"):
        identity["depth"], depth = facts["depth"], load_fitted(folder, str(facts["depth"]["key"]))
    prepared = _prepared(shot, scene, config, folder, identity, depth, device, report, int(before["gaussians"]))
    trainer, begun = prepared.trainer, pending(folder, facts) if params.resume else None
    if before["iterations"] != facts["iteration"]:  # killed after the checkpoint: only the summary is missing
        restore_run(trainer, checkpoint)
    elif begun is not None and begun.steps == params.extend:
        restore_run(trainer, extension)
        done = trainer.iteration - begun.from_iteration
        report.progress("training", done, begun.steps, f"resumed at step {trainer.iteration}")
    else:
        if begun is not None:
            report.warning(
                f"{begun.steps} steps were started, but {params.extend} are requested: the extension starts again "
                "from the beginning."
            )
        restore_run(trainer, checkpoint)
        trainer.extend(params.extend, before["heldout_psnr_db"])
    summary = prepared.trained(shot, params.run, folder, extension, trainer.iteration)
    # In this order: after a kill in between, the next call only writes what is missing.
    save_run(trainer, checkpoint)
    write_json(folder / SUMMARY_FILE, summary)
    remove_file(extension)
    return _report_summary(summary, report)


def _extendable(shot: Shot, run: str, folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """(facts of the checkpoint, summary) of a run that can be extended. JobError if it cannot."""
    hint, checkpoint = "Train it without --extend first.", folder / CHECKPOINT_FILE
    facts = read_meta(checkpoint) if checkpoint.is_file() else {}
    if not facts:
        raise JobError(f"{shot.root.name} has no trained run {run!r} to extend.", hint, ExitCode.TRAIN)
    before = read_json(folder / SUMMARY_FILE) if (folder / SUMMARY_FILE).is_file() else {}
    if before.get("key") != facts["key"]:
        raise JobError(f"The run {run!r} is not finished: it cannot be extended yet.", hint, ExitCode.TRAIN)
    if facts["solve"] != solve_key(shot):
        message = f"The run {run!r} was trained on other cameras than the shot has now: it cannot be extended."
        raise JobError(message, "Remove the run or choose another name, then train.", ExitCode.TRAIN)
    if has_changed_pictures(shot, facts):
        message = f"The run {run!r} was trained on other pictures than the shot has now: it cannot be extended."
        raise JobError(message, "Train it again.", ExitCode.TRAIN)
    motion = facts.get("motion")  # also None for runs of versions that did not use mattes
    # A freeze may add mattes that the solve did not find. Runs trained with painted mattes only can still be extended.
    if motion and motion not in (motion_key(shot), motion_key(shot, with_found=False)):
        message = f"The run {run!r} was trained with other motion mattes than the shot has now."
        raise JobError(message, "Train it again: it cannot be extended.", ExitCode.TRAIN)
    return facts, before


def _prepared(
    shot: Shot, scene: Scene, config: TrainConfig, folder: Path, identity: dict[str, Any], depth: FittedDepth | None,
    device: torch.device, report: Reporter, gaussians: int = 0,
) -> _Prepared:  # fmt: skip
    """Creates the trainer with images and masks. gaussians: number of Gaussians of a run to extend; 0: a new run."""
    warm_up(config, device)
    if depth is not None and device.type == "cpu":
        raster_cpu.warm_up(channels=2)
    train, test = split_frames(scene.solved, config.holdout, config.holdout_phase)
    pictures = pictures_of(shot, scene, config, report)
    images = pictures.load(train + test, report, folder)
    plan = planned(config, pictures.size, len(train), images, device, report, gaussians)
    images = place_images(images, device, plan)
    mattes = functools.partial(load_motion, shot)
    movers = load_movers(mattes, scene, train, *pictures.size) if identity["motion"] else None
    ignored = load_ignored(functools.partial(load_mask, shot, IGNORE), scene, train + test, *pictures.size)
    limits = () if plan is None else (plan.gaussians, plan.pieces)
    trainer = Trainer(
        scene, images[: len(train)], train, config, report, identity, device, movers, ignored, *limits, depth=depth
    )
    if depth is not None and trainer.targets is None:
        report.warning(
            "This run uses no motion mattes: its depth maps only affect the start of the training and frozen frames."
        )
    return _Prepared(trainer, test, images[len(train) :])


def _report_summary(summary: dict[str, Any], report: Reporter) -> dict[str, Any]:
    """Reports a summary and warns of a poor run; returns the summary."""
    report.metric("train", summary)
    warn_if_poor(summary, report)
    return summary


def warm_up(config: TrainConfig, device: torch.device) -> None:
    """Sets the number of threads and compiles the kernels that a run on `device` needs."""
    torch.set_num_threads(default_threads())
    if device.type == "cpu":  # kernels are compiled in the main thread, before the first step is timed
        for module in (raster_cpu, ssim, adam):
            module.warm_up()
        if config.method != "static":
            host(config.host).warm_up(config.field)


def planned(
    config: TrainConfig, size: tuple[int, int], frames: int, images: Tensor, device: torch.device, report: Reporter,
    gaussians: int = 0,
) -> MemoryPlan | None:  # fmt: skip
    """Memory plan of a run on a GPU; None on the CPU. Warns if the run is reduced.

    Args:
        size: (width, height) of the images in pixels.
        frames: number of training frames.
        images: training and held-out images.
        gaussians: number of Gaussians of a run to extend; 0: a new run.
    """
    if device.type == "cpu":
        return None
    plan = plan_memory(config, size, frames, images.nbytes, free_bytes(device), gaussians)
    if plan.sentence:
        report.warning(plan.sentence)
    return plan


def place_images(images: Tensor, device: torch.device, plan: MemoryPlan | None) -> Tensor:
    """Images [I, H, W, 3] on the device if the plan says so, otherwise in host memory (pinned, unless too large)."""
    if plan is None:
        return images
    if plan.on_card:
        return images.to(device)
    return images.pin_memory() if images.nbytes <= IMAGE_MEMORY_BYTES else images


def checkpoint_bytes(config: TrainConfig) -> float:
    """Maximum bytes of a run's checkpoints on disk; a new one is written while the previous one still exists."""
    numbers = 11 + 3 * (config.sh_degree + 1) ** 2  # values per Gaussian, each with two moments
    return 2.0 * (config.densify.budget * (3 * 4 * numbers + 40) + _FIELD_BYTES)


def _resume(trainer: Trainer, checkpoint: Path, resume: bool, report: Reporter) -> bool:
    if not (resume and checkpoint.is_file()):
        return False
    if read_meta(checkpoint).get("key") != trainer.identity["key"]:
        return False
    restore_run(trainer, checkpoint)
    report.progress("training", trainer.iteration, trainer.config.iterations, f"resumed at step {trainer.iteration}")
    return True
