"""Replaces a solve by a new one, which is written to a separate folder and then moved in file by file.

The old solve stays untouched until the new one is complete. Renaming `solve/next.partial` to `solve/next` then commits
the new solve, and its files are moved to where readers look for them. During the moves (a millisecond for a clip of 75
frames) a reader may see new frames with old cameras. If a process is killed during the moves, the next process that
opens the shot moves the rest. `Shot.open` therefore needs this module, which is why it is not part of `sfm`.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path

from .contract import (
    CAMERAS_FILE,
    COLMAP_FOLDER,
    FRAMES_FOLDER,
    MASK_KINDS,
    POINTS_FILE,
    SOLVE_FILE,
    SOLVE_FOLDER,
    STMAP_FILES,
    ShotFolder,
    make_folder,
    remove_file,
    replace_file,
)

_NEXT, _PARTIAL = "next", "next.partial"
_LAST = (SOLVE_FILE, CAMERAS_FILE, POINTS_FILE)
"""Files that are moved after all others, in reverse order: they tell a reader that there is a solve."""
_WHOLE = (COLMAP_FOLDER, *MASK_KINDS)
"""Folders that only a solve writes to. Files in them that the new solve lacks are removed."""
_TARGETS = (Path(FRAMES_FOLDER), Path(SOLVE_FOLDER), *(Path(SOLVE_FOLDER, name) for name in _WHOLE))
"""Folders of the shot that hold files of a solve. Nothing is moved to any other folder."""


@dataclass
class Staged:
    """Folders for the files of a new solve, laid out as the shot's `frames` and `solve`."""

    frames: Path
    """Folder for NNNNNN.png."""
    solve: Path
    """Folder for cameras.json, points.npz, solve.json and colmap/."""


@contextlib.contextmanager
def replacing_solve(shot: ShotFolder) -> Generator[Staged]:
    """Yields folders for the files of a complete new solve, which replace the old files if the block succeeds.

    If the block fails or is killed, the old solve stays unchanged. OSError if a file cannot be moved (on Windows:
    because another program has it open). The new solve is kept then, and moved when the shot is opened again.
    """
    partial = shot.solve / _PARTIAL
    staged = Staged(partial / FRAMES_FOLDER, partial / SOLVE_FOLDER)
    shutil.rmtree(partial, ignore_errors=True)
    for folder in (staged.frames, staged.solve):
        make_folder(folder)
    try:
        yield staged
        for name in _WHOLE:
            _drop_stale(shot.solve / name, staged.solve / name)
        for name in STMAP_FILES:  # maps of the previous lens: an empty file marks them for removal
            if (shot.solve / name).is_file():
                (staged.solve / name).touch()
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    replace_file(partial, shot.solve / _NEXT)  # waits while a virus scanner reads the new pictures
    settle_solve(shot)


def settle_solve(shot: ShotFolder) -> None:
    """Moves the files of a complete new solve into place. Does nothing if no new solve waits.

    Two processes may call this at once; each file is moved by one of them. Nothing is moved through a link, because
    links in a shot from elsewhere could point to any file.
    """
    ready, root = shot.solve / _NEXT, shot.root.resolve()
    within = ready.relative_to(shot.root)
    if not ready.is_dir():
        return
    if any((root / part).resolve() != root / part for part in (*_TARGETS, *(within / target for target in _TARGETS))):
        return
    for source in sorted(_files(ready), key=_turn):
        target = shot.root / source.relative_to(ready)
        with contextlib.suppress(FileNotFoundError):  # moved by another process meanwhile
            if source.stat().st_size:
                make_folder(target.parent)
                replace_file(source, target)
            else:
                remove_file(target)
                remove_file(source)
    shutil.rmtree(ready, ignore_errors=True)


def _drop_stale(old: Path, new: Path) -> None:
    """Makes an empty file in `new` for each file that only `old` has. It marks the old file for removal."""
    if old.is_dir():
        for name in {p.name for p in old.iterdir() if p.is_file()}:
            if not (new / name).exists():
                new.mkdir(exist_ok=True)
                (new / name).touch()


def _files(ready: Path) -> list[Path]:
    """The files that wait to be moved; links are not followed."""
    found = [path for target in _TARGETS if (ready / target).is_dir() for path in (ready / target).iterdir()]
    return [path for path in found if path.is_file() and not path.is_symlink()]


def _turn(path: Path) -> tuple[int, str]:
    return (-_LAST.index(path.name) if path.name in _LAST else -len(_LAST), str(path))
