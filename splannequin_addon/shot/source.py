"""Which footage a shot was imported from. No bpy."""

from __future__ import annotations

from pathlib import Path

from ...torch_backend import contract
from ...torch_backend.contract import ShotFolder
from . import file_cache


def named(folder: Path) -> str:
    """The footage that the shot in a folder was imported from, as it was named; empty without one, or if nothing tells
    (yet)."""
    return _told(ShotFolder(folder).info_path, "source", contract.SHORT_JSON)


def is_of(folder: Path, clip: str | Path) -> bool | None:
    """`contract.is_imported_from`, by what is remembered of the shot's files."""
    return contract.is_imported_from(folder, clip, _told)


def _told(file: Path, name: str, longest: int) -> str:
    """Value that a file of the shot has under a name; empty if it cannot be read. The step that needs the file says
    why."""
    try:
        return file_cache.of(file, _read, name, longest)
    except (OSError, ValueError):
        return ""


def _read(file: Path, name: str, longest: int) -> str:
    return str(contract.read_json(file, longest).get(name, ""))
