"""Files in a shot's folder of frames that no import made: they stay."""

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


def keep_strangers(old: Path, fresh: Path, record: dict[str, Any]) -> None:
    """Takes over what lies in the frames folder and is not ours, under its own name or, where we need that, another.

    Ours are the listing, the frames that it names, and their undistorted copies beside raw/.
    """
    ours, needed = _listed(old / FRAMES_FILE), _names(record)
    for found in sorted(p for p in old.rglob("*") if p.is_symlink() or not p.is_dir()):
        name = found.relative_to(old)
        if name in ours or is_half_written(name.name):
            continue
        while name in needed or os.path.lexists(fresh / name):
            name = name.with_name(f"{name.stem}.kept{name.suffix}")
        target = fresh / name
        make_folder(target.parent)
        try:
            os.link(found, target, follow_symlinks=False)
        except (OSError, NotImplementedError):  # no hard links there: a network share, a memory card
            shutil.copy2(found, target, follow_symlinks=False)


def _listed(listing: Path) -> set[Path]:
    """Our files in a folder with this frames.json; the listing alone if it cannot be read: no other is known to be."""
    try:
        return _names(read_json(listing))
    except (OSError, ValueError, KeyError, TypeError):
        return {Path(FRAMES_FILE)}


def _names(record: dict[str, Any]) -> set[Path]:
    """Files of an import, relative to the frames folder, and the undistorted ones that a solve writes beside raw/."""
    files = [Path(str(row["file"])) for row in record["frames"]]
    return {
        Path(FRAMES_FILE),
        Path(BURNT_IN_FILE),
        Path(UNPUBLISHED_FILE),
        *files,
        *(Path(file.name) for file in files),
    }
