"""Child processes of the launcher: started, stopped on Ctrl-C, and ended when the launcher ends."""

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
from collections.abc import Generator, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from torch_backend.contract import GRACE_SECONDS, ExitCode

from .errors import LauncherError
from .places import ROOT, WINDOWS


def say(text: str) -> None:
    """Prints one line for the artist, unbuffered."""
    print(text, flush=True)


def child_environ(**extra: str) -> dict[str, str]:
    """Environment variables for a child: its Python path is this checkout, without user or working folders."""
    environ = {k: v for k, v in os.environ.items() if k not in ("PYTHONHOME", "PYTHONPATH", "PYTHONSTARTUP")}
    environ.update(PYTHONPATH=str(ROOT), PYTHONSAFEPATH="1", PYTHONNOUSERSITE="1")
    environ.update(PYTHONUTF8="1", PYTHONUNBUFFERED="1", **extra)
    return environ


def start_child(command: Sequence[str], environ: dict[str, str], **streams: Any) -> subprocess.Popen[Any]:
    """Starts a child in a separate process group, so that it receives Ctrl-C once, from `stop_children`.

    Its working folder is that of its program, as in `contract.python_child`, unless `cwd` is in `streams`.
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
    """`stop_children` for one child."""
    stop_children([child])


def stop_children(children: Sequence[subprocess.Popen[Any]]) -> None:
    """Interrupts children as Ctrl-C would; kills them and their children after a timeout, or on a second Ctrl-C.

    All children are interrupted before the wait begins, so that they stop in parallel.
    """
    living = [child for child in children if child.poll() is None]
    deadline = time.monotonic() + GRACE_SECONDS
    try:
        for child in living:
            child.send_signal(getattr(signal, "CTRL_BREAK_EVENT", signal.SIGTERM) if WINDOWS else signal.SIGINT)
        for child in living:
            child.wait(max(0.0, deadline - time.monotonic()))
    except (KeyboardInterrupt, subprocess.TimeoutExpired):
        for child in living:
            if child.poll() is None:
                _kill(child)


def _kill(child: subprocess.Popen[Any]) -> None:
    """Kills a child and, except on Windows, the rest of its process group."""
    if WINDOWS:
        child.kill()
    else:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)
    child.wait()


def wait_for_any(children: Sequence[subprocess.Popen[Any]], seconds: float) -> subprocess.Popen[Any] | None:
    """The first child that has ended; None if none ends within `seconds`. Ctrl-C interrupts it on every system."""
    deadline = time.monotonic() + seconds
    while True:
        for child in children:
            if child.poll() is not None:
                return child
        if time.monotonic() >= deadline:
            return None
        time.sleep(0.1)


def tied_command(python: str, module: str, *words: str) -> list[str]:
    """`python -m module words` for a child that ends with this process, even if this process is killed.

    The child's standard input must be a pipe (`run_child(tied=True)`), which closes when this process ends.
    """
    return [python, "-P", "-m", "torch_backend.tied", module, *words]


def close_input(child: subprocess.Popen[Any]) -> None:
    """Closes this process's end of an ended child's standard input."""
    if child.stdin is not None:
        with contextlib.suppress(OSError):
            child.stdin.close()


def run_child(
    command: Sequence[str], cwd: Path | None = None, tied: bool = False, log: BinaryIO | None = None, **environ: str
) -> int:
    """Runs a child that inherits this process's output; returns its exit code.

    Ctrl-C cancels the child, then raises KeyboardInterrupt.

    `cwd`: working folder; default: the folder of the program.
    `tied`: the child's standard input is a pipe that closes when this process ends, which the child watches.
    `log`: open file for the child's output.
    """
    streams: dict[str, Any] = {"stdin": subprocess.PIPE} if tied else {}
    if cwd is not None:
        streams["cwd"] = cwd
    if log is not None:
        streams.update(stdout=log, stderr=subprocess.STDOUT)
    child = start_child(command, child_environ(**environ), **streams)
    with _cancelled_by_ctrl_c(child):
        while True:
            # On Windows, Ctrl-C cannot interrupt a wait without timeout.
            with contextlib.suppress(subprocess.TimeoutExpired):
                return exit_code_of(child.wait(0.2))


@contextlib.contextmanager
def _cancelled_by_ctrl_c(child: subprocess.Popen[Any]) -> Generator[None]:
    """Ctrl-C in the block cancels the child, then raises KeyboardInterrupt. Closes the child's input at the end."""
    try:
        yield
    except KeyboardInterrupt:
        say("\nCancelling; Ctrl-C again stops at once.")
        stop_child(child)
        raise KeyboardInterrupt("the child has said so") from None
    finally:
        close_input(child)


def lines_of(child: subprocess.Popen[bytes]) -> Iterator[str | None]:
    """Yields the lines that a child prints, as they arrive, and None while it is silent.

    A thread reads them, also after Ctrl-C. On Windows a read cannot be interrupted, and a child whose output is not
    read blocks at its next print instead of ending.
    """
    lines: queue.Queue[bytes | None] = queue.Queue()

    def read() -> None:
        for line in child.stdout or ():
            lines.put(line)
        lines.put(None)

    threading.Thread(target=read, name="child's output", daemon=True).start()
    while True:
        try:
            line = lines.get(timeout=0.2)
        except queue.Empty:
            yield None
            continue
        if line is None:
            return
        yield line.decode("utf-8", "replace")


def exit_code_of(code: int) -> int:
    """A child's exit code, or, if a signal ended it, CANCELLED or INTERNAL. Prints an error for INTERNAL."""
    if code in (-signal.SIGINT, -signal.SIGTERM, 0xC000013A):  # 0xC000013A: Ctrl-C on Windows
        return ExitCode.CANCELLED
    if code >= 0 and not (WINDOWS and code > 255):
        return code
    print(f"Error: a process was killed ({code}), perhaps because memory ran out.", file=sys.stderr, flush=True)
    return ExitCode.INTERNAL


BLENDER_LOG_LINE = re.compile(
    r"\d\d:\d\d\.\d+ |Info: |Fra:|Saved: |Blender \d|Read blend: | ?Time: |\s*$|.*RuntimeWarning: |    "
)
"""Lines of Blender's output that do not concern an artist; they only go to the log."""


def run_blender(command: Sequence[str], log: Path, **environ: str) -> int:
    """`run_child(tied=True)` for Blender. All output goes to `log`; the add-on's lines also go to the screen."""
    streams = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    child = start_child(command, child_environ(**environ), **streams)
    with _cancelled_by_ctrl_c(child), open(log, "w", encoding="utf-8") as stream:
        for printed in lines_of(child):
            if printed is None:
                continue
            line = printed.rstrip()
            stream.write(line + "\n")
            if line.startswith("Error: "):
                print(line, file=sys.stderr, flush=True)
            elif not BLENDER_LOG_LINE.match(line):
                say(line)
        return exit_code_of(child.wait())
