"""How files of a shot are written: beside their place, fsynced, and renamed over it, so no reader sees half a file."""

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

_worked_on: list[Path] = []
"""Shot folders that jobs of this process work on."""


@contextlib.contextmanager
def working_on(*roots: Path) -> Generator[None]:
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
def atomic_path(path: str | Path, parents: bool = True) -> Generator[Path]:
    """A path beside `path`, with the same suffix, to write to; fsynced and renamed over `path` if all went well.

    Its folder is made, and with `parents` what that is in; FileNotFoundError without, in a shot that was moved.
    """
    path = Path(path)
    if parents:
        make_folder(path.parent)
    else:
        path.parent.mkdir(exist_ok=True)
    # Not the process's number: two hosts of a farm have the same ones. Nobody can have put a link there, either. Short:
    # Windows counts 260 letters of a whole path.
    partial = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:12]}.tmp{path.suffix}")
    try:
        yield partial
        with open(partial, "rb+") as handle:
            os.fsync(handle.fileno())
        replace_file(partial, path)
    except BaseException:
        with contextlib.suppress(OSError):  # what went wrong is to be told, not that Windows has it open still
            partial.unlink(missing_ok=True)
        raise


_HALF = re.compile(r"\..+\.[0-9a-f]+\.tmp(\..+)?")
_ABANDONED = 3600.0


def is_half_written(name: str) -> bool:
    """True for the name of a file that `atomic_path` has not renamed yet, of this version or an earlier one."""
    return _HALF.fullmatch(name) is not None


def sweep_half_written(folder: Path) -> None:
    """Removes what killed processes left half written in a folder: nobody has touched it for an hour, by the clock of
    the disk, which dates the files of all computers that write there."""
    left = [file for file in folder.glob(".*.tmp*") if is_half_written(file.name)]
    if not left:
        return
    with contextlib.suppress(OSError):  # nothing can be written there, nor removed
        now = disk_time(folder)
        for file in left:
            with contextlib.suppress(OSError):  # another sweeper was first, or it is another's: it does no harm
                if now - file.lstat().st_mtime > _ABANDONED:
                    file.unlink()


def disk_time(folder: Path) -> float:
    """The time by which files in a folder are dated now, seconds since the epoch: a network disk has its server's
    clock. OSError if nothing can be written there."""
    probe = folder / f".clock.{uuid.uuid4().hex[:12]}.tmp"
    try:
        probe.write_bytes(b"1")
        return probe.stat().st_mtime
    finally:
        with contextlib.suppress(OSError):
            probe.unlink(missing_ok=True)


@contextlib.contextmanager
def replacing_folder(path: str | Path, keep: bool = False) -> Generator[Path]:
    """Yields an empty folder beside `path`, which takes its place if the block ends well, whole or not at all.

    `keep`: the old folder is left as `replaced_folder(path)`, for the caller to move.

    Until then, and if the block fails, `path` stays as it was. What a killed process left is swept by the next one:
    a folder that had been moved aside is put back if nothing took its place.
    """
    path = Path(path)
    fresh, aside = path.with_name(f".{path.name}.new"), replaced_folder(path)
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
    if not keep:
        _discard(aside)


def replaced_folder(path: Path) -> Path:
    """Where `replacing_folder` puts the folder that it replaces."""
    return path.with_name(f".{path.name}.old")


def restore_folder(path: Path) -> None:
    """Puts back the folder that `replacing_folder` moved aside and was killed; if it was replaced, removes it."""
    aside = replaced_folder(path)
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
    """Renames over `target`, a file, or a folder to where none is. Waits on Windows, see `files.patiently`."""
    patiently(functools.partial(os.replace, source, target))


def remove_file(path: Path) -> None:
    """Removes a file, if it is there. Waits on Windows, see `files.patiently`."""
    patiently(functools.partial(path.unlink, missing_ok=True))


@contextlib.contextmanager
def locked(path: str | Path, waiting: Callable[[], None] | None = None) -> Generator[None]:
    """Holds a lock file, after waiting for whoever has it; `waiting` is called once if it has to.

    The system frees it when this process ends, however that comes about.
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


def write_atomic(path: str | Path, data: bytes, parents: bool = True) -> None:
    """Writes a whole file, or leaves what was there. `parents`: see `atomic_path`."""
    with atomic_path(path, parents) as partial:
        partial.write_bytes(data)


def write_json(path: str | Path, data: Mapping[str, Any], parents: bool = True) -> None:
    """Writes a JSON object. ValueError on NaN or infinity: other programs read these files. `parents`: see
    `atomic_path`."""
    write_atomic(path, (json.dumps(data, indent=1, allow_nan=False) + "\n").encode("utf-8"), parents)


def content_key(*parts: Any) -> str:
    """Short hash of JSON-able values and of files (given as Path: their content), for "already done?"."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, Path):
            part = file_digest(part)
        elif dataclasses.is_dataclass(part) and not isinstance(part, type):
            part = dataclasses.asdict(part)
        digest.update(json.dumps(part, sort_keys=True, default=str).encode("utf-8"))
    return digest.hexdigest()[:16]


def need_disk(folder: str | Path, byte_count: float, what: str) -> None:
    """JobError if the disk of `folder` has no room for `byte_count` bytes more."""
    existing = Path(folder).absolute()
    while not existing.exists():
        existing = existing.parent
    free = shutil.disk_usage(existing).free
    if free < byte_count:
        raise disk_error(folder, f"{what} needs about {byte_count / 1e6:.0f} MB, {free / 1e6:.0f} MB are free")
