"""The footage that a shot was imported from. No bpy."""

from __future__ import annotations

from pathlib import Path

from ...torch_backend import contract
from ...torch_backend.contract import ShotFolder
from . import file_cache


def named(folder: Path) -> str:
    """Stored path of the footage that the shot in a folder was imported from; empty if unknown."""
    return _stored_value(ShotFolder(folder).info_path, "source", contract.SHORT_JSON)


def is_of(folder: Path, clip: str | Path) -> bool | None:
    """Cached `contract.is_imported_from`."""
    return contract.is_imported_from(folder, clip, _stored_value)


def _stored_value(file: Path, name: str, longest: int) -> str:
    """Value under a name in a file of the shot; empty if the file cannot be read. The step that needs it reports
    errors."""
    try:
        return file_cache.of(file, _read, name, longest)
    except (OSError, ValueError):
        return ""


def _read(file: Path, name: str, longest: int) -> str:
    return str(contract.read_json(file, longest).get(name, ""))
