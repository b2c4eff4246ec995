"""One writer per shot: the lock that a job holds while its station works.

The lock is a file in the shot, so that it works between computers that share a disk. It names its process. If that
process was killed, one other process on the same computer takes the lock over.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import sys
import time
import uuid
from collections.abc import Callable, Generator
from pathlib import Path

from . import contract
from .contract import ExitCode, JobError, Writer
from .shot import is_disk_full, try_lock

_SECONDS = 5.0
"""Seconds for which taking the lock is retried while other processes take and release it."""
_LENGTH = 1024
"""Size of every lock file in bytes. A lock is taken over in place, by one write of this size."""
SILENCE_SECONDS = 180.0
"""A writer on another computer counts as dead after this time without a new heartbeat. Network disks cache files for a
third of this time."""
_BARE = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


@contextlib.contextmanager
def only_writer(root: Path, kind: str, job: str) -> Generator[Writer]:
    """Holds the lock of the shot in `root`. JobError if another job holds it, or if the shot cannot be written."""
    pid = os.getpid()
    writer = Writer(contract.computer_name(), pid, contract.process_start(pid), kind, job, time.time())
    try:
        _take(root, writer)
    except OSError as error:
        if is_disk_full(error) or isinstance(error, FileNotFoundError):
            raise
        reason = error.strerror or error
        raise JobError(f"Cannot write to {root}: {reason}.", "Choose another shot folder.", ExitCode.DISK) from error
    folder = os.open(root, os.O_RDONLY) if os.unlink in os.supports_dir_fd else None
    try:
        yield writer
    finally:
        _release(root, writer, folder)
        if folder is not None:
            os.close(folder)


@contextlib.contextmanager
def patient_writer(
    root: Path, kind: str, job: str, waiting: Callable[[str], None], silence: float = SILENCE_SECONDS
) -> Generator[Writer]:
    """`only_writer` that waits while another process holds the lock, and takes over the lock of a process that died on
    another computer.

    For render farms, which restart killed tasks on other computers, without a user who could delete the lock.

    Args:
        waiting: called regularly with a message that names the other process. If it raises, the wait ends.
        silence: seconds without a heartbeat after which a writer counts as dead, by this computer's clock alone.

    Raises:
        JobError: the shot cannot be written.
    """
    last_sign, since = None, time.monotonic()
    with contextlib.ExitStack() as stack:
        while True:
            try:
                writer = stack.enter_context(only_writer(root, kind, job))
                break
            except JobError as error:
                holder = _read_writer(root)
                if holder is None or not holder.works():
                    if error.exit_code != ExitCode.USAGE:
                        raise
                    holder = None
                waiting(error.message)
            sign = None if holder is None else (holder, _heartbeat(root, holder))
            if sign != last_sign:
                last_sign, since = sign, time.monotonic()
            elif holder is not None and holder.host != contract.computer_name() and time.monotonic() - since > silence:
                _remove_lock(root, holder)
            time.sleep(min(1.0, silence / 4))
        yield writer


def _read_writer(root: Path) -> Writer | None:
    try:
        return contract.read_writer(root)
    except (OSError, ValueError):
        return None


def _heartbeat(root: Path, holder: Writer) -> object:
    """Last heartbeat of a writer's job; None if it cannot be read. Compared with earlier ones, not with a clock."""
    try:
        job = contract.ShotFolder(root).jobs / contract.checked_name(holder.job, "job")
        return contract.read_json(job / contract.STATUS_FILE, contract.SHORT_JSON).get("heartbeat")
    except (OSError, ValueError):
        return None


def _remove_lock(root: Path, dead: Writer) -> None:
    """Removes the lock of a dead writer. Puts the lock back if a new writer took it in between."""
    path = contract.ShotFolder(root).lock
    partial = path.with_name(f".{path.stem}.{uuid.uuid4().hex}.tmp")
    try:
        os.rename(path, partial)
    except OSError:
        return  # another process was faster
    try:
        with contextlib.suppress(OSError, ValueError):
            if contract.from_dict(Writer, contract.read_json(partial, _LENGTH)) != dead:
                os.link(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _take(root: Path, writer: Writer) -> None:
    path, deadline = contract.ShotFolder(root).lock, time.monotonic() + _SECONDS
    while not _make(path, writer):
        try:
            holder = contract.read_writer(root)
        except (OSError, ValueError) as error:  # being written just now, or by another program
            if time.monotonic() > deadline:
                hint = f"If no step runs on this shot, delete {path}."
                raise JobError(f"Cannot find out whether a step runs on {root.name}: {error}.", hint, ExitCode.USAGE) \
                    from error  # fmt: skip
            time.sleep(0.05)
            continue
        if holder is None:  # released in between, or a dangling link
            if time.monotonic() > deadline:
                what = f"{path} cannot be created, and it does not say which computer works on {root.name}."
                raise JobError(what, "Delete it, then start again.", ExitCode.USAGE)
            time.sleep(0.01)
            continue
        if holder.works():
            if not contract.is_ending(root, holder) or time.monotonic() > deadline:
                raise contract.busy(root, holder)
            time.sleep(0.01)
            continue
        if _take_over(path, holder, writer):
            return
        if time.monotonic() > deadline:
            what = f"{path} was left behind by a stopped step and cannot be replaced."
            raise JobError(what, "Delete it, then start again.", ExitCode.USAGE)
        time.sleep(0.01)


def _text(writer: Writer) -> bytes:
    return json.dumps(dataclasses.asdict(writer)).encode().ljust(_LENGTH)


def _make(path: Path, writer: Writer) -> bool:
    """Creates a complete lock file in one step; False if there is one already.

    The server of a network disk creates hard links atomically. On a disk without hard links, the lock is opened
    exclusively.
    """
    partial = path.with_name(f".{path.stem}.{uuid.uuid4().hex}.tmp")
    try:
        _write(partial, writer)
        if sys.platform == "win32":
            try:
                os.rename(partial, path)  # does not replace a file on Windows
            except PermissionError:  # a virus scanner holds it, or the previous writer removes it: the caller retries
                return False
        else:
            try:
                os.link(partial, path)
            except FileExistsError:
                return os.stat(partial).st_nlink == 2  # NFS sent the request twice, and the first one succeeded
            except OSError:  # no links on this disk
                _write(path, writer)
    except FileExistsError:
        return False
    finally:
        contract.remove_file(partial)
    return True


def _write(path: Path, writer: Writer) -> None:
    """Creates a new lock file. FileExistsError if there is one."""
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | _BARE)
    try:
        os.write(handle, _text(writer))
        os.fsync(handle)
    except OSError:
        path.unlink(missing_ok=True)
        raise
    finally:
        os.close(handle)


def _take_over(path: Path, dead: Writer, writer: Writer) -> bool:
    """Replaces the entry of a dead process of this computer with `writer`; False if another process was faster.

    Only processes of this computer try this, and the system lets one of them at a time lock the file.
    """
    try:
        handle = os.open(path, os.O_RDWR | _BARE)
    except OSError:
        return False  # released in between, or a link
    with os.fdopen(handle, "r+b") as lock:
        if not try_lock(handle):
            return False
        try:
            is_same = contract.from_dict(Writer, json.loads(lock.read(_LENGTH))) == dead
            if not is_same or not os.path.samestat(os.stat(path), os.fstat(handle)):
                return False
        except (FileNotFoundError, ValueError):
            return False
        lock.seek(0)
        lock.write(_text(writer))
        lock.truncate(_LENGTH)
        lock.flush()
        os.fsync(handle)
    return True


def _release(root: Path, writer: Writer, folder: int | None) -> None:
    """Removes the lock if it is `writer`. `folder`, a handle of the shot folder, finds it even in a renamed shot."""
    path = Path(contract.WRITER_FILE) if folder is not None else root / contract.WRITER_FILE
    for _ in range(40):
        try:
            with os.fdopen(os.open(path, os.O_RDONLY | _BARE, dir_fd=folder), "rb") as lock:
                if lock.read(_LENGTH) != _text(writer):
                    return
            os.unlink(path, dir_fd=folder)
            return
        except PermissionError:
            time.sleep(0.05)  # Windows: another process reads it
        except OSError:
            return
