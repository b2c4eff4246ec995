"""The shot folder: the one state that Blender and the backend share, and how files are written into it.

Layout (design: docs/architecture.md): shot.json, frames/, solve/, runs/<name>/, takes/<name>/, jobs/<id>/.
Every file is written beside its place, fsynced, and renamed over it, so a reader never sees half a file.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import hashlib
import json
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .contract import ExitCode, JobError, check_version, checked_name, from_dict, is_link, read_json, remove_link

SHOT_VERSION = 1
SHOT_SUFFIX = ".splannequin"


@dataclass
class ShotInfo:
    """shot.json."""

    name: str
    """What the artist calls the shot."""
    source: str = ""
    """Footage it was imported from, as given (absolute)."""
    first: int = 0
    """First frame number of the range, 0 before import."""
    last: int = 0
    """Last frame number of the range, inclusive."""
    step: int = 1
    """Every how many frames are solved and trained on."""
    fps: float = 0.0
    """Frames per second of the source."""
    width: int = 0
    """Width in pixels of the working frames."""
    height: int = 0
    """Height in pixels of the working frames."""
    colour: str = "srgb"
    """Encoding of the working frames: always display-referred sRGB; `linear` if the source was scene-linear."""
    t_star: int | None = None
    """Frame number at which time stands still; None until chosen."""
    created: float = field(default_factory=time.time)
    """Seconds since the epoch."""
    version: int = SHOT_VERSION
    """Version of the shot format."""


class Shot:
    """A shot folder on disk. Holds paths, not state: every read goes to the files."""

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root).absolute()

    @classmethod
    def open(cls, root: str | Path) -> Shot:
        """An existing shot. FileNotFoundError if there is none, ValueError if it is from a newer version."""
        from .replacing import settle_solve  # it stands on this module

        shot = cls(root)
        if not shot.info_path.is_file():
            raise FileNotFoundError(f"{shot.root} is not a shot folder: it has no shot.json")
        shot.info()
        settle_solve(shot)
        return shot

    @classmethod
    def create(cls, root: str | Path, name: str = "") -> Shot:
        """Opens the shot at `root`, or makes an empty one there."""
        shot = cls(root)
        if shot.info_path.is_file():
            return cls.open(root)
        shot.root.mkdir(parents=True, exist_ok=True)
        shot.save(ShotInfo(name=name or shot.root.name.removesuffix(SHOT_SUFFIX)))
        return shot

    @property
    def info_path(self) -> Path:
        return self.root / "shot.json"

    @property
    def frames(self) -> Path:
        return self.root / "frames"

    @property
    def solve(self) -> Path:
        return self.root / "solve"

    @property
    def jobs(self) -> Path:
        return self.root / "jobs"

    def run(self, name: str) -> Path:
        """Folder of a run; ValueError if the name could leave it."""
        return self.root / "runs" / checked_name(name, "run")

    def take(self, name: str) -> Path:
        """Folder of a take; ValueError if the name could leave it."""
        return self.root / "takes" / checked_name(name, "take")

    def own(self, folder: Path) -> Path:
        """`folder` of this shot, for those who remove or overwrite files in it.

        JobError if it is no folder, or if it or a folder on the way to it is a link: what lies behind is not ours.
        """
        there = self.root
        for part in folder.relative_to(self.root).parts:
            there = there / part
            if is_link(there):
                raise JobError(
                    f"{there} is a link to {os.path.realpath(there)}: what lies there is not this shot's to replace.",
                    "Remove the link, or put a folder of that name in its place, then start again.",
                    ExitCode.USAGE,
                )
            if os.path.lexists(there) and not there.is_dir():
                raise JobError(
                    f"{there} is not a folder.", "Move it away: the shot keeps its files there.", ExitCode.USAGE
                )
        return folder

    def info(self) -> ShotInfo:
        """shot.json as it is now."""
        data = read_json(self.info_path)
        check_version(data, str(self.info_path), SHOT_VERSION)
        return from_dict(ShotInfo, data)

    def save(self, info: ShotInfo) -> None:
        """Rewrites shot.json."""
        write_json(self.info_path, dataclasses.asdict(info))

    def update(self, **changes: Any) -> ShotInfo:
        """Rewrites shot.json with some fields changed, and returns it."""
        info = dataclasses.replace(self.info(), **changes)
        self.save(info)
        return info


_worked_on: list[Path] = []
"""Shot folders that jobs of this process work on."""


@contextlib.contextmanager
def working_on(*roots: Path) -> Iterator[None]:
    """While it lasts, `make_folder` makes nothing of a shot whose own folder was moved or deleted."""
    _worked_on.extend(roots)
    try:
        yield
    finally:
        for root in roots:
            _worked_on.remove(root)


def make_folder(path: Path) -> None:
    """Makes a folder and those above it, if they are not there.

    FileNotFoundError if it belongs to a shot that a job works on and whose own folder is gone: what is written under
    its old name would look like a shot, and hold next to nothing of it.
    """
    root = next((root for root in _worked_on if root == path or root in path.parents), None)
    if root is None:
        path.mkdir(parents=True, exist_ok=True)
        return
    if root == path:
        root.stat()
    for part in reversed([path, *path.parents][: len(path.relative_to(root).parts)]):
        part.mkdir(exist_ok=True)  # one by one: the system refuses the first without the shot's folder


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A path beside `path`, with the same suffix, to write to; fsynced and renamed over `path` if all went well."""
    path = Path(path)
    make_folder(path.parent)
    beside = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    beside.unlink(missing_ok=True)  # a link that another hand left there would be followed
    try:
        yield beside
        with open(beside, "rb+") as handle:
            os.fsync(handle.fileno())
        replace_file(beside, path)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def replacing_folder(path: str | Path) -> Iterator[Path]:
    """Yields an empty folder beside `path`, which takes its place if the block ends well, whole or not at all.

    Until then, and if the block fails, `path` stays as it was. What a killed process left is swept by the next one:
    a folder that had been moved aside is put back if nothing took its place.
    """
    path = Path(path)
    fresh, aside = path.with_name(f".{path.name}.new"), path.with_name(f".{path.name}.old")
    restore_folder(path)
    _discard(fresh)
    make_folder(fresh)
    try:
        yield fresh
        if os.path.lexists(path):
            replace_file(path, aside)
        replace_file(fresh, path)
    except BaseException:
        restore_folder(path)
        raise
    finally:
        _discard(fresh)
    _discard(aside)


def restore_folder(path: Path) -> None:
    """Puts back the folder that `replacing_folder` moved aside and was killed; if it was replaced, removes it."""
    aside = path.with_name(f".{path.name}.old")
    if aside.is_dir() and not os.path.lexists(path):
        replace_file(aside, path)
    _discard(aside)


def _discard(folder: Path) -> None:
    """Removes a folder, or a link to one without following it."""
    if is_link(folder):
        remove_link(folder)
    else:
        shutil.rmtree(folder, ignore_errors=True)


def replace_file(source: Path, target: Path) -> None:
    """Renames over `target`; on Windows a reader may hold it open for a moment, so that is tried for two seconds."""
    for attempt in range(40):
        try:
            os.replace(source, target)
            return
        except PermissionError:
            if os.name != "nt" or attempt == 39:
                raise
            time.sleep(0.05)


@contextlib.contextmanager
def locked(path: str | Path, waiting: Callable[[], None] | None = None) -> Iterator[None]:
    """Holds a lock file, after waiting for whoever has it; `waiting` is called once if it has to.

    The system frees it when this process ends, however that comes about.
    """
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with open(path, "a+b") as lock:
        told = False
        while not try_lock(lock.fileno()):
            if not told and waiting is not None:
                waiting()
                told = True
            time.sleep(0.2)
        yield


def try_lock(handle: int) -> bool:
    """Locks an open file for this process, without waiting; False if another one has it. Closing it gives it back."""
    try:
        if sys.platform == "win32":
            import msvcrt

            os.lseek(handle, 0, os.SEEK_SET)
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def write_atomic(path: str | Path, data: bytes) -> None:
    """Writes a whole file, or leaves what was there."""
    with atomic_path(path) as beside:
        beside.write_bytes(data)


def write_json(path: str | Path, data: Mapping[str, Any]) -> None:
    """Writes a JSON object. ValueError on NaN or infinity: other programs read these files."""
    write_atomic(path, (json.dumps(data, indent=1, allow_nan=False) + "\n").encode("utf-8"))


def content_key(*parts: Any) -> str:
    """Short hash of JSON-able values and of files (given as Path: size and modification time), for "already done?"."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, Path):
            found = part.stat()
            part = [part.name, found.st_size, found.st_mtime_ns]
        elif dataclasses.is_dataclass(part) and not isinstance(part, type):
            part = dataclasses.asdict(part)
        digest.update(json.dumps(part, sort_keys=True, default=str).encode("utf-8"))
    return digest.hexdigest()[:16]


def need_disk(folder: str | Path, byte_count: float, what: str) -> None:
    """JobError if the disk of `folder` has no room for `byte_count` bytes more."""
    there = Path(folder).absolute()
    while not there.exists():
        there = there.parent
    free = shutil.disk_usage(there).free
    if free < byte_count:
        raise disk_error(folder, f"{what} needs about {byte_count / 1e6:.0f} MB, {free / 1e6:.0f} MB are free")


def disk_error(folder: str | Path, detail: str = "the disk is full") -> JobError:
    """The one sentence for a full disk."""
    return JobError(
        f"No space left in {folder}: {detail}.",
        "Free some space or choose another output folder, then start again: finished work is kept.",
        ExitCode.DISK,
    )


def is_disk_full(error: OSError) -> bool:
    """True if the system refused to write for want of space or quota."""
    return error.errno in (errno.ENOSPC, errno.EDQUOT)


_REFUSED = {
    errno.ENAMETOOLONG: ("has a name that is too long for this system", "Choose a shorter one."),
    errno.ENOTDIR: ("leads through a file where a folder is needed", "Choose another place."),
    errno.EEXIST: ("is a file where a folder is needed", "Choose another place."),
    errno.EISDIR: ("is a folder where a file is needed", "Choose another place."),
    errno.ENOENT: ("does not exist", "Check the name."),
    errno.ELOOP: ("is a link that leads to itself", "Choose another place."),
    **dict.fromkeys(
        (errno.EACCES, errno.EPERM, errno.EROFS),
        ("cannot be used: it is protected, or open elsewhere", "Close it, or choose another place."),
    ),
}


def path_error(error: OSError) -> JobError | None:
    """The sentence for a file or folder that the system refuses, or for a full disk; None if it is about no path."""
    where = error.filename2 or error.filename
    if is_disk_full(error):
        return disk_error(where or "the output folder")
    if not where or error.errno not in _REFUSED:
        return None
    what, hint = _REFUSED[error.errno]
    return JobError(f"{where} {what}.", hint, ExitCode.USAGE)
