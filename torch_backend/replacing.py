"""A new solve in the place of the old one: prepared beside it, then moved in file by file.

Until all of the new solve is written, nothing of the old one is touched. Then one rename, of `solve/next.partial` to
`solve/next`, says that the new one holds, and its files are moved to where readers look for them. Between the first of
these renames and the last (a millisecond for a clip of 75 frames) a reader may see new frames with old cameras; a
process that is killed in between leaves `solve/next`, and the next process that opens the shot moves the rest. That is
why this stands below `shot` and not in the solve's own folder.
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
"""What is moved after all others, the last one first here: they tell a reader that there is a solve."""
_WHOLE = (COLMAP_FOLDER, *MASK_KINDS)
"""Folders of the solve that hold nothing else: what the new one has not goes."""
_TARGETS = (Path(FRAMES_FOLDER), Path(SOLVE_FOLDER), *(Path(SOLVE_FOLDER, name) for name in _WHOLE))
"""Folders of the shot that a solve has files in; to no other one anything is moved."""


@dataclass
class Staged:
    """Where the files of a new solve are written: below these as below the shot's own folders."""

    frames: Path
    """Takes NNNNNN.png."""
    solve: Path
    """Takes cameras.json, points.npz, solve.json and colmap/."""


@contextlib.contextmanager
def replacing_solve(shot: ShotFolder) -> Generator[Staged]:
    """Yields folders for the files of a whole new solve, which take the place of the old one's if the block ends well.

    If it fails or is killed, the old solve stays as it was. OSError if a file cannot be moved (on Windows: it is held
    open elsewhere): the new solve is kept, and moved when the shot is opened again.
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
        for name in STMAP_FILES:  # they are of the previous lens
            if (shot.solve / name).is_file():
                (staged.solve / name).touch()
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    replace_file(partial, shot.solve / _NEXT)  # a scanner may be at hundreds of new pictures
    settle_solve(shot)


def settle_solve(shot: ShotFolder) -> None:
    """Moves what `replacing_solve` had finished, but not moved, to its place. Does nothing if there is none.

    Two processes may do so at once: each file is moved by one of them. Nothing is moved through a link: a folder from
    elsewhere could have it replace any file.
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
    """An empty file in `new` for each in `old` that it has not got: that one goes when the others come."""
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
