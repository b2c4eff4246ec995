"""Keeps what an import of other frames replaces, in SHOT/replaced/NNN, a shot folder that can be opened by itself.

The new frames are put in place first, with a record of the remaining moves in `frames/unpublished.json`. If the process
is killed before all moves are done, the next job of the shot completes them.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from .contract import (
    DRAWN_FOLDER,
    FOLDERS_OF_FRAMES,
    FRAMES_FOLDER,
    INFO_FILE,
    PAINTED_FOLDER,
    PICTURE,
    ShotFolder,
    checked_name,
    frame_file,
    make_folder,
    read_json,
    replace_file,
    replaced_folder,
    write_json,
)


def next_name(shot: ShotFolder) -> str:
    """Unused folder name in SHOT/replaced."""
    number = 1
    while (shot.replaced / f"{number:03d}").exists():
        number += 1
    return f"{number:03d}"


def keep_replaced(shot: ShotFolder, name: str, same: Sequence[int]) -> None:
    """Moves everything that belongs to the previous frames to SHOT/replaced/NAME.

    `Shot.publish_frames` calls this while shot.json still describes those frames. If the process is killed in between,
    another call completes the moves.

    Args:
        shot: a shot with its new frames in place, and the previous ones where `replacing_folder` left them.
        name: result of `next_name`.
        same: frames that show the same picture as before. Paint and masks drawn over them are copied back.
    """
    kept = ShotFolder(shot.replaced / checked_name(name, "folder"))
    make_folder(kept.root)
    if not kept.info_path.is_file():
        write_json(kept.root / INFO_FILE, read_json(shot.info_path))
    moves = [(replaced_folder(shot.frames), kept.root / FRAMES_FOLDER)]
    moves += [(shot.root / folder, kept.root / folder) for folder in FOLDERS_OF_FRAMES]
    for source, target in moves:
        if source.is_dir() and not target.exists():
            replace_file(source, target)
    drawn = [kind.relative_to(kept.root) for kind in (kept.root / DRAWN_FOLDER).glob("*") if kind.is_dir()]
    for folder in (Path(PAINTED_FOLDER), *drawn):
        for frame in same:
            source, target = (root / folder / frame_file(frame, PICTURE) for root in (kept.root, shot.root))
            if source.is_file() and not target.exists():
                make_folder(target.parent)
                shutil.copy2(source, target)
