"""Keeps files in a shot's frames folder that other programs or users put there."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

from ..contract import (
    BURNT_IN_FILE,
    FRAMES_FILE,
    UNPUBLISHED_FILE,
    is_half_written,
    read_json,
)
from ..shot import make_folder


def keep_foreign_files(old: Path, fresh: Path, record: dict[str, Any]) -> None:
    """Links or copies foreign files of the frames folder `old` into `fresh`. Renames a file if its name is in use.

    All files are foreign except frames.json, the frames listed in it, and their undistorted copies beside raw/.
    """
    listed, needed = _listed(old / FRAMES_FILE), _names(record)
    for found in sorted(p for p in old.rglob("*") if p.is_symlink() or not p.is_dir()):
        name = found.relative_to(old)
        if name in listed or is_half_written(name.name):
            continue
        while name in needed or os.path.lexists(fresh / name):
            name = name.with_name(f"{name.stem}.kept{name.suffix}")
        target = fresh / name
        make_folder(target.parent)
        try:
            os.link(found, target, follow_symlinks=False)
        except (OSError, NotImplementedError):  # no hard links, as on a network share or a memory card
            shutil.copy2(found, target, follow_symlinks=False)


def _listed(listing: Path) -> set[Path]:
    """Own files in a folder with this frames.json; only frames.json itself if it cannot be read."""
    try:
        return _names(read_json(listing))
    except (OSError, ValueError, KeyError, TypeError):
        return {Path(FRAMES_FILE)}


def _names(record: dict[str, Any]) -> set[Path]:
    """Files of an import relative to the frames folder, with the undistorted frames that a solve writes beside raw/."""
    files = [Path(str(row["file"])) for row in record["frames"]]
    return {
        Path(FRAMES_FILE),
        Path(BURNT_IN_FILE),
        Path(UNPUBLISHED_FILE),
        *files,
        *(Path(file.name) for file in files),
    }
