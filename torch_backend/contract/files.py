"""Reads files that may come from anywhere, without blocking and with limits on their size, and detects links."""

from __future__ import annotations

import contextlib
import json
import os
import re
import stat
import sys
import time
import zipfile
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any, BinaryIO, TypeGuard, TypeVar

from .errors import UnreadableFile, UserError

T = TypeVar("T")

LONGEST_JSON = 1 << 28
"""Largest JSON file that is read, in bytes. The listing of a clip of 100,000 frames takes a tenth."""
SHORT_JSON = 1 << 20
"""Largest JSON file that Blender reads in a timer callback, in bytes: a status, a run's figures."""
LONGEST_PICTURE = 1 << 33
"""Largest picture that is read, in bytes. 16K with twenty 32-bit channels takes 10 GB, but EXRs are compressed."""
LONGEST_ARRAYS = 1 << 32
"""Largest unpacked size of arrays (.npz) that are read, in bytes. 100 million points take 2 GB."""
LONGEST_CHECKPOINT = 1 << 34
"""Largest checkpoint that is read, in bytes. A million Gaussians with the state of their optimiser take 1 GB."""
LONGEST_LINE = 1 << 20
"""Longest line of events.jsonl or metrics.jsonl that is read, in bytes."""


MOST_PIXELS = 1 << 27
"""Largest number of pixels in a user's picture: 16384 x 8192. A PNG of a few kilobytes may announce 100 times more."""


def patiently(act: Callable[[], T], tries: int = 40, pause: float = 0.05, windows: bool = os.name == "nt") -> T:
    """Result of `act`, which is retried while Windows refuses access, by default for two seconds.

    PermissionError if the last try fails.
    """
    while True:
        tries -= 1
        try:
            return act()
        # A reader, a virus scanner or a process that renames another file may hold the file open for a moment.
        except PermissionError:
            if not windows or tries <= 0:
                raise
            time.sleep(pause)


def open_regular(path: str | Path, longest: int | None = None) -> BinaryIO:
    """Opens a regular file (or a link to one) for reading, without blocking.

    FileNotFoundError or another OSError from the system. UnreadableFile, a ValueError, if the path is not a regular
    file, or if it has more than `longest` bytes.
    """
    # A shot folder may come from anywhere: a pipe would block Blender's main thread, a device would fill its memory.
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)

    def opened() -> BinaryIO:
        # The file object owns the handle from the start. With a second owner, an interrupt could close the handle
        # twice, which would look like an error of the disk.
        return open(path, "rb", opener=lambda name, _: os.open(name, flags))

    try:
        source = patiently(opened, 4, 0.01)  # as long as Blender may wait
    except (IsADirectoryError, PermissionError) as error:
        if isinstance(error, PermissionError) and not os.path.isdir(path):  # Windows raises it for a folder
            raise
        raise UnreadableFile(path, "is not a file") from None
    try:
        found = os.fstat(source.fileno())
        if not stat.S_ISREG(found.st_mode):
            raise UnreadableFile(path, "is not a file")
        # A sparse file may be that long without using disk space.
        if longest is not None and found.st_size > longest:
            raise UnreadableFile(path, f"is {found.st_size / 1e9:.1f} GB, too large for this kind of file")
    except BaseException:
        source.close()
        raise
    return source


def png_size(path: str | Path) -> tuple[int, int]:
    """Width and height in the header of a PNG; (0, 0) if the file is not a PNG. OSError or ValueError as
    `open_regular`."""
    with open_regular(path) as source:
        head = source.read(24)
    if len(head) < 24 or head[:8] != b"\x89PNG\r\n\x1a\n":
        return 0, 0
    return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")


def regular_file(path: str | Path, longest: int | None = LONGEST_PICTURE) -> str:
    """`path`, checked by `open_regular` with `longest`, for a library that opens files itself.

    Errors as `open_regular`.
    """
    open_regular(path, longest).close()
    return os.fspath(path)


@contextlib.contextmanager
def open_arrays(path: str | Path) -> Generator[BinaryIO, None, None]:
    """Opens an .npz for NumPy, if its unpacked size is within the limit. ValueError for any fault in the file while it
    is read; OSError or ValueError as `open_regular`."""
    with open_regular(path, LONGEST_ARRAYS) as source:
        try:
            with zipfile.ZipFile(source) as archive:
                packed = archive.infolist()
            if sum(part.file_size for part in packed) > LONGEST_ARRAYS:
                raise UnreadableFile(path, "is too large for this kind of file")
            source.seek(0)
            yield source
        except UnreadableFile:
            raise
        # zipfile, zlib and NumPy raise a dozen exception classes, with messages for programmers.
        except Exception as error:
            raise UserError(f"{path} is damaged: {error}") from error


def read_json(path: str | Path, longest: int = LONGEST_JSON) -> dict[str, Any]:
    """A JSON object from a file of at most `longest` bytes.

    FileNotFoundError if there is no file; ValueError names the file and its fault.
    """
    with open_regular(path) as source:
        is_long = os.fstat(source.fileno()).st_size > longest
        text = b"" if is_long else source.read(longest + 1)  # the file may have grown since
    if is_long or len(text) > longest:
        raise UserError(f"{path} is larger than {longest >> 20} MB, more than any file of Splannequin")
    try:
        # Python would accept NaN and Infinity, which other programs do not read.
        data = json.loads(text, parse_constant=_no_number)
    except (ValueError, RecursionError) as error:  # ValueError: invalid JSON or UTF-8, or too many digits
        raise UserError(f"{path} is not valid JSON: {error}") from error
    if not is_json_object(data):
        raise UserError(f"{path} should hold a JSON object, found {type(data).__name__}")
    return data


def is_json_object(value: object) -> TypeGuard[dict[str, Any]]:
    """True if a value read from JSON is an object: a dictionary with text keys."""
    return isinstance(value, dict)


def _no_number(name: str) -> float:
    raise UserError(f"{name} is not a JSON number")


def read_lines(
    path: str | Path, start: int = 0, longest: int = LONGEST_LINE
) -> Generator[tuple[bytes, int], None, None]:
    """Complete lines of a growing file, from byte `start` on: (line, offset of the next line).

    A line longer than `longest` bytes is skipped as pieces (b"", offset of the next piece). OSError or ValueError as
    `open_regular`.
    """
    with open_regular(path) as source:
        source.seek(start)
        inside = False  # True within a line that is too long
        while line := source.readline(longest):
            start += len(line)
            is_complete = line.endswith(b"\n")
            if not is_complete and len(line) < longest:
                return  # half written: the next call reads it
            yield (line if is_complete and not inside else b""), start
            inside = not is_complete


def printable(text: str, longest: int = 2000) -> str:
    """Text from a file, safe to show or print: at most `longest` characters, with spaces for control characters."""
    return "".join(c if c.isprintable() else " " for c in text[:longest])


def checked_name(name: str, what: str) -> str:
    """`name` if it is safe as a folder name on every system; ValueError otherwise."""
    if not _NAME.fullmatch(name) or name.endswith((".", " ")):
        raise UserError(f"{what} name {name!r} should be 1 to 64 letters, digits, spaces, '.', '_' or '-'")
    if name.partition(".")[0].rstrip().upper() in _DEVICES:
        raise UserError(f"{what} name {name!r} is a reserved device name on Windows: choose another one")
    return name


_NAME = re.compile(r"\w[\w .-]{0,63}")
# Windows also reserves COM and LPT with superscript digits.
_DEVICES = {"CON", "PRN", "AUX", "NUL", *(f"{port}{n}" for port in ("COM", "LPT") for n in "0123456789¹²³")}


def frame_number(stem: str) -> int | None:
    """Frame number in a file name without suffix; None if the name is not a frame number."""
    return int(stem) if _NUMBER.fullmatch(stem) else None


_NUMBER = re.compile(r"-?[0-9]{1,9}")


def is_link(path: Path) -> bool:
    """True for a symbolic link, and on Windows for a junction, whether or not it leads anywhere."""
    try:
        found = os.lstat(path)
    except OSError:
        return False
    return stat.S_ISLNK(found.st_mode) or getattr(found, "st_reparse_tag", 0) == _JUNCTION


def remove_link(path: Path) -> None:
    """Removes a link, but not its target."""
    if sys.platform == "win32" and path.is_dir():
        os.rmdir(path)  # how Windows removes a link to a folder
    else:
        os.unlink(path)


# stat.IO_REPARSE_TAG_MOUNT_POINT, which Python defines on Windows only: tag of a junction, a link to a folder.
_JUNCTION = 0xA0000003


def frame_file(frame: int, suffix: str) -> str:
    """File name of a frame: its number in the clip, six digits (a minus sign for negative ones) and a suffix."""
    return f"{frame:06d}{suffix}"
