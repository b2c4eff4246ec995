"""Processes: how a child is started, when it ends with its starter, and which one lives."""

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
    """`args` and `cwd` of the `Popen` that runs a module of ours; paths in `words` should be absolute.

    Python takes modules from the folder that it stands in, and a shot folder may come from anywhere: -P says no. The
    child stands beside its interpreter, where nobody puts files for it: a loader of libraries still looks there
    (Windows always, Linux with an empty entry in LD_LIBRARY_PATH). It is neither the shot's folder nor the extension's:
    Windows keeps the folder that a process stands in from being moved or removed.
    """
    python = os.path.abspath(python)
    return {"args": [python, "-P", "-m", module, *words], "cwd": os.path.dirname(python)}


def child_environment(root: Path) -> dict[str, str]:
    """Environment for a child of `python_child` that has to import our package from the folder `root`."""
    # An empty or relative entry would be the folder that the child stands in.
    inherited = [p for p in os.environ.get("PYTHONPATH", "").split(os.pathsep) if os.path.isabs(p)]
    # Threads that spin while they wait take the core from whoever shares it.
    environment = {"OMP_WAIT_POLICY": "passive"} | os.environ
    return environment | {"PYTHONSAFEPATH": "1", "PYTHONPATH": os.pathsep.join([str(root), *inherited])}


def own_input() -> int:
    """A handle of the standard input for us alone, to be read from by a thread; in its old place is nothing.

    Whoever as much as looks at a pipe that somebody reads from waits on Windows until something comes: a child that
    inherits it as it starts, and a library as it is loaded.
    """
    standard_input = os.dup(0)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    return standard_input


def end_with_starter(grace_seconds: float = GRACE_SECONDS) -> None:
    """Stops this process, as Ctrl-C does, once its standard input closes: its starter holds that open, however it ends.

    A checkpoint may take `grace_seconds`; then the process ends at once, with the group that it leads (POSIX).
    """
    watch = functools.partial(_stop_when_alone, own_input(), grace_seconds)
    threading.Thread(target=watch, name="end with starter", daemon=True).start()


def _stop_when_alone(starter: int, grace_seconds: float) -> None:
    with contextlib.suppress(OSError):
        while os.read(starter, 1):
            pass
    if sys.platform == "win32":
        _thread.interrupt_main()
    else:  # a signal of its own also ends a wait of the main thread
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
    time.sleep(grace_seconds)
    if sys.platform != "win32" and os.getpgrp() == os.getpid():
        os.killpg(0, signal.SIGKILL)
    os._exit(ExitCode.CANCELLED)


def program(name: str) -> str | None:
    """Absolute path of a program on the PATH; None if there is none, or if the folder we stand in has one to offer.

    `shutil.which` looks into that folder first on Windows, and it may be one that came with a .blend or a clip.
    """
    found = shutil.which(name)
    return found if found and os.path.isabs(found) else None


@functools.cache
def computer_name() -> str:
    """This computer as files name it: its name, and in brackets what tells it from another one of the same name.

    On Linux that is a hash of the machine's id and, in a container, of its process ids' namespace; on Windows of the
    machine's GUID; elsewhere there is none. A Mac is named as its owner has it: what `gethostname` says there comes
    from the network, another one at home than in the studio.
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
    """A Mac's own name on local networks; empty elsewhere, or if the system does not tell."""
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
    """What the system says of a living process."""

    started: float
    """When it started, in the system's own unit: only to be compared with another answer. 0 if it does not tell."""
    command: str
    """Its command line, arguments separated by spaces; empty if the system does not tell."""


def process(pid: object) -> Process | None:
    """A living process of this computer; None if there is none of that id, which may be anything that a file says.

    Standard library, on all three systems.
    """
    if not (isinstance(pid, int) and 0 < pid < 1 << 31):
        return None
    if sys.platform == "win32":
        return _process_of_windows(pid)
    try:
        os.kill(pid, 0)  # asks only: no signal is sent
    except ProcessLookupError:
        return None
    except OSError:
        pass  # somebody else's, but there
    return _process_of_proc(pid) if Path("/proc/self/stat").exists() else process_of_ps(pid)


def process_start(pid: int) -> float:
    """`Process.started` of a process; 0 if there is none or the system does not tell."""
    found = process(pid)
    return found.started if found is not None else 0.0


def runs_still(pid: int, started: float) -> bool:
    """True if a process of this computer lives that has this id and start; one that is only stopped does.

    Where the system tells no start, a process of this id is taken for it: a job is not declared dead on a guess.
    """
    found = process(pid)
    return found is not None and (not found.started or not started or found.started == started)


def _process_of_proc(pid: int) -> Process | None:
    """From /proc. Start in clock ticks since boot."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
        fields = text.rpartition(")")[2].split()
        if fields[0] in ("Z", "X"):
            return None  # it has ended: only its exit code is kept for its parent
        words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
        return Process(float(fields[19]), " ".join(os.fsdecode(word) for word in words).rstrip(" "))
    except (OSError, ValueError, IndexError):
        return Process(0.0, "")  # hidden from us, or ending just now


def process_of_ps(pid: int) -> Process | None:
    """From `ps`, on systems without /proc (macOS). Start in seconds since the epoch, whole ones."""
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
    """Ids of this computer's processes whose program lies in a folder, as far as the system tells: their command lines
    begin with its whole path, as those of our children do.

    None on Windows, which itself refuses to move a folder of which a program runs.
    """
    if sys.platform == "win32":
        return []
    starts = tuple({f"{folder.absolute()}{os.sep}", f"{os.path.realpath(folder)}{os.sep}"})
    known = _commands_of_proc() if Path("/proc/self/cmdline").exists() else commands_of_ps()
    return sorted(pid for pid, command in known.items() if command.startswith(starts))


def _commands_of_proc() -> dict[int, str]:
    """Process id -> its program; what is not ours to read is left out."""
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
    """From the Windows API. Start in units of 100 ns since 1601; the command line since Windows 8.1."""
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
    """(bytes of physical memory, bytes available without swapping); None where the system does not say.

    macOS does not say how much is available: half of all is returned. Limits of a container are not considered.
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
