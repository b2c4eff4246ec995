"""Which footage a shot was imported from. No bpy."""

from __future__ import annotations

import os
import re
from pathlib import Path

from ...torch_backend import contract
from ...torch_backend.contract import ShotFolder
from . import file_cache


def named(folder: Path) -> str:
    """The footage that the shot in a folder was imported from, as it was named; empty without one, or if nothing tells
    (yet)."""
    return _told(ShotFolder(folder).info_path, "source", contract.SHORT_JSON)


def is_of(folder: Path, clip: str | Path) -> bool | None:
    """True if the shot in a folder was imported from a clip, False if from another one; None if nothing tells.

    What lies where the shot's footage lay, seen from the shot, is its own: both were moved or copied together.

    Args:
        folder: shot folder.
        clip: absolute path.
    """
    source = named(folder)
    if not source:
        return None
    if _place(source) == _place(clip):
        return True
    beside = _told(ShotFolder(folder).listing, "beside", contract.LONGEST_JSON)
    if beside and not os.path.isabs(beside):
        if _place(folder / beside) == _place(clip):
            return True
        if os.path.exists(folder / beside):
            return False
    return _place(folder.parent / re.split(r"[\\/]", source)[-1]) == _place(clip)


def _told(file: Path, name: str, longest: int) -> str:
    """What a file of the shot says under a name; empty if it cannot be read: whoever works on it says why."""
    try:
        return file_cache.of(file, _read, name, longest)
    except (OSError, ValueError):
        return ""


def _read(file: Path, name: str, longest: int) -> str:
    return str(contract.read_json(file, longest).get(name, ""))


def _place(path: str | Path) -> str:
    """What two ways to write the path of one file have in common; nothing is looked up."""
    return os.path.normcase(os.path.normpath(path))
