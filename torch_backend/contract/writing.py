"""Writes files of a shot: under a temporary name, fsynced, then renamed, so that no reader sees half a file."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import json
import os
import re
import shutil
import sys
import time
import uuid
from collections.abc import Callable, Generator, Mapping
from pathlib import Path
from typing import Any

from .errors import disk_error
from .files import is_link, patiently, remove_link
from .identity import file_digest

# Shot folders that jobs of this process work on.
_worked_on: list[Path] = []


@contextlib.contextmanager
def working_on(*roots: Path) -> Generator[None]:
    """During the block, `make_folder` makes no folder in a shot of `roots` that was moved or deleted."""
    _worked_on.extend(roots)
    try:
        yield
    finally:
        for root in roots:
            _worked_on.remove(root)


def make_folder(path: Path) -> None:
    """Makes a folder and its missing parents.

    FileNotFoundError if the folder belongs to a shot that a job works on, and the shot was moved or deleted.
    """
    root = next((root for root in _worked_on if root == path or root in path.parents), None)
    if root is None:
        path.mkdir(parents=True, exist_ok=True)
        return
    # A nearly empty folder under the old name of a moved shot would look like a shot.
    if root == path:
        root.stat()
    for part in reversed([path, *path.parents][: len(path.relative_to(root).parts)]):
        part.mkdir(exist_ok=True)  # one by one: the first one fails if the shot's folder is gone


@contextlib.contextmanager
def atomic_path(path: str | Path, parents: bool = True) -> Generator[Path]:
    """Yields a temporary path next to `path`, with its suffix, which is fsynced and renamed to `path` after the block.

    Makes the folder of `path`, and with `parents` also the parents of this folder. Without `parents`, FileNotFoundError
    if they are missing, as in a shot that was moved. If the block fails, `path` stays unchanged.
    """
    path = Path(path)
    if parents:
        make_folder(path.parent)
    else:
        path.parent.mkdir(exist_ok=True)
    # A random name: two hosts of a farm may have the same process id, and nobody can place a link at an unknown name.
    # A short name: Windows limits a whole path to 260 characters.
    partial = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:12]}.tmp{path.suffix}")
    try:
        yield partial
        # Flushed before the rename, or a power cut could leave an empty file under the final name. Windows only flushes
        # handles that may write.
        with open(partial, "rb+") as handle:
            os.fsync(handle.fileno())
        replace_file(partial, path)
    except BaseException:
        with contextlib.suppress(OSError):  # raise the first error, even if Windows still holds the file open
            partial.unlink(missing_ok=True)
        raise


_HALF = re.compile(r"\..+\.[0-9a-f]+\.tmp(\..+)?")
_ABANDONED = 3600.0


def is_half_written(name: str) -> bool:
    """True for the name of a file that `atomic_path` has not renamed yet, of this version or an earlier one."""
    return _HALF.fullmatch(name) is not None


def sweep_half_written(folder: Path) -> None:
    """Removes half-written files of killed processes from a folder: those unchanged for an hour."""
    left = [file for file in folder.glob(".*.tmp*") if is_half_written(file.name)]
    if not left:
        return
    with contextlib.suppress(OSError):  # the folder is read-only
        # The disk's clock dates the files of all computers that write there.
        now = disk_time(folder)
        for file in left:
            with contextlib.suppress(OSError):  # another process removed it, or it belongs to another user
                if now - file.lstat().st_mtime > _ABANDONED:
                    file.unlink()


def disk_time(folder: Path) -> float:
    """Time of the clock that dates files in a folder, seconds since the epoch: for a network disk, its server's clock.
    OSError if the folder cannot be written."""
    probe = folder / f".clock.{uuid.uuid4().hex[:12]}.tmp"
    try:
        probe.write_bytes(b"1")
        return probe.stat().st_mtime
    finally:
        with contextlib.suppress(OSError):
            probe.unlink(missing_ok=True)


@contextlib.contextmanager
def replacing_folder(path: str | Path, keep: bool = False) -> Generator[Path]:
    """Yields an empty folder next to `path`, which replaces `path` as a whole if the block succeeds.

    `keep`: the old folder is left as `replaced_folder(path)`, for the caller to move.

    Until the block succeeds, `path` stays unchanged. The next call cleans up after a killed process: a folder that was
    moved aside is put back if nothing replaced it.
    """
    path = Path(path)
    fresh, replaced = path.with_name(f".{path.name}.new"), replaced_folder(path)
    restore_folder(path)
    _discard(fresh)
    make_folder(fresh)
    try:
        yield fresh
        if os.path.lexists(path):
            replace_file(path, replaced)
        replace_file(fresh, path)
    except BaseException:
        restore_folder(path)
        raise
    finally:
        _discard(fresh)
    if not keep:
        _discard(replaced)


def replaced_folder(path: Path) -> Path:
    """Path to which `replacing_folder` moves the old folder."""
    return path.with_name(f".{path.name}.old")


def restore_folder(path: Path) -> None:
    """Puts back the folder that a killed `replacing_folder` moved aside, or removes it if it was replaced."""
    replaced = replaced_folder(path)
    if replaced.is_dir() and not os.path.lexists(path):
        replace_file(replaced, path)
    _discard(replaced)


def _discard(folder: Path) -> None:
    """Removes a folder, or a link to one without following it."""
    if is_link(folder):
        remove_link(folder)
    else:
        shutil.rmtree(folder, ignore_errors=True)


def replace_file(source: Path, target: Path) -> None:
    """Renames a file over `target`, or a folder to an unused path. Waits on Windows, see `files.patiently`."""
    patiently(functools.partial(os.replace, source, target))


def remove_file(path: Path) -> None:
    """Removes a file, if it exists. Waits on Windows, see `files.patiently`."""
    patiently(functools.partial(path.unlink, missing_ok=True))


@contextlib.contextmanager
def locked(path: str | Path, waiting: Callable[[], None] | None = None) -> Generator[None]:
    """Holds a lock file, after waiting until it is free. Calls `waiting` once if the lock is not free at first.

    The system releases the lock when this process ends for any reason.
    """
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with open(path, "a+b") as lock:
        warned = False
        while not try_lock(lock.fileno()):
            if not warned and waiting is not None:
                waiting()
                warned = True
            time.sleep(0.2)
        yield


def try_lock(handle: int) -> bool:
    """Locks an open file without waiting; False if another process holds the lock. Closing the file releases it."""
    try:
        if sys.platform == "win32":
            import msvcrt

            # Windows locks bytes from the current position on.
            os.lseek(handle, 0, os.SEEK_SET)
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def write_atomic(path: str | Path, data: bytes, parents: bool = True) -> None:
    """Writes a whole file, or leaves the old one unchanged. `parents`: see `atomic_path`."""
    with atomic_path(path, parents) as partial:
        partial.write_bytes(data)


def write_json(path: str | Path, data: Mapping[str, Any], parents: bool = True) -> None:
    """Writes a JSON object. ValueError on NaN or infinity, because other programs read these files. `parents`: see
    `atomic_path`."""
    write_atomic(path, (json.dumps(data, indent=1, allow_nan=False) + "\n").encode("utf-8"), parents)


def content_key(*parts: Any) -> str:
    """Short hash of JSON-able values and of the content of files (passed as Path), to recognise finished work."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, Path):
            part = file_digest(part)
        elif dataclasses.is_dataclass(part) and not isinstance(part, type):
            part = dataclasses.asdict(part)
        digest.update(json.dumps(part, sort_keys=True, default=str).encode("utf-8"))
    return digest.hexdigest()[:16]


def need_disk(folder: str | Path, byte_count: float, what: str) -> None:
    """Raises JobError if the disk of `folder` has no room for another `byte_count` bytes."""
    existing = Path(folder).absolute()
    while not existing.exists():
        existing = existing.parent
    free = shutil.disk_usage(existing).free
    if free < byte_count:
        raise disk_error(folder, f"{what} needs about {byte_count / 1e6:.0f} MB, {free / 1e6:.0f} MB are free")
