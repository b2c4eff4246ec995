"""What a checkpoint of the backend says about itself, read without the backend. No bpy: a file in, plain values out."""

from __future__ import annotations

import hashlib
import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..torch_backend import contract
from . import kept

CHECKPOINT = "checkpoint.safetensors"
EXTENSION = "extension.safetensors"
"""Of steps that are added to a finished run and are not done."""
NEXT = "next"
"""Folder in a run's: of trainings that will take the run's place when they are done."""
_LONGEST = 1 << 22


def facts(path: Path) -> dict[str, Any]:
    """The facts that the backend stored in a checkpoint, read from the file's header; empty if there is none. Not to be
    changed: they are remembered."""
    try:
        return kept.of(path, _facts)
    except OSError:
        return {}


def _facts(path: Path) -> dict[str, Any]:
    try:
        with contract.open_regular(path) as source:
            (length,) = struct.unpack("<Q", source.read(8))
            header = json.loads(source.read(length)) if length < _LONGEST else {}
        told = json.loads(header["__metadata__"]["splannequin"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError, struct.error):
        return {}
    return told if isinstance(told, dict) else {}


def paused(run: Path) -> dict[str, Any] | None:
    """Of a run that has a checkpoint and is not finished: at which `iteration` of `end`, `preset` and `config`."""
    told = facts(run / CHECKPOINT)
    try:
        config = told["config"]
        asked: contract.TrainParams = contract.from_dict(contract.TrainParams, params_of(config))
        done: _Count = contract.from_dict(_Count, {"steps": told["iteration"]})
    except (KeyError, TypeError, AttributeError, ValueError):
        return None
    return {"iteration": done.steps, "end": asked.iterations, "preset": asked.preset, "config": config}


@dataclass
class _Count:
    steps: int


def anew(run: Path) -> dict[str, Any] | None:
    """Of a run that is trained anew, paused or at work: as `paused`, of the training that was saved last."""
    saved = sorted((run / NEXT).glob(f"*/{CHECKPOINT}"), key=_saved)
    told = paused(saved[-1].parent) if saved else None
    return None if told is None else {**told, "folder": saved[-1].parent}


def _saved(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


def extension(run: Path) -> dict[str, int] | None:
    """Of steps that were begun to be added to a finished run: how many of `steps` are `done`."""
    if not (run / EXTENSION).is_file():
        return None
    told, base = facts(run / EXTENSION), facts(run / CHECKPOINT)
    try:
        last = told["extensions"][-1]
        if (told["key"], last["from_iteration"]) != (base["key"], base["iteration"]):
            return None
        done: _Count = contract.from_dict(_Count, {"steps": told["iteration"] - last["from_iteration"]})
        added: _Count = contract.from_dict(_Count, {"steps": last["steps"]})
    except (KeyError, TypeError, ValueError, IndexError):
        return None
    return {"done": done.steps, "steps": added.steps}


def params_of(config: dict[str, Any]) -> dict[str, Any]:
    """Fields of `contract.TrainParams` that ask for the run of a stored `config` again, whatever it was begun with."""
    anchors = config.get("supervision", {})
    return {
        "preset": config["preset"], "method": config["method"], "host": config.get("host", "hexplane"),
        "host_config": config.get("host_config", "default"), "iterations": config["iterations"],
        "width": config["width"], "max_gaussians": config["densify"]["budget"], "holdout": config["holdout"],
        "seed": config["seed"], "supervision": anchors["preset"], "detector": anchors.get("detector", "grad_norm"),
    }  # fmt: skip


def other_cameras(shot: Path, run: Path) -> bool:
    """True if the shot was solved again, with another result, after the run was trained."""
    cameras, trained = shot / "solve" / "cameras.json", run / CHECKPOINT
    try:
        if cameras.stat().st_mtime <= trained.stat().st_mtime:
            return False
        told = kept.of(run / "config.json", contract.read_json)["solve"]
        return kept.of(cameras, _key) != told
    except (OSError, ValueError, KeyError):
        return False


def _key(cameras: Path) -> str:
    """What a run notes of the solve it was trained on: as torch_backend.shot.content_key."""
    text = json.dumps(contract.read_json(cameras), sort_keys=True)
    return hashlib.sha256(text.encode("utf-8")).hexdigest()[:16]
