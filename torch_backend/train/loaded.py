"""Loads a trained run for rendering or freezing."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from ..contract import ExitCode, JobError, file_digest
from ..shot import Shot
from .checkpoint import CHECKPOINT_FILE, MISFITS, load_checkpoint, misfit
from .config import TrainConfig, config_from_json
from .depth import FittedDepth, load_fitted
from .identity import has_changed_pictures, solve_key
from .model import DynamicModel, restore_model

# Number of attempts to read a checkpoint that is replaced during reading. Training writes one every 30 s.
_ATTEMPTS = 5


@dataclass
class LoadedRun:
    """A finished or interrupted run, ready to be rendered."""

    folder: Path
    """Folder of the run: runs/<name>."""
    config: TrainConfig
    """Configuration of the run."""
    model: DynamicModel
    """Gaussians and deformation field."""
    width: int
    """Width of the training images in pixels."""
    height: int
    """Height of the training images in pixels."""
    train_frames: list[int]
    """Frame numbers of the training images."""
    stamp: str
    """`contract.file_digest` of the checkpoint. Takes and developed instants store it to identify the checkpoint that
    they were made from."""
    former_stamp: list[Any] = dataclasses.field(default_factory=list[Any])
    """Name, size and modification time (ns) of the checkpoint, which earlier versions stored instead of `stamp`."""
    depth_key: str = ""
    """Key of the user's depth maps that the run was trained with; empty without maps."""

    def depth(self) -> FittedDepth | None:
        """Reads the depth maps from the run's folder; None if it was trained without. JobError (TRAIN) if missing."""
        return load_fitted(self.folder, self.depth_key) if self.depth_key else None

    @property
    def stale(self) -> bool:
        """True if the run has been trained since it was loaded."""
        return _stamp(self.folder / CHECKPOINT_FILE) != self.stamp


def load_run(shot: Shot, name: str, device: torch.device | str = "cpu") -> LoadedRun:
    """Loads a run from its checkpoint, on `device`. JobError if it is missing, or does not fit the shot or version."""
    folder = shot.run(name)
    checkpoint = folder / CHECKPOINT_FILE
    if not checkpoint.is_file():
        message = f"{shot.root.name} has no trained run named {name!r}."
        raise JobError(message, "Run the training step first.", ExitCode.FREEZE)
    for _ in range(_ATTEMPTS):
        stamp = _stamp(checkpoint)
        tensors, meta = load_checkpoint(checkpoint)
        if stamp == _stamp(checkpoint):  # otherwise the checkpoint was replaced while it was read
            break
    else:
        message = f"The run {name!r} keeps changing while it is read."
        raise JobError(message, "Wait for its training to end.", ExitCode.FREEZE)
    if meta.get("solve") != solve_key(shot):
        message = f"The run {name!r} was trained on other cameras than the shot has now."
        raise JobError(message, "Train it again.", ExitCode.FREEZE)
    if has_changed_pictures(shot, meta):
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
    except MISFITS as error:  # a readable file with missing or unexpected contents
        raise misfit(checkpoint, error, ExitCode.FREEZE) from None


def _stamp(checkpoint: Path) -> str:
    """Digest of a checkpoint; empty if the file is missing."""
    try:
        return file_digest(checkpoint)
    except FileNotFoundError:
        return ""


def _former_stamp(checkpoint: Path) -> list[Any]:
    """Value of `LoadedRun.former_stamp`."""
    status = checkpoint.stat()
    return [checkpoint.name, status.st_size, status.st_mtime_ns]
