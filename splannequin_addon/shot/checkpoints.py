"""Facts stored in a checkpoint of the backend, read without the backend. No bpy: file in, plain values out."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from ...torch_backend import contract
from ...torch_backend.contract import RunFolder
from . import file_cache


def facts(path: Path) -> dict[str, Any]:
    """The facts in a checkpoint's header; empty if there are none. The result is cached: do not modify it."""
    try:
        return file_cache.of(path, _facts)
    except OSError:
        return {}


def _facts(path: Path) -> dict[str, Any]:
    try:
        return contract.checkpoint_facts(path)
    except (OSError, ValueError):
        return {}


def paused(run: Path) -> dict[str, Any] | None:
    """Progress of an unfinished run with a checkpoint; None for any other run.

    The keys are `iteration`, `end`, `preset`, `config` and `depth_source`.
    """
    header = facts(RunFolder(run).checkpoint)
    try:
        config = header["config"]
        params: contract.TrainParams = contract.from_dict(contract.TrainParams, params_of(config))
        done: _Count = contract.from_dict(_Count, {"steps": header["iteration"]})
    except (KeyError, TypeError, AttributeError, ValueError):
        return None
    return {
        "iteration": done.steps, "end": params.iterations, "preset": params.preset, "config": config,
        "depth_source": depth_source(run),
    }  # fmt: skip


def depth_source(run: Path) -> str:
    """Absolute path of the depth maps that a run was trained with; empty without depth maps."""
    depth: object = facts(RunFolder(run).checkpoint).get("depth")
    source = cast("dict[str, Any]", depth).get("source") if isinstance(depth, dict) else None
    return source if isinstance(source, str) and os.path.isabs(source) and source.isprintable() else ""


@dataclass
class _Count:
    steps: int


def anew(run: Path) -> dict[str, Any] | None:
    """Progress of a run's repeated training, from its newest checkpoint; None if there is none.

    The keys are those of `paused`, and `folder`.
    """
    saved = sorted(RunFolder(run).next.glob(f"*/{contract.CHECKPOINT_FILE}"), key=_saved)
    progress = paused(saved[-1].parent) if saved else None
    return None if progress is None else {**progress, "folder": saved[-1].parent}


def _saved(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


def extension(run: Path) -> dict[str, int] | None:
    """Progress of additional steps for a finished run: `done` of `steps`; None if there are none."""
    folder = RunFolder(run)
    if not folder.extension.is_file():
        return None
    extended, base = facts(folder.extension), facts(folder.checkpoint)
    try:
        last = extended["extensions"][-1]
        if (extended["key"], last["from_iteration"]) != (base["key"], base["iteration"]):
            return None
        done: _Count = contract.from_dict(_Count, {"steps": extended["iteration"] - last["from_iteration"]})
        added: _Count = contract.from_dict(_Count, {"steps": last["steps"]})
    except (KeyError, TypeError, ValueError, IndexError):
        return None
    return {"done": done.steps, "steps": added.steps}


def params_of(config: dict[str, Any]) -> dict[str, Any]:
    """Fields of `contract.TrainParams` that reproduce the run of a stored `config`, whatever command started it."""
    anchors = config.get("supervision", {})
    return {
        "preset": config["preset"], "method": config["method"], "host": config.get("host", "hexplane"),
        "host_config": config.get("host_config", "default"), "iterations": config["iterations"],
        "width": config["width"], "max_gaussians": config["densify"]["budget"], "holdout": config["holdout"],
        "seed": config["seed"], "supervision": anchors["preset"], "detector": anchors.get("detector", "grad_norm"),
    }  # fmt: skip


def has_new_cameras(shot: Path, run: Path) -> bool:
    """True if the shot was solved again with another result after the run was trained."""
    cameras, folder = contract.ShotFolder(shot).cameras, RunFolder(run)
    try:
        trained_on = file_cache.of(folder.config, contract.read_json)["solve"]
        return file_cache.of(cameras, _key) != trained_on
    except (OSError, ValueError, KeyError):
        return False


def _key(cameras: Path) -> str:
    """Key of a solve, as stored in a run that was trained on it."""
    return contract.content_key(contract.read_json(cameras))
