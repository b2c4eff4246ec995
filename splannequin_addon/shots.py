"""What a shot folder holds, as the panel tells it. No bpy: files in, plain values out."""

from __future__ import annotations

import json
import os
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..torch_backend import contract
from . import checkpoints, jobs, kept

SHOT_SUFFIX = ".splannequin"
EXR = ".exr"


@dataclass
class ShotState:
    """How far a shot has come."""

    folder: Path
    """Shot folder."""
    info: dict[str, Any] = field(default_factory=dict)
    """shot.json; empty if there is no shot."""
    frames: int = 0
    """Imported frames, 0 before the import."""
    beside: str = ""
    """Where the footage lay seen from the shot folder, when it was imported; empty if that is not known."""
    solve: dict[str, Any] = field(default_factory=dict)
    """solve.json; empty before the solve."""
    runs: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Trained runs: name -> summary.json, with `history`, `preview`, `extension` (see `checkpoints.extension`) and
    `other_cameras` added."""
    unfinished: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Runs that have a checkpoint and no summary, paused or at work: name -> what `checkpoints.paused` tells."""
    takes: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Frozen takes: name -> take.json, with `frame_count` added."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the working frames in pixels, (0, 0) before the import."""
        return int(self.info.get("width", 0)), int(self.info.get("height", 0))

    @property
    def frame_range(self) -> tuple[int, int]:
        """First and last frame number of the clip's range."""
        return int(self.info.get("first", 0)), int(self.info.get("last", 0))


def create(folder: Path, name: str = "") -> None:
    """Makes an empty shot folder, or checks the one that is there. ValueError on one from a newer Splannequin."""
    path = folder / "shot.json"
    if path.is_file():
        contract.check_version(contract.read_json(path), str(path))
        return
    jobs.write_json(path, {"version": 1, "name": name or folder.name.removesuffix(SHOT_SUFFIX), "created": time.time()})


def read(folder: Path) -> ShotState:
    """The state of the shot in a folder; an empty state if there is none. ValueError on a broken or newer file."""
    state = ShotState(folder)
    if not (folder / "shot.json").is_file():
        return state
    state.info = dict(kept.of(folder / "shot.json", contract.read_json))
    contract.check_version(state.info, str(folder / "shot.json"))
    listing = folder / "frames" / "frames.json"
    if listing.is_file():
        state.frames, state.beside = kept.of(listing, _listed)
    if (folder / "solve" / "cameras.json").is_file():
        state.solve = dict(kept.of(folder / "solve" / "solve.json", contract.read_json))
    state.runs = _named(folder / "runs", "summary.json")
    for name, run in state.runs.items():
        run["extension"] = checkpoints.extension(folder / "runs" / name)
    for path in sorted((folder / "runs").glob(f"*/{checkpoints.CHECKPOINT}")):
        told = checkpoints.paused(path.parent) if path.parent.name not in state.runs else None
        if told is not None:
            state.unfinished[path.parent.name] = told
    for name, run in [*state.runs.items(), *state.unfinished.items()]:
        run["other_cameras"] = checkpoints.other_cameras(folder, folder / "runs" / name)
        metrics = folder / "runs" / name / "metrics.jsonl"
        run["history"] = kept.of(metrics, _history) if metrics.is_file() else []
        run["preview"] = max((folder / "runs" / name / "previews").glob("*.png"), default=None)
    state.takes = _named(folder / "takes", "take.json")
    for name, take in state.takes.items():
        take["frame_count"] = kept.of(folder / "takes" / name, _frame_count)
    return state


def stamp(folder: Path) -> tuple[float, ...]:
    """Changes when something in the shot did: cheap to ask for on every tick."""
    parts = ("shot.json", "frames/frames.json", "solve/solve.json", "runs", "takes", "jobs")
    deep = [p for name in ("runs", "takes") if (folder / name).is_dir() for p in (folder / name).iterdir()]
    return tuple(_mtime(p) for p in [*(folder / part for part in parts), *deep])


def plate_range(folder: Path) -> tuple[int, int] | None:
    """First and last number of the undistorted plates, None before the solve."""
    numbers = [int(p.stem) for p in (folder / "frames").glob("*.png") if p.stem.lstrip("-").isdigit()]
    return (min(numbers), max(numbers)) if numbers else None


def _listed(path: Path) -> tuple[int, str]:
    """Of frames.json: how many frames there are, and `ShotState.beside`."""
    told = contract.read_json(path)
    return len(told["frames"]), str(told.get("beside", ""))


def _frame_count(take: Path) -> int:
    with os.scandir(take) as entries:
        return sum(1 for entry in entries if entry.name.endswith(EXR))


def _history(path: Path) -> list[tuple[float, float]]:
    """(seconds, dB on frames kept out) of a run's metrics.jsonl; what cannot be read is passed over."""
    points = []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
    for line in lines:
        try:
            told = json.loads(line)
            points.append((float(told["seconds"]), float(told["heldout_psnr_db"])))
        except (ValueError, KeyError, TypeError):
            continue
    return points


def _named(folder: Path, file: str) -> dict[str, dict[str, Any]]:
    if not folder.is_dir():
        return {}
    return {p.parent.name: dict(kept.of(p, contract.read_json)) for p in sorted(folder.glob(f"*/{file}"))}


def _mtime(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0
