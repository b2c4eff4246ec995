"""What a take says of the footage that it was frozen from, so that a compositor can show the original itself."""

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
    """For take.json: where the footage lies and how its files are shown; {} where it is not there any more.

    file: the video, or the first picture of the sequence. beside: the same, seen from the shot folder. size: of its
    pictures. first, last: its frames' own numbers; those of a video count from 1. shift: what is added to them to get
    the shot's numbers; absent if they are the same. probe: linear Rec.709 light that
    `contract.PROBE` means in it. space: the name of its colour space. map: the ST map in the take's folder that takes
    the lens away, which this writes; empty if there is no lens. unlike: why a program that shows the files would not
    show what the freeze was made from, a clause; empty if it would. orientation: how its header says that a video is
    turned, as EXIF counts it; 1: not at all.

    JobError (DISK), OSError if the map cannot be written.
    """
    plates = Plates(shot)
    info, lens = plates.original(), plates.lens()
    if info is None:
        return {}
    reason = info.unlike or _unsteady(shot, info.fps) or ("its lens changes between frames" if lens is None else "")
    shift = recorded_shift(load_frames(shot))
    facts = {
        "file": os.path.abspath(info.file),
        "beside": _beside(shot.root, info.file),
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
    """Which of `LIGHTS` the footage holds, and frozen frames leave in; Rec.709's for all that is none of them."""
    reading: dict[str, Any] = load_frames(shot).get("reading") or {}
    light = str(reading.get("light", ""))
    return light if light in LIGHTS else LIGHTS[0]


def _unsteady(shot: Shot, fps: float) -> str:
    """Why programs that count time instead of pictures would show other frames; empty if they would not."""
    rows = load_frames(shot)["frames"]
    off = [float(row["seconds"]) - (int(row["frame"]) - int(rows[0]["frame"])) / fps for row in rows]
    return "its rate varies" if max(off) - min(off) > 0.5 / fps else ""


def _beside(root: Path, file: str) -> str:
    try:
        return Path(os.path.relpath(file, root)).as_posix()
    except ValueError:  # another drive on Windows
        return ""
