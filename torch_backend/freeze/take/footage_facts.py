"""Facts about the footage for take.json, with which a compositor can load the original files."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from ...contract import TAKE_UNDISTORT
from ...footage.color import LIGHTS
from ...footage.importing import load_frames
from ...footage.numbering import recorded_shift
from ...footage.plates import Plates
from ...lens.stmap import write_plate_map
from ...shot import Shot, content_key


def footage_facts(shot: Shot, take: Path) -> dict[str, Any]:
    """Location and interpretation of the footage, for take.json; {} if the footage is missing.

    file: the video, or the first picture of the sequence.
    beside: the same path, relative to the shot folder.
    size: width and height of its pictures.
    first, last: frame numbers in the files; those of a video start at 1.
    shift: offset from these to the shot's frame numbers; absent if 0.
    probe: linear Rec.709 light of `contract.PROBE` in the footage's colour space.
    space: name of that colour space.
    map: ST map in the take's folder that undistorts the lens, written by this function; empty without a lens.
    unlike: clause that states why other programs would show the files differently from the plates; empty otherwise.
    orientation: rotation in the video's header as an EXIF code; 1: none.

    JobError (DISK) or OSError if the map cannot be written.
    """
    plates = Plates(shot)
    info, lens = plates.original(), plates.lens()
    if info is None:
        return {}
    reason = info.mismatch or _unsteady(shot, info.fps) or ("its lens changes between frames" if lens is None else "")
    shift = recorded_shift(load_frames(shot))
    facts = {
        "file": os.path.abspath(info.file),
        "beside": _relative_path(shot.root, info.file),
        "size": [info.width, info.height],
        "first": info.first - shift,
        "last": None if info.last is None else info.last - shift,
        **({"shift": shift} if shift else {}),
        "probe": list(info.probe),
        "space": info.reading.get("colour", ""),
        "map": "",
        "unlike": reason,
        "orientation": info.reading.get("orientation", 1),
    }
    if lens is not None and not lens.is_none and not reason:
        key = content_key(1, plates.key, info.width, info.height)
        write_plate_map(take / TAKE_UNDISTORT, lens, info.width, info.height, key)
        facts["map"] = TAKE_UNDISTORT.as_posix()
    return facts


def footage_light(shot: Shot) -> str:
    """Primaries of the footage and its frozen frames, one of `LIGHTS`; Rec.709 if the footage has others."""
    reading: dict[str, Any] = load_frames(shot).get("reading") or {}
    light = str(reading.get("light", ""))
    return light if light in LIGHTS else LIGHTS[0]


def _unsteady(shot: Shot, fps: float) -> str:
    """Reason why programs that seek by time would show other frames; empty for a constant frame rate."""
    rows = load_frames(shot)["frames"]
    drift = [float(row["seconds"]) - (int(row["frame"]) - int(rows[0]["frame"])) / fps for row in rows]
    return "its rate varies" if max(drift) - min(drift) > 0.5 / fps else ""


def _relative_path(root: Path, file: str) -> str:
    try:
        return Path(os.path.relpath(file, root)).as_posix()
    except ValueError:  # another drive on Windows
        return ""
