"""What a run is known by: its numbers, the cameras, pictures, mattes and depth maps that it is trained on."""

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


def asked_for(
    shot: Shot, scene: Scene, run: Path, params: TrainParams, device: torch.device, report: Reporter, depth: list[str]
) -> tuple[TrainConfig, str, str | None]:
    """(numbers, key, motion) of the run that is requested; motion is the key of its mattes, None without. `depth` is
    `depth_identity` of its depth maps.

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


def depth_identity(shot: Shot, sequence: DepthSequence | None) -> list[str]:
    """What a run's key has of its depth maps; empty without."""
    return [] if sequence is None else [f"depth {depth_key(sequence, solve_key(shot))}"]


def _identity(shot: Shot, scene: Scene, run: Path, config: TrainConfig, depth: list[str]) -> tuple[str, str | None]:
    """(key, motion) of a run of these numbers, see `asked_for`."""
    train, test = split_frames(scene.solved, config.holdout, config.holdout_phase)
    motion = motion_of(shot, config)
    key = content_key(config_to_json(config), solve_key(shot), train, test, *masks_key(shot, IGNORE), *depth)
    if motion and not trained_without(shot, run, key):
        key = content_key(key, motion)
    else:
        motion = None
    # With cameras that were given, another grade of the footage is the same solve.
    anew, folder = content_key(key, pictures_key(shot)), begun(run, key)
    if begun(run, anew) is not None or (folder and of_other_pictures(shot, read_meta(folder / CHECKPOINT_FILE))):
        key = anew
    return key, motion


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


def of_other_pictures(shot: Shot, facts: dict[str, Any]) -> bool:
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
