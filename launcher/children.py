"""Processes that the launcher starts: found again on Ctrl-C, and gone when it is."""

from __future__ import annotations

import contextlib
import os
import queue
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from torch_backend.contract import GRACE_SECONDS, ExitCode

from .errors import LauncherError
from .places import ROOT, WINDOWS


def say(text: str) -> None:
    """One line to the artist, at once."""
    print(text, flush=True)


def child_environ(**extra: str) -> dict[str, str]:
    """Environment variables for a child: this checkout on its path, nothing of another Python or of where it stands."""
    environ = {k: v for k, v in os.environ.items() if k not in ("PYTHONHOME", "PYTHONPATH", "PYTHONSTARTUP")}
    environ.update(PYTHONPATH=str(ROOT), PYTHONSAFEPATH="1", PYTHONNOUSERSITE="1")
    environ.update(PYTHONUTF8="1", PYTHONUNBUFFERED="1", **extra)
    return environ


def start_child(command: Sequence[str], environ: dict[str, str], **streams: Any) -> subprocess.Popen[Any]:
    """Starts a child in a process group of its own, so that Ctrl-C reaches it once, from here.

    It stands beside its program, as in `contract.python_child`, unless `cwd` says where.
    """
    streams.setdefault("stdin", subprocess.DEVNULL)
    streams.setdefault("cwd", os.path.dirname(os.path.abspath(command[0])))
    try:
        if WINDOWS:
            group = getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)
            streams["creationflags"] = group
        else:
            streams["start_new_session"] = True
        return subprocess.Popen(command, env=environ, **streams)
    except OSError as error:
        raise LauncherError(f"Cannot start {command[0]} ({error}): run `setup` again, or see `doctor`.") from error


def stop_child(child: subprocess.Popen[Any]) -> None:
    """`stop_children` of one."""
    stop_children([child])


def stop_children(children: Sequence[subprocess.Popen[Any]]) -> None:
    """Asks children to stop as Ctrl-C would; takes them and their children down if they do not, or on a second Ctrl-C.

    All are asked before any is waited for, so that together they take no longer than the slowest.
    """
    living = [child for child in children if child.poll() is None]
    until = time.monotonic() + GRACE_SECONDS
    try:
        for child in living:
            child.send_signal(getattr(signal, "CTRL_BREAK_EVENT", signal.SIGTERM) if WINDOWS else signal.SIGINT)
        for child in living:
            child.wait(max(0.0, until - time.monotonic()))
    except (KeyboardInterrupt, subprocess.TimeoutExpired):
        for child in living:
            if child.poll() is None:
                _kill(child)


def _kill(child: subprocess.Popen[Any]) -> None:
    """Ends a child and, where it has a group of its own, its children."""
    if WINDOWS:
        child.kill()
    else:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)
    child.wait()


def wait_for_any(children: Sequence[subprocess.Popen[Any]], seconds: float) -> subprocess.Popen[Any] | None:
    """The first child that has ended; None if none has after `seconds`. Can be interrupted on every system."""
    until = time.monotonic() + seconds
    while True:
        for child in children:
            if child.poll() is not None:
                return child
        if time.monotonic() >= until:
            return None
        time.sleep(0.1)


def tied_command(python: str, module: str, *words: str) -> list[str]:
    """`python -m module words` for a child that ends when we do, however that comes about: its standard input must be a
    pipe (`run_child(tied=True)`), which closes with us."""
    return [python, "-P", "-m", "torch_backend.tied", module, *words]


def close_input(child: subprocess.Popen[Any]) -> None:
    """Closes our end of an ended child's standard input."""
    if child.stdin is not None:
        with contextlib.suppress(OSError):
            child.stdin.close()


def run_child(
    command: Sequence[str], cwd: Path | None = None, tied: bool = False, log: BinaryIO | None = None, **environ: str
) -> int:
    """Runs a child with our output; returns its exit code. On Ctrl-C it is cancelled and KeyboardInterrupt goes on.

    `cwd`: where it stands, if not beside its program.
    `tied`: its standard input stays open as long as this process lives, however that ends; the child watches it.
    `log`: an open file that takes its output instead.
    """
    streams: dict[str, Any] = {"stdin": subprocess.PIPE} if tied else {}
    if cwd is not None:
        streams["cwd"] = cwd
    if log is not None:
        streams.update(stdout=log, stderr=subprocess.STDOUT)
    child = start_child(command, child_environ(**environ), **streams)
    try:
        while True:
            # A wait without limit cannot be interrupted on Windows.
            with contextlib.suppress(subprocess.TimeoutExpired):
                return exit_code_of(child.wait(0.2))
    except KeyboardInterrupt:
        say("\nCancelling; Ctrl-C again stops at once.")
        stop_child(child)
        raise KeyboardInterrupt("the child has said so") from None
    finally:
        close_input(child)


def _lines_of(child: subprocess.Popen[bytes]) -> Iterator[bytes]:
    """Yields what a child prints, as it arrives. A thread reads it, also after a Ctrl-C: on Windows a read cannot be
    interrupted, and a child whose output is not read blocks at its next print instead of ending."""
    lines: queue.Queue[bytes | None] = queue.Queue()

    def read() -> None:
        for line in child.stdout or ():
            lines.put(line)
        lines.put(None)

    threading.Thread(target=read, name="child's output", daemon=True).start()
    while True:
        with contextlib.suppress(queue.Empty):
            line = lines.get(timeout=0.2)
            if line is None:
                return
            yield line


def exit_code_of(code: int) -> int:
    """A child's return code as one of `ExitCode`: of one that a signal ended, CANCELLED or, with a word, INTERNAL."""
    if code in (-signal.SIGINT, -signal.SIGTERM, 0xC000013A):  # the last: Ctrl-C on Windows
        return ExitCode.CANCELLED
    if code >= 0 and not (WINDOWS and code > 255):
        return code
    print(f"Error: a process was ended from outside ({code}), perhaps for want of memory.", file=sys.stderr, flush=True)
    return ExitCode.INTERNAL


BLENDERS_OWN = re.compile(
    r"\d\d:\d\d\.\d+ |Info: |Fra:|Saved: |Blender \d|Read blend: | ?Time: |\s*$|.*RuntimeWarning: |    "
)
"""Lines of Blender's that are no news to an artist; they go to the log."""


def run_blender(command: Sequence[str], log: Path, **environ: str) -> int:
    """`run_child(tied=True)` for Blender: all that it prints goes to `log`, what the add-on says also to the screen."""
    streams = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    child = start_child(command, child_environ(**environ), **streams)
    try:
        with open(log, "w", encoding="utf-8") as stream:
            for raw in _lines_of(child):
                line = raw.decode("utf-8", "replace").rstrip()
                stream.write(line + "\n")
                if line.startswith("Error: "):
                    print(line, file=sys.stderr, flush=True)
                elif not BLENDERS_OWN.match(line):
                    say(line)
        return exit_code_of(child.wait())
    except KeyboardInterrupt:
        say("\nCancelling; Ctrl-C again stops at once.")
        stop_child(child)
        raise KeyboardInterrupt("the child has said so") from None
    finally:
        close_input(child)
