"""Starts child processes, ends a process with its starter, and checks which process lives."""

from __future__ import annotations

import _thread
import calendar
import contextlib
import ctypes
import functools
import hashlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .errors import ExitCode

GRACE_SECONDS = 30.0
"""How long a cancelled process may take for its checkpoint before it is ended by force."""


def python_child(python: str | Path, module: str, *words: str) -> dict[str, Any]:
    """`args` and `cwd` for a `Popen` that runs a module of this project; paths in `words` should be absolute."""
    python = os.path.abspath(python)
    # -P: Python would import modules from its working directory, and a shot folder may come from anywhere. Libraries
    # are searched there, too (Windows always, Linux with an empty entry in LD_LIBRARY_PATH). The interpreter's folder
    # holds no foreign files, and Windows may still move the folder of the shot.
    return {"args": [python, "-P", "-m", module, *words], "cwd": os.path.dirname(python)}


def child_environment(root: Path) -> dict[str, str]:
    """Environment for a child of `python_child` that has to import this package from the folder `root`."""
    # An empty or relative entry would refer to the child's working directory.
    inherited = [p for p in os.environ.get("PYTHONPATH", "").split(os.pathsep) if os.path.isabs(p)]
    # Threads that spin while they wait would take a core from other processes.
    environment = {"OMP_WAIT_POLICY": "passive"} | os.environ
    return environment | {"PYTHONSAFEPATH": "1", "PYTHONPATH": os.pathsep.join([str(root), *inherited])}


def detach_standard_input() -> int:
    """A private handle of the standard input, for a thread that reads it. The null device replaces handle 0."""
    # On Windows, any access to a pipe blocks while a thread waits to read from it. A child that inherits the pipe would
    # block at its start, and a library while it is loaded.
    standard_input = os.dup(0)
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    os.close(null)
    return standard_input


def end_with_starter(grace_seconds: float = GRACE_SECONDS) -> None:
    """Stops this process, as Ctrl-C does, once its standard input closes. The input closes when the starter ends.

    The process has `grace_seconds` for a checkpoint. Then it is killed, with the process group that it leads (POSIX).
    """
    watch = functools.partial(_stop_with_starter, detach_standard_input(), grace_seconds)
    threading.Thread(target=watch, name="end with starter", daemon=True).start()


def _stop_with_starter(starter: int, grace_seconds: float) -> None:
    with contextlib.suppress(OSError):
        while os.read(starter, 1):
            pass
    if sys.platform == "win32":
        _thread.interrupt_main()
    else:  # a real signal also interrupts a wait of the main thread
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
    time.sleep(grace_seconds)
    if sys.platform != "win32" and os.getpgrp() == os.getpid():
        os.killpg(0, signal.SIGKILL)
    os._exit(ExitCode.CANCELLED)


def program(name: str) -> str | None:
    """Absolute path of a program on the PATH; None if there is none, or if the working directory has one."""
    # On Windows, `which` searches the working directory first, which may have come with a .blend or a clip.
    found = shutil.which(name)
    return found if found and os.path.isabs(found) else None


@functools.cache
def computer_name() -> str:
    """Name of this computer in files: its host name, with a hash in brackets that distinguishes equal host names.

    On Linux the hash covers the machine id and the namespace of process ids, which differs between containers. On
    Windows it covers the machine's GUID. Other systems have no hash. A Mac has its local host name, because the result
    of `gethostname` depends on the network and differs between home and studio.
    """
    marks: list[str] = []
    if sys.platform == "win32":
        import winreg

        with contextlib.suppress(OSError):
            with winreg.OpenKey(winreg.HKEY_LOCAL_MACHINE, r"SOFTWARE\Microsoft\Cryptography") as known:
                marks.append(str(winreg.QueryValueEx(known, "MachineGuid")[0]))
    else:
        with contextlib.suppress(OSError):
            marks.append(Path("/etc/machine-id").read_text(encoding="ascii", errors="replace").strip())
        with contextlib.suppress(OSError):
            marks.append(os.readlink("/proc/self/ns/pid"))
    mark = hashlib.sha256("\n".join(marks).encode()).hexdigest()[:8]
    name = _name_of_mac() or socket.gethostname()
    return f"{name} ({mark})" if any(marks) else name


def _name_of_mac() -> str:
    """Local host name of a Mac; empty on other systems, or if it is unknown."""
    if sys.platform != "darwin":
        return ""
    try:  # as in `process_of_ps`
        command = ["/usr/sbin/scutil", "--get", "LocalHostName"]
        done = subprocess.run(command, capture_output=True, close_fds=False, timeout=5.0, check=True)
    except (OSError, subprocess.SubprocessError):
        return ""
    return os.fsdecode(done.stdout).strip()


@dataclass(frozen=True)
class Process:
    """A living process, as the system describes it."""

    started: float
    """Start time in a unit of the system, only for comparison with another `started`; 0 if unknown."""
    command: str
    """Command line, arguments separated by spaces; empty if unknown."""


def process(pid: object) -> Process | None:
    """The living process of this computer with an id; None if there is none. `pid` may be any value from a file.

    Uses only the standard library, on all three systems.
    """
    if not (isinstance(pid, int) and 0 < pid < 1 << 31):
        return None
    if sys.platform == "win32":
        return _process_of_windows(pid)
    try:
        os.kill(pid, 0)  # signal 0 only checks that the process exists
    except ProcessLookupError:
        return None
    except OSError:
        pass  # it exists, but belongs to another user
    return _process_of_proc(pid) if Path("/proc/self/stat").exists() else process_of_ps(pid)


def process_start(pid: int) -> float:
    """`Process.started` of a process; 0 if there is none or its start is unknown."""
    found = process(pid)
    return found.started if found is not None else 0.0


def runs_still(pid: int, started: float) -> bool:
    """True if a process of this computer with this id and start lives, even if it is suspended.

    If a start is unknown, the id alone decides.
    """
    found = process(pid)
    # Rather a dead job believed alive than a living one declared dead.
    return found is not None and (not found.started or not started or found.started == started)


def _process_of_proc(pid: int) -> Process | None:
    """The process from /proc, with its start in clock ticks since boot."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
        fields = text.rpartition(")")[2].split()
        if fields[0] in ("Z", "X"):
            return None  # it has ended: only its exit code is kept for its parent
        words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
        return Process(float(fields[19]), " ".join(os.fsdecode(word) for word in words).rstrip(" "))
    except (OSError, ValueError, IndexError):
        return Process(0.0, "")  # hidden from this user, or ending just now


def process_of_ps(pid: int) -> Process | None:
    """The process from `ps`, on systems without /proc (macOS), with its start in whole seconds since the epoch."""
    command = ["/bin/ps", "-ww", "-o", "stat=,lstart=,command=", "-p", str(pid)]
    environ = {"LC_ALL": "C", "TZ": "UTC0", "PATH": "/usr/bin:/bin"}
    try:
        # close_fds=False: macOS then spawns it without copying the parent, which may be a heavy Blender.
        output = subprocess.run(command, capture_output=True, env=environ, close_fds=False, timeout=5.0, check=False)
        state, _, month, day, clock, year, line = os.fsdecode(output.stdout).strip("\n").split(None, 6)
        if state.startswith("Z"):
            return None
        hours, minutes, seconds = map(int, clock.split(":"))
        when = (int(year), _MONTHS.index(month) + 1, int(day), hours, minutes, seconds)
    except (OSError, ValueError, subprocess.SubprocessError):
        return Process(0.0, "")
    return Process(float(calendar.timegm((*when, 0, 0, 0))), line)


def run_from(folder: Path) -> list[int]:
    """Ids of processes whose program lies in a folder, as far as the system shows them. Their command lines begin with
    the absolute path of the program, as those of `python_child` do.

    Empty on Windows, which refuses to move a folder with a running program.
    """
    if sys.platform == "win32":
        return []
    starts = tuple({f"{folder.absolute()}{os.sep}", f"{os.path.realpath(folder)}{os.sep}"})
    known = _commands_of_proc() if Path("/proc/self/cmdline").exists() else commands_of_ps()
    return sorted(pid for pid, command in known.items() if command.startswith(starts))


def _commands_of_proc() -> dict[int, str]:
    """Process id -> its program, for processes that this user may read."""
    found: dict[int, str] = {}
    for entry in os.scandir("/proc"):
        if entry.name.isdecimal():
            with contextlib.suppress(OSError):  # it has ended since
                found[int(entry.name)] = os.fsdecode(Path(entry.path, "cmdline").read_bytes().partition(b"\0")[0])
    return found


def commands_of_ps() -> dict[int, str]:
    """Process id -> its command line, from `ps`, on systems without /proc (macOS)."""
    command = ["/bin/ps", "-axww", "-o", "pid=,command="]
    try:  # as in `process_of_ps`
        output = subprocess.run(
            command, capture_output=True, env={"PATH": "/usr/bin:/bin"}, close_fds=False, timeout=5.0, check=False
        )
    except (OSError, subprocess.SubprocessError):
        return {}
    lines = (line.split(None, 1) for line in os.fsdecode(output.stdout).splitlines())
    return {int(words[0]): words[1] for words in lines if len(words) == 2 and words[0].isdecimal()}


_MONTHS = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")


def _process_of_windows(pid: int) -> Process | None:
    """The process from the Windows API, with its start in 100 ns units since 1601. Command lines need Windows 8.1."""
    if sys.platform != "win32":
        return None
    import ctypes
    from ctypes import wintypes

    class UnicodeString(ctypes.Structure):
        _fields_ = [("length", wintypes.USHORT), ("room", wintypes.USHORT), ("text", ctypes.c_void_p)]

    kernel = ctypes.WinDLL("kernel32", use_last_error=True)
    kernel.OpenProcess.restype = wintypes.HANDLE
    opened = kernel.OpenProcess(wintypes.DWORD(0x1000), False, wintypes.DWORD(pid))  # PROCESS_QUERY_LIMITED_INFORMATION
    if not opened:
        return None if ctypes.get_last_error() == 87 else Process(0.0, "")  # ERROR_INVALID_PARAMETER: no such process
    handle = wintypes.HANDLE(opened)
    try:
        code, times = wintypes.DWORD(), [wintypes.FILETIME() for _ in range(4)]
        if kernel.GetExitCodeProcess(handle, ctypes.byref(code)) and code.value != 259:  # STILL_ACTIVE
            return None
        known = kernel.GetProcessTimes(handle, *(ctypes.byref(time) for time in times))
        started = times[0].dwHighDateTime << 32 | times[0].dwLowDateTime if known else 0
        room, needed = ctypes.create_string_buffer(1 << 17), wintypes.ULONG()
        query = ctypes.WinDLL("ntdll").NtQueryInformationProcess  # 60: ProcessCommandLineInformation
        if query(handle, 60, room, wintypes.ULONG(len(room)), ctypes.byref(needed)):
            return Process(float(started), "")
        line = UnicodeString.from_buffer(room)
        text = ctypes.string_at(line.text, line.length).decode("utf-16-le", "replace") if line.text else ""
        return Process(float(started), text.replace('"', ""))
    finally:
        kernel.CloseHandle(handle)


def memory() -> tuple[float, float] | None:
    """(bytes of physical memory, bytes available without swapping); None if the system does not report them.

    macOS does not report available memory, so half of all is returned. Limits of a container are not considered.
    """
    if sys.platform == "win32":

        class Status(ctypes.Structure):
            _fields_ = (
                ("length", ctypes.c_ulong),
                ("load", ctypes.c_ulong),
                ("total", ctypes.c_ulonglong),
                ("free", ctypes.c_ulonglong),
                ("unread", ctypes.c_ulonglong * 5),
            )

        status = Status(length=ctypes.sizeof(Status))
        is_known = ctypes.windll.kernel32.GlobalMemoryStatusEx(ctypes.byref(status))
        return (float(status.total), float(status.free)) if is_known else None
    try:
        total = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (ValueError, OSError):
        return None
    free = 0.5 * total
    with contextlib.suppress(OSError, StopIteration, ValueError, IndexError):
        rows = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        free = 1024.0 * int(next(row for row in rows if row.startswith("MemAvailable:")).split()[1])
    return total, free
