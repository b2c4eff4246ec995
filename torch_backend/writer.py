"""One writer per shot: the lock that a job holds while its station works.

The lock is a file in the shot, so that it holds between computers that share a disk. It names its process: what a
killed one left is taken over on the same computer, by one of all that try.
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
"""How long the lock is tried for while others come and go."""
_LENGTH = 1024
"""Bytes of every lock: it is taken over in its place, by one write of as many."""
SILENCE_SECONDS = 180.0
"""A writer on another computer that has told nothing for so long is dead: three times as long as network disks keep
what they were told."""
_BARE = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


@contextlib.contextmanager
def only_writer(root: Path, kind: str, job: str) -> Generator[Writer]:
    """Holds the shot in `root` for a job. JobError if another one does, or if the shot cannot be written."""
    pid = os.getpid()
    mine = Writer(contract.computer_name(), pid, contract.process_start(pid), kind, job, time.time())
    try:
        _take(root, mine)
    except OSError as error:
        if is_disk_full(error) or isinstance(error, FileNotFoundError):
            raise
        reason = error.strerror or error
        raise JobError(f"Cannot write to {root}: {reason}.", "Choose another shot folder.", ExitCode.DISK) from error
    folder = os.open(root, os.O_RDONLY) if os.unlink in os.supports_dir_fd else None
    try:
        yield mine
    finally:
        _release(root, mine, folder)
        if folder is not None:
            os.close(folder)


@contextlib.contextmanager
def patient_writer(
    root: Path, kind: str, job: str, waiting: Callable[[str], None], silence: float = SILENCE_SECONDS
) -> Generator[Writer]:
    """`only_writer` that waits while another process holds the lock, and takes over the lock of a process that died on
    another computer.

    For render farms, which restart killed tasks on other computers, where no user is there to delete the lock.

    Args:
        waiting: called regularly with a sentence that names the process waited for; an exception from it ends the
            waiting.
        silence: seconds, by this computer's clock alone, without a sign of life after which a writer counts as dead.

    Raises:
        JobError: the shot cannot be written.
    """
    heard, since = None, time.monotonic()
    with contextlib.ExitStack() as held:
        while True:
            try:
                mine = held.enter_context(only_writer(root, kind, job))
                break
            except JobError as error:
                holder = _read_writer(root)
                if holder is None or not holder.works():
                    if error.exit_code != ExitCode.USAGE:
                        raise
                    holder = None
                waiting(error.message)
            sign = None if holder is None else (holder, _heartbeat(root, holder))
            if sign != heard:
                heard, since = sign, time.monotonic()
            elif holder is not None and holder.host != contract.computer_name() and time.monotonic() - since > silence:
                _bury(root, holder)
            time.sleep(min(1.0, silence / 4))
        yield mine


def _read_writer(root: Path) -> Writer | None:
    try:
        return contract.read_writer(root)
    except (OSError, ValueError):
        return None


def _heartbeat(root: Path, holder: Writer) -> object:
    """What a writer's job told last; None if that cannot be read. It is compared with itself, not with a clock."""
    try:
        job = contract.ShotFolder(root).jobs / contract.checked_name(holder.job, "job")
        return contract.read_json(job / contract.STATUS_FILE, contract.SHORT_JSON).get("heartbeat")
    except (OSError, ValueError):
        return None


def _bury(root: Path, dead: Writer) -> None:
    """Takes away the lock of a writer that gave no sign of life. One that was made meanwhile is put back."""
    path = contract.ShotFolder(root).lock
    partial = path.with_name(f".{path.stem}.{uuid.uuid4().hex}.tmp")
    try:
        os.rename(path, partial)
    except OSError:
        return  # another one was faster
    try:
        with contextlib.suppress(OSError, ValueError):
            if contract.from_dict(Writer, contract.read_json(partial, _LENGTH)) != dead:
                os.link(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _take(root: Path, mine: Writer) -> None:
    path, until = contract.ShotFolder(root).lock, time.monotonic() + _SECONDS
    while not _make(path, mine):
        try:
            holder = contract.read_writer(root)
        except (OSError, ValueError) as error:  # being written just now, or by no hand of ours
            if time.monotonic() > until:
                hint = f"If nothing works on this shot, delete {path}."
                raise JobError(f"Whether a step works on {root.name} cannot be told: {error}.", hint, ExitCode.USAGE) \
                    from error  # fmt: skip
            time.sleep(0.05)
            continue
        if holder is None:  # given back in between, or a link to nowhere
            if time.monotonic() > until:
                what = f"{path} cannot be made, and names nobody who works on {root.name}."
                raise JobError(what, "Delete it, then start again.", ExitCode.USAGE)
            time.sleep(0.01)
            continue
        if holder.works():
            if not contract.gives_back(root, holder) or time.monotonic() > until:
                raise contract.busy(root, holder)
            time.sleep(0.01)
            continue
        if _take_over(path, holder, mine):
            return
        if time.monotonic() > until:
            what = f"{path} was left by a step that was ended, and cannot be replaced."
            raise JobError(what, "Delete it, then start again.", ExitCode.USAGE)
        time.sleep(0.01)


def _text(writer: Writer) -> bytes:
    return json.dumps(dataclasses.asdict(writer)).encode().ljust(_LENGTH)


def _make(path: Path, mine: Writer) -> bool:
    """Puts a lock where there is none, whole at once; False if there is one.

    A link is made or refused by the server of a network disk itself; where a disk knows none, an exclusive open is.
    """
    partial = path.with_name(f".{path.stem}.{uuid.uuid4().hex}.tmp")
    try:
        _write(partial, mine)
        if sys.platform == "win32":
            try:
                os.rename(partial, path)  # which refuses to replace, there
            except PermissionError:  # a virus scanner holds it, or the previous writer is removing it: checked again
                return False
        else:
            try:
                os.link(partial, path)
            except FileExistsError:
                return os.stat(partial).st_nlink == 2  # NFS asked twice, and was told of its own success
            except OSError:  # no links on this disk
                _write(path, mine)
    except FileExistsError:
        return False
    finally:
        contract.remove_file(partial)
    return True


def _write(path: Path, mine: Writer) -> None:
    """Makes a file of its own. FileExistsError if there is one."""
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | _BARE)
    try:
        os.write(handle, _text(mine))
        os.fsync(handle)
    except OSError:
        path.unlink(missing_ok=True)
        raise
    finally:
        os.close(handle)


def _take_over(path: Path, dead: Writer, mine: Writer) -> bool:
    """Puts us in the place of a dead process of this computer; False if another one was faster: look again.

    All who may do so are on this computer, where the system lets one of them at a time hold the file.
    """
    try:
        handle = os.open(path, os.O_RDWR | _BARE)
    except OSError:
        return False  # given back in between, or a link
    with os.fdopen(handle, "r+b") as lock:
        if not try_lock(handle):
            return False
        try:
            same = contract.from_dict(Writer, json.loads(lock.read(_LENGTH))) == dead
            if not same or not os.path.samestat(os.stat(path), os.fstat(handle)):
                return False
        except (FileNotFoundError, ValueError):
            return False
        lock.seek(0)
        lock.write(_text(mine))
        lock.truncate(_LENGTH)
        lock.flush()
        os.fsync(handle)
    return True


def _release(root: Path, mine: Writer, folder: int | None) -> None:
    """Takes our lock away, also from a shot that was renamed meanwhile (`folder`, a handle of it). Another's stays."""
    path = Path(contract.WRITER_FILE) if folder is not None else root / contract.WRITER_FILE
    for _ in range(40):
        try:
            with os.fdopen(os.open(path, os.O_RDONLY | _BARE, dir_fd=folder), "rb") as lock:
                if lock.read(_LENGTH) != _text(mine):
                    return
            os.unlink(path, dir_fd=folder)
            return
        except PermissionError:
            time.sleep(0.05)  # Windows: somebody reads it
        except OSError:
            return
