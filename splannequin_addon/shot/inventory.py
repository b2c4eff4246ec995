"""The content of a shot folder, for the panel. No bpy: files in, plain values out."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import json
import math
import os
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

from ...torch_backend import contract
from ...torch_backend.contract import ShotFolder
from ..scene import numbered
from . import checkpoints, file_cache
from .shot_state import ShotState


def create(folder: Path, name: str = "") -> None:
    """Creates an empty shot folder, or checks an existing one.

    Raises ValueError for a shot from a newer Splannequin, and JobError if the folder holds other files.
    """
    path = ShotFolder(folder).info_path
    if os.path.lexists(path):
        _typed(_Info, path)
        return
    contract.refuse_foreign(folder)
    folder.mkdir(parents=True, exist_ok=True)
    called = name or folder.name.removesuffix(contract.SHOT_SUFFIX)
    contract.write_json(path, {"version": 1, "name": called, "created": time.time()}, parents=False)


def read(folder: Path) -> ShotState:
    """The state of the shot in a folder; empty if there is none. Raises ValueError for a damaged or newer file."""
    state, paths = ShotState(folder), ShotFolder(folder)
    if not paths.info_path.is_file():
        return state
    state.info = _typed(_Info, paths.info_path)
    if paths.listing.is_file():
        listing = file_cache.of(paths.listing, _listed)
        state.frames, state.relative_source, state.read_as, state.timecode, state.shift = listing
    if paths.cameras.is_file():
        state.solve = _typed(_Solve, paths.solve_record)
        state.lacks_motion = _is_unfinished(paths.motion)
    state.runs = _named(_Run, paths.runs, contract.SUMMARY_FILE, state.damaged["run"])
    for name, run in state.runs.items():
        run["extension"] = checkpoints.extension(paths.runs / name)
        run["depth_source"] = checkpoints.depth_source(paths.runs / name)
    for name in _names(paths.runs, contract.CHECKPOINT_FILE):
        known = name in state.runs or name in state.damaged["run"]
        paused = None if known else checkpoints.paused(paths.runs / name)
        if paused is not None:
            state.unfinished[name] = paused
    for name, run in [*state.runs.items(), *state.unfinished.items()]:
        place = contract.RunFolder(paths.runs / name)
        run["anew"] = checkpoints.anew(place.root)
        if run["anew"] is not None:
            run["anew"]["has_new_cameras"] = checkpoints.has_new_cameras(folder, run["anew"]["folder"])
            instead = contract.RunFolder(run["anew"]["folder"])
            run["anew"]["history"] = _history(instead.metrics)
            run["anew"]["preview"] = max(instead.previews.glob("*.png"), default=None)
        run["has_new_cameras"] = checkpoints.has_new_cameras(folder, place.root)
        run["history"] = file_cache.of(place.metrics, _history) if place.metrics.is_file() else []
        run["preview"] = max(place.previews.glob("*.png"), default=None)
    state.takes = _named(_Take, paths.takes, contract.TAKE_FILE, state.damaged["take"])
    for name, take in state.takes.items():
        folder_of = contract.TakeFolder(paths.takes / name)
        # With the time of take.json as a key: the folder's own time may not change.
        take["frame_count"] = file_cache.of(folder_of.root, _frame_count, _mtime(folder_of.facts))
        take["mattes"] = mattes(folder_of)
    return state


def stamp(folder: Path) -> tuple[float, ...]:
    """A value that changes whenever the shot changes. Cheap enough for every tick."""
    paths = ShotFolder(folder)
    parts = (paths.info_path, paths.listing, paths.solve_record, paths.motion, paths.runs, paths.takes, paths.jobs)
    deep = [p for place in (paths.runs, paths.takes) if place.is_dir() for p in place.iterdir()]
    places = (contract.RunFolder(run).next for run in deep)
    anew = [p for place in places if place.is_dir() for p in place.iterdir()]
    # On FAT and exFAT disks (memory cards, portable disks), Windows does not update a folder's time when its files
    # change.
    files = [place / name for place in [*deep, *anew] for name in _REPORTED_FILES]
    files += [contract.TakeFolder(place).mattes_record for place in deep]
    return tuple(_mtime(p) for p in [*parts, *deep, *anew, *files])


def mattes(take: contract.TakeFolder) -> dict[str, list[int]]:
    """Name -> frames with a lasso, for each matte of a take; empty if the record cannot be read."""
    found: dict[str, list[int]] = {}
    for row in lassos(take):
        found.setdefault(row["name"], []).append(row["frame"])
    return found


def lassos(take: contract.TakeFolder) -> list[dict[str, Any]]:
    """Lassos of a take from its mattes.json (name, frame, polygon); empty if it cannot be read."""
    if not take.mattes_record.is_file():
        return []
    try:
        return file_cache.of(take.mattes_record, _lassos)
    except (OSError, ValueError):
        return []


def _lassos(path: Path) -> list[dict[str, Any]]:
    data = contract.read_json(path)
    contract.check_version(data, str(path))
    rows = cast("list[Any]", data["mattes"]) if isinstance(data.get("mattes"), list) else []
    return [row for row in rows if _is_lasso(row)]


def _is_lasso(row: object) -> bool:
    """True for a dict with a valid matte name, a frame and a polygon."""
    if not isinstance(row, dict):
        return False
    name, frame, polygon = (cast("dict[str, Any]", row).get(key) for key in ("name", "frame", "polygon"))
    if not isinstance(name, str) or type(frame) is not int or not isinstance(polygon, list):
        return False
    try:
        contract.checked_name(name, "matte")
    except ValueError:
        return False
    return name.isprintable() and abs(frame) < _LARGEST


def _is_unfinished(motion: Path) -> bool:
    """True if the search for motion has started but not ended."""
    return (motion / contract.MOTION_UNFINISHED_FILE).is_file() and not (motion / contract.MOTION_FILE).is_file()


def plate_range(folder: Path) -> tuple[int, int] | None:
    """First and last frame number of the undistorted plates; None before the solve."""
    found = (contract.frame_number(p.stem) for p in ShotFolder(folder).frames.glob(f"*{contract.PICTURE}"))
    numbers = [number for number in found if number is not None]
    return (min(numbers), max(numbers)) if numbers else None


def picture_of(shot: Path, frame: int) -> str:
    """Digest of the image at a frame of a shot; empty if the import stored none."""
    try:
        return file_cache.of(ShotFolder(shot).listing, _digests).get(frame, "")
    except (OSError, ValueError):
        return ""


def floor(shot: Path) -> tuple[list[float], float] | None:
    """(normal, height) of the floor that the solve found (torch_backend/cameras/floor.py); None without a floor.

    Raises OSError without a solve, and ValueError if its file is damaged.
    """
    file = ShotFolder(shot).solve_record
    found = contract.read_json(file).get("floor")
    if not found:
        return None
    try:
        normal, height = [float(value) for value in found["normal"]], float(found["height"])
    except (KeyError, TypeError, ValueError, OverflowError):
        normal, height = [], 0.0
    if len(normal) != 3 or not all(map(math.isfinite, (*normal, height))):
        raise ValueError(f"{file} is damaged. Solve again.")
    return normal, height


def solve_world(shot: Path) -> str:
    """The world of the solve's coordinates: `contract.SCENE_WORLD`, or empty for the solve's arbitrary world.

    Raises OSError without a solve, and ValueError if its file is damaged.
    """
    return contract.SCENE_WORLD if contract.read_json(ShotFolder(shot).solve_record).get("world") else ""


def burnt_in(shot: Path) -> Path | None:
    """Mask of the burnt-in graphics that the import found in the clip; None if it found none."""
    mask = ShotFolder(shot).burnt_in
    return mask if mask.is_file() else None


def missing_frames(shot: Path, take: str, frames: Iterable[int]) -> list[int]:
    """The frames among `frames` that a take lacks."""
    existing = set(numbered.frame_numbers(ShotFolder(shot).takes / take))
    return [n for n in frames if n not in existing]


def _listed(path: Path) -> tuple[int, str, list[str], str, int]:
    """Values of frames.json: the number of frames, and `relative_source`, `read_as`, `timecode` and `shift` of
    `ShotState`."""
    listing = _read_typed(path, _Listing, contract.LONGEST_JSON)
    read_as = [contract.printable(line, 300) for line in listing["read_as"][:_MOST_SENTENCES] if isinstance(line, str)]
    return (
        len(listing["frames"]),
        listing["beside"],
        read_as,
        contract.parse_timecode(listing["timecode"]),
        listing["shift"],
    )


def _digests(path: Path) -> dict[int, str]:
    """Frame number -> digest of its image, from frames.json."""
    rows = _read_typed(path, _Listing, contract.LONGEST_JSON)["frames"]
    found = [cast("dict[str, Any]", row) for row in rows if isinstance(row, dict)]
    return {row["frame"]: str(row.get("digest", "")) for row in found if isinstance(row.get("frame"), int)}


def _frame_count(take: Path, modified: float) -> int:
    """Number of frames in a take's folder. `modified`, the time of take.json, is only a part of the cache key."""
    with os.scandir(take) as entries:
        return sum(1 for entry in entries if entry.name.endswith(contract.LAYERS))


def _history(path: Path) -> list[tuple[float, float]]:
    """(seconds, dB on held-out frames) from a run's metrics.jsonl. Unreadable lines are skipped."""
    points: list[tuple[float, float]] = []
    try:
        with contextlib.closing(contract.read_lines(path)) as lines:
            for line, end in lines:
                point = _measured(line)
                if point is not None:
                    points.append(point)
                if end > _LONGEST_HISTORY:
                    break
    except (OSError, ValueError):
        return []
    return points


def _measured(line: bytes) -> tuple[float, float] | None:
    try:
        event = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return contract.measured(cast("dict[str, Any]", event)) if isinstance(event, dict) else None


@dataclass
class _Info:
    """Fields of shot.json."""

    name: str = ""
    source: str = ""
    first: int = 0
    last: int = 0
    fps: float = 0.0
    width: int = 0
    height: int = 0
    t_star: int | None = None


@dataclass
class _Listing:
    """Fields of frames.json."""

    frames: list[Any]
    beside: str = ""
    timecode: str = ""
    read_as: list[Any] = field(default_factory=list[Any])
    shift: int = 0


@dataclass
class _Solve:
    """Fields of solve.json and of its `result`."""

    quality: str = ""
    interpolated: int = 0
    frames: int = 0
    result: dict[str, Any] | None = None


@dataclass
class _Run:
    """Fields of summary.json."""

    run: str = ""
    preset: str = "preview"
    gaussians: int = 0
    moving_share: float | None = None
    heldout_psnr_db: float | None = None
    train_seconds: float | None = None


@dataclass
class _Take:
    """Fields of take.json."""

    take: str
    run: str
    t_star_frame: int
    query: str
    width: int
    height: int
    first: int
    last: int
    t_star_per_frame: dict[str, Any] = field(default_factory=dict[str, Any])
    margin: list[Any] = field(default_factory=lambda: [0, 0])
    camera_path: str = ""
    overscan: float = 0.0
    shutter: float = 0.0
    frames_in_all: int = 0
    """Number of frames that the take can have; 0 for a take of an earlier version."""
    t_star_asked: int | None = None
    """Requested t*, from which `t_star_frame` may differ; None if t* was suggested or not stored."""
    combined: dict[str, Any] = field(default_factory=dict[str, Any])
    """For a combined take: `base`, and `things` (matte -> take)."""

    def __post_init__(self) -> None:
        numbers = [*self.margin, *self.t_star_per_frame.values()]
        if len(self.margin) != 2 or any(type(v) not in (int, float) or not abs(v) < _LARGEST for v in numbers):
            raise contract.UserError("margin should be two numbers, and t_star_per_frame a number per frame")


def _typed(kind: type, path: Path) -> dict[str, Any]:
    """A file of the shot, with the fields of the dataclass `kind` checked and completed.

    Raises ValueError, which names the fault, and OSError if the file is missing.
    """
    return dict(file_cache.of(path, _read_typed, kind))


def _read_typed(path: Path, kind: type, longest: int = contract.SHORT_JSON) -> dict[str, Any]:
    data = contract.read_json(path, longest)
    contract.check_version(data, str(path))
    try:
        return _validated(kind, data)
    except ValueError as error:
        raise contract.UserError(f"{path} is damaged: {str(error).lstrip('_')}.") from error


def _validated(kind: type, data: dict[str, Any]) -> dict[str, Any]:
    names = [one.name for one in dataclasses.fields(kind) if one.name in data]
    parsed: object = contract.from_dict(kind, {name: data[name] for name in names})
    values = vars(parsed)
    for name, value in values.items():
        if isinstance(value, (int, float)) and not abs(value) < _LARGEST:
            raise contract.UserError(f"{kind.__name__}.{name} cannot be that large")
        if isinstance(value, str) and name not in ("source", "camera_path"):
            values[name] = contract.printable(value)
    if isinstance(values.get("result"), dict):
        values["result"] = _validated(_Solve, values["result"])
    elif "result" in values:
        del values["result"]
    return {**data, **values}


_MOST_SENTENCES = 4
# Limit of Blender's integers.
_LARGEST = 1 << 31
# Files in the folders of runs and takes that the panel reports on.
_REPORTED_FILES = (contract.SUMMARY_FILE, contract.CHECKPOINT_FILE, contract.EXTENSION_FILE, contract.TAKE_FILE)
# Maximum bytes read of a run's metrics, enough for 100,000 measurements.
_LONGEST_HISTORY = 1 << 24


def _named(kind: type, folder: Path, file: str, damaged: dict[str, str]) -> dict[str, dict[str, Any]]:
    """Name -> content of `file`, for every folder with a valid one.

    Adds name -> reason to `damaged` for every invalid file.
    """
    found: dict[str, dict[str, Any]] = {}
    for name in _names(folder, file):
        try:
            found[name] = _typed(kind, folder / name / file)
        except (OSError, ValueError) as error:
            damaged[name] = contract.printable(str(error))
    return found


def _names(folder: Path, file: str) -> list[str]:
    """Names of the folders with the file. Skips temporary folders and names that cannot be displayed."""
    found = {p.parent.name for p in folder.glob(f"*/{file}")}
    return sorted(name for name in found if name.isprintable() and not name.startswith("."))


def _mtime(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


def unwritable(folder: Path, error: OSError, hint: str) -> contract.JobError:
    """The error for a folder that cannot be written, with the exit code of the backend's command line."""
    code = contract.ExitCode.DISK if error.errno in (errno.ENOSPC, errno.EDQUOT) else contract.ExitCode.USAGE
    return contract.JobError(f"Cannot write to {folder}: {error.strerror or error}.", hint, code)
