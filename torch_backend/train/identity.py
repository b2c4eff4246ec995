"""Key of a run, computed from its configuration and its cameras, images, mattes and depth maps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from ..contract import Reporter, TrainParams, read_json
from ..footage import load_frames
from ..footage.depth_maps import DepthSequence
from ..motion.mattes import load_motion, motion_key
from ..scene import Scene, load_scene, split_frames
from ..sfm.masks import IGNORE, masks_key
from ..shot import Shot, content_key
from .anew import SUMMARY_FILE, begun
from .checkpoint import CHECKPOINT_FILE, read_meta
from .config import TrainConfig, config_from_params, config_to_json
from .depth import depth_key


def requested_identity(
    shot: Shot, scene: Scene, run: Path, params: TrainParams, device: torch.device, report: Reporter, depth: list[str]
) -> tuple[TrainConfig, str, str | None]:
    """(configuration, key, motion) of the requested run. `motion` is the key of its mattes; None without mattes.

    A preset differs between CPU and GPU. A run that was begun or finished with the configuration of the other device
    keeps it, so that a temporary driver fault does not restart the training.

    depth: `depth_identity` of the run's depth maps.
    """
    on_card = device.type == "cuda"
    config, alternative = config_from_params(params, on_card), config_from_params(params, not on_card)
    key, motion = _identity(shot, scene, run, config, depth)
    if alternative == config or not params.resume or begun(run, key) is not None:
        return config, key, motion
    alternative_key, alternative_motion = _identity(shot, scene, run, alternative, depth)
    if begun(run, alternative_key) is None:
        return config, key, motion
    if finished(run, alternative_key) is None:
        device_name = "the processor" if on_card else "a graphics card"
        report.warning(
            f"The run was started with the preset's settings for {device_name}, and continues with them.",
            "To use those for this device, train it with --restart, or train another run.",
        )
    return alternative, alternative_key, alternative_motion


def depth_identity(shot: Shot, sequence: DepthSequence | None) -> list[str]:
    """Parts of a run's key that identify its depth maps; empty without maps."""
    return [] if sequence is None else [f"depth {depth_key(sequence, solve_key(shot))}"]


def _identity(shot: Shot, scene: Scene, run: Path, config: TrainConfig, depth: list[str]) -> tuple[str, str | None]:
    """(key, motion) of a run with this configuration, see `requested_identity`."""
    train, test = split_frames(scene.solved, config.holdout, config.holdout_phase)
    motion = motion_of(shot, config)
    key = content_key(config_to_json(config), solve_key(shot), train, test, *masks_key(shot, IGNORE), *depth)
    if motion and not trained_without(shot, run, key):
        key = content_key(key, motion)
    else:
        motion = None
    # With imported cameras, regraded footage has the same solve key, so the images are part of the key.
    anew, folder = content_key(key, pictures_key(shot)), begun(run, key)
    if begun(run, anew) is not None or (folder and has_changed_pictures(shot, read_meta(folder / CHECKPOINT_FILE))):
        key = anew
    return key, motion


def finished(folder: Path, key: str) -> dict[str, Any] | None:
    """Summary of a finished run with key `key`, extended or not; None if there is none."""
    path = folder / SUMMARY_FILE
    checkpoint = folder / CHECKPOINT_FILE
    if not path.is_file() or not checkpoint.is_file():
        return None
    summary, facts = read_json(path), read_meta(checkpoint)
    current = summary.get("iterations") == facts.get("iteration")
    return summary if current and summary.get("key") == key == facts.get("key") else None


def solve_key(shot: Shot) -> str:
    """Key of the solved cameras by content, so that a copied shot keeps its runs."""
    return content_key(read_json(shot.cameras))


def pictures_key(shot: Shot) -> str:
    """Key of the working frames by their footage and import settings."""
    return str(load_frames(shot).get("key", ""))


def has_changed_pictures(shot: Shot, facts: dict[str, Any]) -> bool:
    """True if a checkpoint with these facts was trained on other working frames than the shot has now."""
    return facts.get("pictures") != pictures_key(shot)


def motion_of(shot: Shot, config: TrainConfig) -> str | None:
    """Key of the motion mattes that a run with this configuration uses; None if it uses none."""
    frames = load_scene(shot).frames if config.decides else []
    has = any(load_motion(shot, frame) is not None for frame in frames)
    return motion_key(shot) if has else None


def trained_without(shot: Shot, run: Path, key: str) -> bool:
    """True if the run with key `key` was trained before the shot had mattes, and the user has painted none.

    A freeze may add mattes that the solve did not find. These alone are no reason to retrain the run.
    """
    checkpoint = run / CHECKPOINT_FILE
    if any(shot.painted.glob("*.png")) or not checkpoint.is_file():
        return False
    return read_meta(checkpoint).get("key") in (key, content_key(key, pictures_key(shot)))
