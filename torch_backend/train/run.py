"""The training station: a solved shot and a request in, a run folder out."""

from __future__ import annotations

import dataclasses
import functools
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..contract import (
    CONFIG_FILE,
    LONGEST_JSON,
    METRICS_FILE,
    PREVIEWS_FOLDER,
    ExitCode,
    JobError,
    Reporter,
    TrainParams,
    UserError,
    file_digest,
    is_link,
    open_regular,
    read_json,
    remove_link,
    sweep_half_written,
)
from ..deformation import host
from ..footage import load_frames
from ..footage.depth_maps import DepthSequence, find_depth
from ..footage.images import write_png
from ..native import default_threads
from ..raster import cpu as raster_cpu
from ..raster import ssim
from ..scene import HELD_BYTES, Scene, load_scene, split_frames
from ..shot import Shot, content_key, make_folder, need_disk, remove_file, write_atomic, write_json
from ..solve.masks import IGNORE, load_mask, masks_key
from ..solve.motion import load_motion, motion_key
from . import adam
from .anew import SUMMARY_FILE, begun, drop_begun, finish_replacing, folder_for, replace_run
from .checkpoint import CHECKPOINT_FILE, MISFITS, load_checkpoint, misfit, read_meta
from .config import TrainConfig, config_from_json, config_from_params, config_to_json
from .depth import FittedDepth, depth_key, fitted_depth, load_fitted
from .device import choose_device
from .evidence import gather_evidence
from .extend import EXTENSION_FILE, pending
from .ignored import load_ignored
from .memory import MemoryPlan, free_bytes, plan_memory
from .model import DynamicModel, restore_model
from .modelled import modelled
from .movers import Mattes, load_movers
from .pictures import pictures_of
from .pictures import training_size as training_size
from .trainer import Trainer
from .verdict import figures_of, verdict_fields, warn_if_poor

_ATTEMPTS = 5
"""A checkpoint that is replaced while it is read is read so often; a training writes one in 30 s."""
_FIELD_BYTES = 14e6
"""Of a field with its moments, and of a run's small things (a preview's HexPlane: 4.4 MB)."""


@dataclass
class LoadedRun:
    """A finished (or interrupted) run, ready to be rendered."""

    folder: Path
    """runs/<name>."""
    config: TrainConfig
    """Its numbers."""
    model: DynamicModel
    """Its Gaussians and field."""
    width: int
    """Width in pixels of the images it was trained on."""
    height: int
    """Height of them."""
    train_frames: list[int]
    """Frame numbers it was trained on."""
    stamp: str
    """`contract.file_digest` of the checkpoint that the model is from: what is made of it is known by it."""
    former_stamp: list[Any] = dataclasses.field(default_factory=list[Any])
    """The checkpoint's name, size and modification time (ns), by which earlier versions knew it."""
    depth_key: str = ""
    """Identifies the artist's depth maps that it was trained with; empty without."""

    def depth(self) -> FittedDepth | None:
        """Those maps, read from the run's folder; None without. JobError (TRAIN) if they are not there any more."""
        return load_fitted(self.folder, self.depth_key) if self.depth_key else None

    @property
    def stale(self) -> bool:
        """True if the run has been trained since it was loaded."""
        return _stamp(self.folder / CHECKPOINT_FILE) != self.stamp


def train_shot(shot: Shot, params: TrainParams, report: Reporter) -> dict[str, Any]:
    """Trains one run; resumes its checkpoint if asked to and the settings are the same; or extends a finished one.

    A run of other settings, or one that is to begin anew, stays as it is until this one is done (see `anew`).
    Returns the run's figures, also written to runs/<name>/summary.json. JobError in words if it cannot be done.
    """
    if params.extend:
        return extend_run(shot, params, report)
    config_from_params(params)  # refuses what does not exist before anything is looked for
    device = choose_device(params.device, report, "Training")
    run = shot.own(shot.run(params.run))
    shot.own(run / PREVIEWS_FOLDER)
    finish_replacing(run)
    scene = load_scene(shot)
    sequence = find_depth(shot, params.depth, report) if params.depth else None
    config, key, motion = _asked(shot, scene, run, params, device, report, _depth_identity(shot, sequence))
    train, test = split_frames(scene.solved, config.holdout, config.holdout_phase)
    done = finished(run, key)
    if done is not None and params.resume:
        if sequence is not None:
            fitted_depth(sequence, scene, depth_key(sequence, solve_key(shot)), run, report)  # it may have been removed
        drop_begun(run, key)
        report.progress("training", 1, 1, "already trained")
        return done
    folder = shot.own(folder_for(run, key, params.resume))
    shot.own(folder / PREVIEWS_FOLDER)
    sweep_half_written(folder)
    need_disk(folder, checkpoint_bytes(config), "a training's checkpoint")
    if folder != run and params.resume:
        report.warning(
            "The run's settings, cameras or motion mattes changed: it is trained anew.",
            "The run that is there stays until the new one is done.",
        )
    depth = None
    if sequence is not None:
        depth = fitted_depth(sequence, scene, depth_key(sequence, solve_key(shot)), folder, report)
    warm_up(config, device)
    if depth is not None and device.type == "cpu":
        raster_cpu.warm_up(channels=2)
    pictures = pictures_of(shot, scene, config, report)
    width, height = pictures.size
    images = pictures.load(train + test, report, folder)
    plan = planned(config, (width, height), len(train), images, device, report)
    images = place_images(images, device, plan)
    identity: dict[str, Any] = {"key": key, "solve": solve_key(shot), "motion": motion, "pictures": pictures_key(shot)}
    if depth is not None:
        identity["depth"] = {name: depth.facts[name] for name in ("key", "source")}
    movers = load_movers(_likely(shot), scene, train, width, height) if motion else None
    ignored = load_ignored(functools.partial(load_mask, shot, IGNORE), scene, train + test, width, height)
    limits = () if plan is None else (plan.gaussians, plan.pieces)
    trainer = Trainer(
        scene, images[: len(train)], train, config, report, identity, device, movers, ignored, *limits, depth=depth
    )
    if depth is not None and trainer.targets is None:
        report.warning(
            "This run heeds no motion mattes: its depth maps are used where the training begins and in frozen frames, "
            "and pull nothing in between."
        )
    checkpoint = folder / CHECKPOINT_FILE
    resumed = _resume(trainer, checkpoint, params.resume, report)
    for name in (SUMMARY_FILE, EXTENSION_FILE):  # they speak of the checkpoint that is about to be replaced
        remove_file(folder / name)
    write_json(folder / CONFIG_FILE, {"version": 1, **identity, "config": config_to_json(config)})
    metrics = Metrics(folder, report, trainer.iteration if resumed else -1)
    held_out = images[len(train) :]

    def evaluate(t: Trainer) -> None:
        metrics.add(t, test, held_out)

    trainer.run(checkpoint, evaluate)
    summary = summarise(trainer, params.run, test, held_out, key, functools.partial(load_motion, shot))
    write_json(folder / SUMMARY_FILE, summary)
    if folder != run:
        replace_run(run, folder)
    report.metric("train", summary)
    warn_if_poor(summary, report)
    return summary


def extend_run(shot: Shot, params: TrainParams, report: Reporter) -> dict[str, Any]:
    """Adds `params.extend` steps to a finished run, with the run's own settings; goes on with them if they were begun.

    The run stays as it is, for whoever freezes from it, until the last step is done. Returns its new figures.
    JobError in words if there is nothing to extend.
    """
    if params.extend < 0:
        raise UserError(f"extend is {params.extend}: it is a number of steps to add")
    folder, again = shot.own(shot.run(params.run)), "Train it without --extend first."
    shot.own(folder / PREVIEWS_FOLDER)
    finish_replacing(folder)
    checkpoint, beside = folder / CHECKPOINT_FILE, folder / EXTENSION_FILE
    facts = read_meta(checkpoint) if checkpoint.is_file() else {}
    if not facts:
        raise JobError(f"{shot.root.name} has no trained run {params.run!r} to extend.", again, ExitCode.TRAIN)
    before = read_json(folder / SUMMARY_FILE) if (folder / SUMMARY_FILE).is_file() else {}
    if before.get("key") != facts["key"]:
        raise JobError(f"The run {params.run!r} is not finished: it cannot be extended yet.", again, ExitCode.TRAIN)
    if facts["solve"] != solve_key(shot):
        message = f"The run {params.run!r} was trained on other cameras than the shot has now: it cannot be extended."
        raise JobError(message, "Remove the run or name another one, then train.", ExitCode.TRAIN)
    if _of_other_pictures(shot, facts):
        message = f"The run {params.run!r} was trained on other pictures than the shot has now: it cannot be extended."
        raise JobError(message, "Train it again.", ExitCode.TRAIN)
    motion = facts.get("motion")  # None too if it was trained before mattes counted
    # A freeze finds mattes where the solve did not: what was trained with painted ones alone can still be extended.
    if motion and motion not in (motion_key(shot), motion_key(shot, with_found=False)):
        message = f"The run {params.run!r} was trained with other motion mattes than the shot has now."
        raise JobError(message, "Train it again: it cannot be extended.", ExitCode.TRAIN)
    config, scene = config_from_json(facts["config"]), load_scene(shot)
    device = choose_device(params.device, report, "Training")
    warm_up(config, device)
    train, test = split_frames(scene.solved, config.holdout, config.holdout_phase)
    pictures = pictures_of(shot, scene, config, report)
    size = pictures.size
    images = pictures.load(train + test, report, folder)
    plan = planned(config, size, len(train), images, device, report, int(before["gaussians"]))
    images = place_images(images, device, plan)
    held_out = images[len(train) :]
    need_disk(folder, checkpoint_bytes(config), "a training's checkpoint")
    identity = {**{name: facts[name] for name in ("key", "solve")}, "motion": motion, "pictures": pictures_key(shot)}
    depth = None
    if facts.get("depth"):
        identity["depth"], depth = facts["depth"], load_fitted(folder, str(facts["depth"]["key"]))
    movers = load_movers(_likely(shot), scene, train, *size) if motion else None
    ignored = load_ignored(functools.partial(load_mask, shot, IGNORE), scene, train + test, *size)
    limits = () if plan is None else (plan.gaussians, plan.pieces)
    trainer = Trainer(
        scene, images[: len(train)], train, config, report, identity, device, movers, ignored, *limits, depth=depth
    )
    begun = pending(folder, facts) if params.resume else None
    if before["iterations"] != facts["iteration"]:  # it was killed between its last two files: only figures are missing
        trainer.restore(checkpoint)
    elif begun is not None and begun.steps == params.extend:
        trainer.restore(beside)
        done = trainer.iteration - begun.from_iteration
        report.progress("training", done, begun.steps, f"resumed at step {trainer.iteration}")
    else:
        if begun is not None:
            report.warning(f"{begun.steps} steps were begun, {params.extend} are asked for: they begin anew.")
        trainer.restore(checkpoint)
        trainer.extend(params.extend, before["heldout_psnr_db"])
    metrics = Metrics(folder, report, trainer.iteration)
    trainer.run(beside, lambda t: metrics.add(t, test, held_out))
    mattes = functools.partial(load_motion, shot)
    summary = summarise(trainer, params.run, test, held_out, facts["key"], mattes)
    trainer.save(checkpoint)
    write_json(folder / SUMMARY_FILE, summary)
    remove_file(beside)
    report.metric("train", summary)
    warn_if_poor(summary, report)
    return summary


def _asked(
    shot: Shot, scene: Scene, run: Path, params: TrainParams, device: torch.device, report: Reporter, depth: list[str]
) -> tuple[TrainConfig, str, str | None]:
    """(numbers, key, motion) of the run that is asked for; motion is the key of its mattes, None without. `depth` is
    `_depth_identity` of its depth maps.

    A preset has other numbers on a card. What was begun or finished with those of the other device stays that run, and
    goes on: a driver that fails for a day makes no training begin anew.
    """
    on_card = device.type == "cuda"
    config, elsewhere = config_from_params(params, on_card), config_from_params(params, not on_card)
    key, motion = _identity(shot, scene, run, config, depth)
    if elsewhere == config or not params.resume or begun(run, key) is not None:
        return config, key, motion
    its_key, its_motion = _identity(shot, scene, run, elsewhere, depth)
    if begun(run, its_key) is None:
        return config, key, motion
    if finished(run, its_key) is None:
        where = "the processor" if on_card else "a graphics card"
        report.warning(
            f"The run was begun with the preset's numbers for {where}: it goes on with them.",
            "Train it with --restart, or another run, for those of this device.",
        )
    return elsewhere, its_key, its_motion


def _depth_identity(shot: Shot, sequence: DepthSequence | None) -> list[str]:
    """What a run's key has of its depth maps; empty without."""
    return [] if sequence is None else [f"depth {depth_key(sequence, solve_key(shot))}"]


def _identity(shot: Shot, scene: Scene, run: Path, config: TrainConfig, depth: list[str]) -> tuple[str, str | None]:
    """(key, motion) of a run of these numbers, see `_asked`."""
    train, test = split_frames(scene.solved, config.holdout, config.holdout_phase)
    motion = motion_of(shot, config)
    key = content_key(config_to_json(config), solve_key(shot), train, test, *masks_key(shot, IGNORE), *depth)
    if motion and not trained_without(shot, run, key):
        key = content_key(key, motion)
    else:
        motion = None
    # With cameras that were given, another grade of the footage is the same solve.
    anew, there = content_key(key, pictures_key(shot)), begun(run, key)
    if begun(run, anew) is not None or (there and _of_other_pictures(shot, read_meta(there / CHECKPOINT_FILE))):
        key = anew
    return key, motion


def warm_up(config: TrainConfig, device: torch.device) -> None:
    """Sets the threads and compiles what a run on that device needs."""
    torch.set_num_threads(default_threads())
    if device.type == "cpu":  # kernels compile from the main thread, before the clock of the first step
        for module in (raster_cpu, ssim, adam):
            module.warm_up()
        if config.method != "static":
            host(config.host).warm_up(config.field)


def _likely(shot: Shot) -> Mattes:
    """The motion mattes as a training wants them: its field is offered what is likely to move, too."""
    return functools.partial(load_motion, shot, likely=True)


def planned(
    config: TrainConfig, size: tuple[int, int], frames: int, images: Tensor, device: torch.device, report: Reporter,
    gaussians: int = 0,
) -> MemoryPlan | None:  # fmt: skip
    """How a run of so many trained frames of `size` px, whose images with those held out are `images`, fits its card;
    said if it is smaller than asked for. None on the processor. gaussians: how many a run has that only goes on."""
    if device.type == "cpu":
        return None
    plan = plan_memory(config, size, frames, images.nbytes, free_bytes(device), gaussians)
    if plan.sentence:
        report.warning(plan.sentence)
    return plan


def place_images(images: Tensor, device: torch.device, plan: MemoryPlan | None) -> Tensor:
    """Images [I, H, W, 3] on the device if they are to lie there, else in host memory: pinned, unless too many."""
    if plan is None:
        return images
    if plan.on_card:
        return images.to(device)
    return images.pin_memory() if images.nbytes <= HELD_BYTES else images


def checkpoint_bytes(config: TrainConfig) -> float:
    """Bytes that a run's checkpoints may need on disk, at most: one is written while the one before is still there."""
    numbers = 11 + 3 * (config.sh_degree + 1) ** 2  # of a Gaussian; with two moments each, and what saw it
    return 2.0 * (config.densify.budget * (3 * 4 * numbers + 40) + _FIELD_BYTES)


def finished(folder: Path, key: str) -> dict[str, Any] | None:
    """The summary of a run that was finished with the same settings on the same solve, extended or not; or None."""
    path = folder / SUMMARY_FILE
    checkpoint = folder / CHECKPOINT_FILE
    if not path.is_file() or not checkpoint.is_file():
        return None
    summary, facts = read_json(path), read_meta(checkpoint)
    current = summary.get("iterations") == facts.get("iteration")
    return summary if current and summary.get("key") == key == facts.get("key") else None


def solve_key(shot: Shot) -> str:
    """Identifies the solved cameras, by content: a copied shot is still the same shot."""
    return content_key(read_json(shot.cameras))


def pictures_key(shot: Shot) -> str:
    """Identifies the working frames: of which footage they were taken, and how."""
    return str(load_frames(shot).get("key", ""))


def _of_other_pictures(shot: Shot, facts: dict[str, Any]) -> bool:
    """Was a checkpoint of these facts trained on other pictures than the shot has now?"""
    return facts.get("pictures") != pictures_key(shot)


def motion_of(shot: Shot, config: TrainConfig) -> str | None:
    """Identifies the motion mattes that a run of these settings is trained with; None if it is trained without."""
    frames = load_scene(shot).frames if config.decides else []
    has = any(load_motion(shot, frame) is not None for frame in frames)
    return motion_key(shot) if has else None


def trained_without(shot: Shot, run: Path, key: str) -> bool:
    """Was the run, of this key, trained before mattes were found? It stays, unless an artist has painted some since.

    A freeze finds mattes where the solve did not: that alone is no reason to train anew what it froze.
    """
    checkpoint = run / CHECKPOINT_FILE
    if any(shot.painted.glob("*.png")) or not checkpoint.is_file():
        return False
    return read_meta(checkpoint).get("key") in (key, content_key(key, pictures_key(shot)))


def _resume(trainer: Trainer, checkpoint: Path, resume: bool, report: Reporter) -> bool:
    if not (resume and checkpoint.is_file()):
        return False
    if read_meta(checkpoint).get("key") != trainer.identity["key"]:
        return False
    trainer.restore(checkpoint)
    report.progress("training", trainer.iteration, trainer.config.iterations, f"resumed at step {trainer.iteration}")
    return True


class Metrics:
    """metrics.jsonl and preview images of a run, while it trains.

    iteration: where the run goes on; what an earlier process measured later than that is dropped. -1: it begins.
    """

    def __init__(self, folder: Path, report: Reporter, iteration: int) -> None:
        self.folder, self.report = folder, report
        self.path = folder / METRICS_FILE
        if is_link(self.path):  # lines would be appended to what it leads to
            remove_link(self.path)
        make_folder(folder / PREVIEWS_FOLDER)
        for picture in (folder / PREVIEWS_FOLDER).glob("*.png"):
            if picture.stem.isdigit() and int(picture.stem) > iteration:
                picture.unlink()
        lines = _lines(self.path) if self.path.is_file() else []
        kept = [line for line in lines if _iteration_of(line) <= iteration]
        self._measured = max(map(_iteration_of, kept), default=-1.0)
        if kept != lines:
            write_atomic(self.path, "".join(f"{line}\n" for line in kept).encode("utf-8"))

    def add(self, trainer: Trainer, test: list[int], held_out: Tensor) -> None:
        """Measures on the held-out frames, appends a line, shows a preview; of a step only what is not there yet."""
        if self._measured < trainer.iteration:
            self._measure(trainer, test, held_out)
        preview = self.folder / PREVIEWS_FOLDER / f"{trainer.iteration:06d}.png"
        if not preview.is_file():
            index = test[len(test) // 2] if test else trainer.train_ids[len(trainer.train_ids) // 2]
            save_png(preview, trainer.render_frame(index))
            self.report.image("preview", preview)

    def _measure(self, trainer: Trainer, test: list[int], held_out: Tensor) -> None:
        value = trainer.heldout_psnr(test, held_out)
        row = {
            "seconds": round(trainer.trained_seconds, 2),
            "iteration": trainer.iteration,
            "heldout_psnr_db": None if value is None else round(value, 3),
            "gaussians": len(trainer.model.gaussians),
            "moving_share": round(moving_share(trainer.model), 5),
        }
        with open(self.path, "a", encoding="utf-8") as lines:
            lines.write(json.dumps(row) + "\n")
        self._measured = trainer.iteration
        self.report.metric("training", row)


def _lines(path: Path) -> list[str]:
    with open_regular(path, LONGEST_JSON) as source:
        return source.read().decode("utf-8", "replace").splitlines()


def _iteration_of(line: str) -> float:
    """Of a line of metrics.jsonl; infinite if it was half written."""
    try:
        return float(json.loads(line)["iteration"])
    except (ValueError, KeyError, TypeError):
        return float("inf")


def moving_share(model: DynamicModel) -> float:
    """Share of the Gaussians that the field moves."""
    return len(model.open_rows()) / max(1, len(model.gaussians))


def save_png(path: Path, image: Tensor) -> None:
    """Writes a display-referred [H, W, 3] image as 8-bit PNG."""
    write_png(path, (image.clamp(0.0, 1.0) * 255.0 + 0.5).to(torch.uint8).contiguous().cpu().numpy())


def summarise(
    trainer: Trainer, name: str, test: list[int], held_out: Tensor, key: str, mattes: Mattes | None = None
) -> dict[str, Any]:
    """The run's figures, units in the key names; what was modelled and what it cost."""
    value = trainer.heldout_psnr(test, held_out)
    model, seen = trainer.model, gather_evidence(trainer, test, held_out, mattes)
    return {
        "version": 1,
        "key": key,
        "run": name,
        "preset": trainer.config.preset,
        "method": trainer.config.method,
        "host": trainer.config.host,
        "host_config": trainer.config.host_config,
        "supervision": trainer.config.supervision.preset,
        "iterations": trainer.iteration,
        "extensions": [dataclasses.asdict(extension) for extension in trainer.extensions],
        "width_px": trainer.width,
        "height_px": trainer.height,
        "train_frames": len(trainer.train_ids),
        "heldout_frames": len(test),
        "heldout_psnr_db": None if value is None else round(value, 3),
        **verdict_fields(figures_of(seen, trainer.scene.width, trainer.width * trainer.height)),
        "gaussians": len(model.gaussians),
        "moving_gaussians": len(model.open_rows()),
        "moving_share": round(moving_share(model), 5),
        "device": model.device.type,
        "sh_degree": model.sh_degree,
        "train_seconds": round(trainer.trained_seconds, 2),
        "modelled": modelled(trainer),
        **({} if trainer.depth is None else {"depth": trainer.depth.facts}),
    }


def load_run(shot: Shot, name: str, device: torch.device | str = "cpu") -> LoadedRun:
    """A run as it stands in its checkpoint, on `device`. JobError if there is none."""
    folder = shot.run(name)
    checkpoint = folder / CHECKPOINT_FILE
    if not checkpoint.is_file():
        message = f"{shot.root.name} has no trained run named {name!r}."
        raise JobError(message, "Run the training step first.", ExitCode.FREEZE)
    for _ in range(_ATTEMPTS):
        stamp = _stamp(checkpoint)
        tensors, meta = load_checkpoint(checkpoint)
        if stamp == _stamp(checkpoint):  # else it was replaced meanwhile: which one was read cannot be told
            break
    else:
        message = f"The run {name!r} is written again and again while it is read."
        raise JobError(message, "Wait for its training to end.", ExitCode.FREEZE)
    if meta.get("solve") != solve_key(shot):
        message = f"The run {name!r} was trained on other cameras than the shot has now."
        raise JobError(message, "Train it again.", ExitCode.FREEZE)
    if _of_other_pictures(shot, meta):
        message = f"The run {name!r} was trained on other pictures than the shot has now: they were imported again."
        raise JobError(message, "Train it again.", ExitCode.FREEZE)
    try:
        config = config_from_json(meta["config"])
        model = restore_model(tensors, meta, config, device)
        size = int(meta["width"]), int(meta["height"])
        depth = str(meta["depth"]["key"]) if meta.get("depth") else ""
        return LoadedRun(
            folder, config, model, *size, list(meta["train_frames"]), stamp, _former_stamp(checkpoint), depth
        )
    except MISFITS as error:  # whole, but not as `save` wrote it
        raise misfit(checkpoint, error, ExitCode.FREEZE) from None


def _stamp(checkpoint: Path) -> str:
    """Digest of a checkpoint, empty if it is gone."""
    try:
        return file_digest(checkpoint)
    except FileNotFoundError:
        return ""


def _former_stamp(checkpoint: Path) -> list[Any]:
    """See `LoadedRun.former_stamp`."""
    status = checkpoint.stat()
    return [checkpoint.name, status.st_size, status.st_mtime_ns]
