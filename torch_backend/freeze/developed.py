"""Instants of a run, developed once and kept in its folder: a file each, known by what it was made from."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..contract import JobError, frame_file
from ..gaussians.model import PARAM_NAMES
from ..scene import Scene
from ..shot import Shot, content_key, make_folder
from ..solve.motion import load_motion, motion_key
from ..train import LoadedRun
from ..train.checkpoint import load_checkpoint, read_meta, save_checkpoint
from .develop import DevelopConfig, develop
from .instant import instant_layer, join
from .query import Descent, FrozenGaussians
from .sightings import motion_mattes

FOLDER = "developed"
"""Of developed instants, in a run's folder."""
VERSION = 1
"""Rises when instants developed before are not to be used any more."""


def config_for(run: LoadedRun) -> DevelopConfig:
    """How instants of a run are developed: as large as it was trained, at least `DevelopConfig.width`."""
    usual = DevelopConfig()
    larger = max(1.0, run.width / usual.width)
    return dataclasses.replace(usual, width=max(usual.width, run.width), steps=round(usual.steps * larger))


def developed_key(shot: Shot, run: LoadedRun, t_star: float, config: DevelopConfig) -> str:
    """Identifies what a developed instant is made from and how."""
    return content_key(VERSION, run.stamp, t_star, motion_key(shot), dataclasses.asdict(config))


def load_developed(
    shot: Shot, run: LoadedRun, t_star: int, frozen: FrozenGaussians, config: DevelopConfig | None = None
) -> FrozenGaussians | None:
    """The instant as it was developed before; None if it was not, or from something else, or its file is damaged."""
    path, key = _path(shot, run, t_star), developed_key(shot, run, t_star, config or config_for(run))
    if not path.is_file() or read_meta(path).get("key") != key:
        return None
    try:
        tensors, _ = load_checkpoint(path)
    except JobError:
        return None
    device, known = frozen.support.device, len(frozen.support)
    base = {name: tensors[f"base.{name}"].to(device) for name in PARAM_NAMES}
    count = len(base["means"])
    before = FrozenGaussians(base, frozen.sh_degree, _grown(frozen.support, count), _grown(frozen.motion, count))
    if len(before.support) < known:
        return None
    state = {name: tensors[f"state.{name}"].to(device) for name in PARAM_NAMES}
    origin = tensors["origin"].to(device)
    return FrozenGaussians(
        state, frozen.sh_degree, before.support[origin], before.motion[origin], Descent(before, origin)
    )


def developed(
    shot: Shot, run: LoadedRun, scene: Scene, t_star: int, frozen: FrozenGaussians,
    config: DevelopConfig | None = None, check: Callable[[int, int], None] | None = None, keep: bool = True,
) -> FrozenGaussians:  # fmt: skip
    """The scene frozen at frame `t_star`, developed: from the run's folder if it is there, else made now and kept.

    Args:
        frozen: the run's scene at t*.
        check: called with steps done and in all; raises to cancel, and then nothing is kept.
        keep: write it into the run's folder.
    """
    config = config or config_for(run)
    made = load_developed(shot, run, t_star, frozen, config)
    if made is not None:
        return made
    layer = instant_layer(run, scene, None, frozen, float(t_star), motion=lambda frame: load_motion(shot, frame))
    joined = frozen if layer is None else join(frozen, layer)
    made = develop(run, scene, joined, t_star, motion_mattes(shot), config, check)
    if keep and not run.stale:
        _save(shot, run, t_star, made, developed_key(shot, run, t_star, config))
    return made


def _save(shot: Shot, run: LoadedRun, t_star: int, made: FrozenGaussians, key: str) -> None:
    assert made.descent is not None
    path = _path(shot, run, t_star)
    make_folder(path.parent)
    tensors: dict[str, Tensor] = {"origin": made.descent.origin}
    tensors |= {f"state.{name}": made.state[name] for name in PARAM_NAMES}
    tensors |= {f"base.{name}": made.descent.frozen.state[name] for name in PARAM_NAMES}
    meta: dict[str, Any] = {"key": key, "t_star": t_star}
    save_checkpoint(path, tensors, meta)


def _path(shot: Shot, run: LoadedRun, t_star: int) -> Path:
    return shot.own(run.folder / FOLDER) / frame_file(t_star, ".safetensors")


def _grown(values: Tensor, count: int) -> Tensor:
    """[N] values with 1 behind them, [count]: what the layer adds is known at t*, and moves."""
    return torch.cat([values, values.new_ones(max(0, count - len(values)))])
