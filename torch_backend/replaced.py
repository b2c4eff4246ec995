"""What an import of other frames replaces: kept in SHOT/replaced/NNN, a shot folder that can be opened by itself.

The new frames take their place first, with the order for the rest in `frames/unpublished.json`. A process that is
killed before all is moved leaves that order, and the next job of the shot carries on.
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
    """A name in SHOT/replaced that is not taken."""
    number = 1
    while (shot.replaced / f"{number:03d}").exists():
        number += 1
    return f"{number:03d}"


def keep_replaced(shot: ShotFolder, name: str, same: Sequence[int]) -> None:
    """Moves everything that belongs to the previous frames to SHOT/replaced/NAME; carries on where it was killed.

    For `Shot.publish_frames`, while shot.json still describes those frames.

    Args:
        shot: its new frames are in place, the previous ones are where `replacing_folder` left them.
        name: of `next_name`.
        same: frames that show the same picture as before. Paint and masks drawn over them hold, and are copied back.
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
