"""Saves a run in training to its checkpoint, and restores it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..contract import ExitCode, JobError
from ..gaussians import Densifier
from ..torch_types import integers
from .checkpoint import MISFITS, load_checkpoint, misfit, optimizer_state, restore_optimizer, save_checkpoint
from .config import config_to_json
from .extend import Extension
from .model import restore_model
from .optimizer import add_field, optimizer_of
from .trainer import Trainer


def save_run(trainer: Trainer, path: Path | None) -> None:
    """Writes everything that `restore_run` needs to `path`; None: writes nothing."""
    if path is None:
        return
    tensors = {**trainer.model.gaussians.state(), **optimizer_state(trainer.named_tensors(), trainer.optimizer)}
    if trainer.model.field is not None:
        tensors.update(trainer.model.field.state())
    tensors.update(trainer.mean.state())
    tensors.update(trainer.soundness.memory.state())
    d = trainer.densifier
    tensors.update({"densify.gradient": d.gradient, "densify.seen": d.seen})
    tensors["generator"] = trainer.generator.get_state()
    tensors["order"] = torch.tensor(trainer.order, dtype=torch.long, device="cpu")
    tensors["centres"] = trainer.centres
    tensors["exposure"] = trainer.model.exposure.values
    if trainer.config.poses.on:
        tensors["poses"] = trainer.poses.values
    meta = {
        **trainer.identity,
        "config": config_to_json(trainer.config),
        "iteration": trainer.iteration,
        "initial": trainer.initial,
        "extensions": [dataclasses.asdict(extension) for extension in trainer.extensions],
        "needs": trainer.policy.state(),
        "trained_seconds": trainer.trained_seconds,
        "sh_degree": trainer.model.sh_degree,
        "field_rates": trainer.soundness.memory.rates,
        "train_frames": [trainer.scene.frames[i] for i in trainer.train_ids],
        "width": trainer.width,
        "height": trainer.height,
    }
    save_checkpoint(path, tensors, meta)


def restore_run(trainer: Trainer, path: Path) -> None:
    """Restores the state saved by `save_run`. JobError if the checkpoint has other frames or does not fit."""
    tensors, meta = load_checkpoint(path)
    try:
        _restore(trainer, tensors, meta)
    except MISFITS as error:
        raise misfit(path, error, ExitCode.TRAIN) from None


def _restore(trainer: Trainer, tensors: dict[str, Tensor], meta: dict[str, Any]) -> None:
    if meta["train_frames"] != [trainer.scene.frames[i] for i in trainer.train_ids]:
        raise JobError(
            "The run's checkpoint was trained on other frames.", "Train with --restart, or choose another run name.",
            ExitCode.TRAIN,
        )  # fmt: skip
    trainer.model = restore_model(tensors, meta, trainer.config, trainer.device)
    trainer.recorder = trainer.new_recorder()  # the old recorder refers to other tensors
    trainer.optimizer = optimizer_of(trainer.model, trainer.poses, trainer.config)
    if trainer.model.field is not None:
        rates = trainer.soundness.memory.rates = float(meta.get("field_rates", 1.0))
        add_field(trainer.optimizer, trainer.model.field, trainer.model.gaussians, trainer.config, rates)
    if trainer.config.poses.on:
        trainer.poses.values.data.copy_(tensors["poses"])
    restore_optimizer(trainer.named_tensors(), trainer.optimizer, tensors)
    trainer.mean.restore(tensors, trainer.device)
    trainer.soundness.memory.restore(tensors)
    trainer.model.pieces = trainer.pieces
    trainer.densifier = Densifier(trainer.densify_config(), len(trainer.model.gaussians), trainer.device)
    for name in ("gradient", "seen"):
        setattr(trainer.densifier, name, tensors[f"densify.{name}"].to(trainer.device, copy=True))
    trainer.generator.set_state(tensors["generator"])
    trainer.order = integers(tensors["order"])
    trainer.iteration, trainer.initial = int(meta["iteration"]), int(meta["initial"])
    trainer.extensions = [Extension(**facts) for facts in meta.get("extensions", [])]
    trainer.policy.restore(meta["needs"])
    if trainer.config.poses.on and trainer.progress >= trainer.config.poses.until:
        trainer.freeze_poses()
    trainer.trained_seconds = float(meta["trained_seconds"])
