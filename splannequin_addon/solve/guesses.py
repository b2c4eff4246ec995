"""Frames whose camera the solve did not find: their keys have a colour of their own, their ranges a marker each.

Timeline markers hold no properties, so which ones are ours is kept beside the shot, by name and frame: one that the
artist renamed or moved is the artist's from then on.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...torch_backend import contract
from ..access import present, settings_of
from ..shot import scene_objects

if TYPE_CHECKING:
    import bpy

KEY_TYPES = {"localised": "JITTER", "interpolated": "EXTREME"}
"""Source of a camera's frame -> type of its keys, which has a colour in the dope sheet and on the timeline: green for
localised (not in the solve, but placed against it), pink for a guess between neighbours. All others are plain keys."""


def key_types(path: contract.CameraPath) -> list[str]:
    """Type of the keys of every frame of a path."""
    return [KEY_TYPES.get(frame.source, "KEYFRAME") for frame in path.frames]


def ranges(path: contract.CameraPath, solved: set[int]) -> list[tuple[int, int]]:
    """Ranges (first, last), inclusive, of frames that should have been solved and have a guessed camera.

    Args:
        path: the solved cameras.
        solved: frames that the solve was to find. One that a frame step left out has not failed; it is told together
            with those beside it that have.
    """
    found: list[list[int]] = []
    after = False
    for frame in path.frames:
        guessed = frame.source == "interpolated"
        if guessed and after:
            found[-1].append(frame.frame)
        elif guessed:
            found.append([frame.frame])
        after = guessed
    return [(numbers[0], numbers[-1]) for numbers in found if solved & set(numbers)]


def mark(scene: bpy.types.Scene, shot: Path, unsolved: list[tuple[int, int]]) -> None:
    """Puts a marker where each such range begins, which are `ranges`. After `made.new`."""
    entry = present(scene_objects.of(scene, shot))
    others = [e for e in settings_of(scene).made if e != entry]
    put: list[list[str | int]] = []
    for first, last in unsolved:
        name = f"no solve {first}-{last}" if last > first else f"no solve {first}"
        name += f" ({entry.name})" if others else ""
        put.append([scene.timeline_markers.new(name, frame=first).name, first])
    entry.marks = json.dumps(put) if put else ""


def unmark(scene: bpy.types.Scene, shot: Path) -> bool:
    """Takes those markers away, but what the artist renamed or moved. True if there was one."""
    entry, is_changed = scene_objects.of(scene, shot), False
    marks: list[tuple[str, int]] = json.loads(entry.marks or "[]") if entry is not None else []
    for name, frame in marks:
        marker = next((m for m in scene.timeline_markers if m.name == name and m.frame == frame), None)
        if marker is not None:
            scene.timeline_markers.remove(marker)
            is_changed = True
    if entry is not None:
        entry.marks = ""
    return is_changed


def told(result: dict[str, Any]) -> str:
    """How many cameras of a solve are guesses, in words; empty if none. `result` is that of solve.json."""
    guessed, total = result.get("interpolated", 0), result.get("frames", 0)
    if not guessed:
        return ""
    return f"{guessed} of {total} frames have a guessed camera: pink keys on the timeline."


def solved(shot: Path, path: contract.CameraPath) -> set[int]:
    """Frames that the solve was to find; all of them if nothing says otherwise."""
    listing = contract.ShotFolder(shot).listing
    left_out: set[int] = set()
    if listing.is_file():
        left_out = {int(f["frame"]) for f in contract.read_json(listing)["frames"] if not f.get("solve", True)}
    return {frame.frame for frame in path.frames} - left_out
