"""Marks frames whose camera the solve did not find: with coloured keyframes, and with a timeline marker per range.

A marker that the artist renamed or moved no longer counts as ours.
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
"""Source of a frame's camera -> type of its keyframes, which sets their colour in the dope sheet and timeline. Green:
localised against the solve but not part of it. Pink: interpolated between neighbours. All others are plain
keyframes."""


def key_types(path: contract.CameraPath) -> list[str]:
    """Keyframe type of every frame of a path."""
    return [KEY_TYPES.get(frame.source, "KEYFRAME") for frame in path.frames]


def ranges(path: contract.CameraPath, solved: set[int]) -> list[tuple[int, int]]:
    """Ranges (first, last), inclusive, of frames with a guessed camera that should have been solved.

    Args:
        path: the solved cameras.
        solved: frames that the solve should find. Frames skipped by a frame step only appear in a range with a failed
            frame.
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
    """Adds a marker at the start of each range from `ranges`. Call it after `scene_objects.new`."""
    entry = present(scene_objects.of(scene, shot))
    neighbours = [e for e in settings_of(scene).made if e != entry]
    put: list[list[str | int]] = []
    for first, last in unsolved:
        name = f"no solve {first}-{last}" if last > first else f"no solve {first}"
        name += f" ({entry.name})" if neighbours else ""
        put.append([scene.timeline_markers.new(name, frame=first).name, first])
    # Timeline markers have no custom properties that could hold a tag.
    entry.marks = json.dumps(put) if put else ""


def unmark(scene: bpy.types.Scene, shot: Path) -> bool:
    """Removes these markers, except those that the artist renamed or moved. True if there were any."""
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


def sentence(result: dict[str, Any]) -> str:
    """Sentence about the number of guessed cameras of a solve; empty if there are none. `result` is from solve.json."""
    guessed, total = result.get("interpolated", 0), result.get("frames", 0)
    if not guessed:
        return ""
    return f"{guessed} of {total} frames have a guessed camera, shown as pink keys on the timeline."


def solved(shot: Path, path: contract.CameraPath) -> set[int]:
    """Frames that the solve should find; all frames unless the import's record excludes some."""
    listing = contract.ShotFolder(shot).listing
    left_out: set[int] = set()
    if listing.is_file():
        left_out = {int(f["frame"]) for f in contract.read_json(listing)["frames"] if not f.get("solve", True)}
    return {frame.frame for frame in path.frames} - left_out
