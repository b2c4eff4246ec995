"""Folders that Warp's compilers can open. On Windows, the paths of these folders must be ASCII.

Warp passes paths as UTF-8, but Clang and NVRTC read them in the Windows code page. With a profile such as
`C:\\Users\\Jörg` they can read neither the headers in `warp/native` nor the folder of compiled kernels. No kernel
compiles then, for the processor or for a card. Short (8.3) names do not help, because Warp expands them. Both folders
therefore move to a folder with an ASCII path, in a place where every user may create folders. Files in this folder are
loaded as libraries. This user must therefore own it, and no other user may write to it. Standard library only.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from .contract import ExitCode, JobError, is_link
from .shot import is_disk_full, locked, replace_file

_FOLDER = "Splannequin"
_KERNEL_BYTES = 1 << 20
"""Upper bound of the size of one compiled kernel, in bytes."""


@dataclass(frozen=True)
class CompilerFolders:
    """Folders in which Warp compiles; None keeps Warp's default."""

    kernels: Path | None = None
    """Folder of the compiled kernels."""
    headers: Path | None = None
    """Folder that contains `native`, the folder of Warp's headers."""
    precompiled: bool = True
    """True if Warp may precompile headers, which it does in the temporary folder."""


def compiler_folders(
    package: Path, version: str, environ: Mapping[str, str], kernels: Path, windows: bool = os.name == "nt"
) -> CompilerFolders:
    """Folders for the Warp that is installed in `package`. Copies Warp's headers if they have to move.

    Args:
        package: folder of the package warp.
        version: its version.
        environ: environment variables.
        kernels: where Warp would keep compiled kernels.
        windows: whether paths have to be ASCII.

    JobError if a folder has to move and no suitable place is found.
    """
    if not windows:
        return CompilerFolders()
    moved = [not str(path).isascii() for path in (kernels, package)]
    precompiled = tempfile.gettempdir().isascii()
    if not any(moved):
        return CompilerFolders(precompiled=precompiled)
    root = _writable(environ)
    if root is None:
        where = kernels if moved[0] else package
        raise JobError(
            f"Kernels cannot be compiled: the compiler cannot open {where}, whose name is not plain ASCII.",
            "Set the environment variable PROGRAMDATA or PUBLIC to a writable folder with an ASCII name.",
            ExitCode.ENVIRONMENT,
        )
    return CompilerFolders(
        root / "kernels" if moved[0] else None,
        _copied(package / "native", root / f"warp-{version}") if moved[1] else None,
        precompiled,
    )


def need_room(kernels: Path) -> None:
    """Raises JobError if there is no room for another compiled kernel; OSError if the folder cannot be written."""
    kernels.mkdir(parents=True, exist_ok=True)
    if _room(kernels) < _KERNEL_BYTES:
        raise _no_room(kernels)


def kernel_refusal(kernels: Path, error: Exception) -> JobError | None:
    """Error for a kernel that could not be compiled because of the disk; None if the disk was not the reason.

    Not every compiler says why it could not write, so the free space of the disk is checked.
    """
    if isinstance(error, JobError):
        return None
    full = isinstance(error, OSError) and is_disk_full(error)
    with contextlib.suppress(OSError):  # the free space of the folder cannot be read
        full = full or _room(kernels) < _KERNEL_BYTES
    if full:
        return _no_room(kernels)
    if isinstance(error, OSError) and (error.filename or error.filename2):
        return JobError(
            f"Kernels cannot be compiled in {kernels}: {error.strerror or error}.",
            "Make the folder writable, or name another one in the environment variable WARP_CACHE_PATH.",
            ExitCode.ENVIRONMENT,
        )
    return None


def _no_room(kernels: Path) -> JobError:
    return JobError(
        f"No space left in {kernels}, where kernels are compiled.",
        "Free some space there, or name a folder on another disk in the environment variable WARP_CACHE_PATH.",
        ExitCode.DISK,
    )


def _room(folder: Path) -> int:
    """Bytes that this user may still write."""
    with tempfile.TemporaryFile(dir=folder) as probe:  # disk_usage does not know quotas of users
        try:
            probe.write(bytes(_KERNEL_BYTES))
            probe.flush()
        except OSError as error:
            if is_disk_full(error):
                return 0
            raise
    return shutil.disk_usage(folder).free


def _writable(environ: Mapping[str, str]) -> Path | None:
    """Writable folder with an ASCII path that belongs to this user; None if there is none."""
    user = hashlib.sha256(environ.get("USERPROFILE", environ.get("USERNAME", "")).encode()).hexdigest()[:8]
    for base in _bases(environ):
        # Not inside a folder shared by users: the owner of the shared folder could replace this one.
        folder = base / f"{_FOLDER}-{user}"
        try:
            base.mkdir(parents=True, exist_ok=True)
            if not os.path.lexists(folder):
                make_private(folder)
            if not is_private(folder):
                continue
            tempfile.TemporaryFile(dir=folder).close()
            return folder
        except OSError:
            continue
    return None


if sys.platform == "win32":
    import ctypes
    from ctypes import byref, wintypes

    _advapi = ctypes.WinDLL("advapi32", use_last_error=True)
    _kernel = ctypes.WinDLL("kernel32", use_last_error=True)
    _kernel.GetCurrentProcess.restype = wintypes.HANDLE
    _advapi.EqualSid.argtypes = [ctypes.c_void_p, ctypes.c_void_p]
    _advapi.IsWellKnownSid.argtypes = [ctypes.c_void_p, ctypes.c_int]
    _advapi.OpenProcessToken.argtypes = [wintypes.HANDLE, wintypes.DWORD, ctypes.c_void_p]
    _advapi.GetTokenInformation.argtypes = [
        wintypes.HANDLE, ctypes.c_int, ctypes.c_void_p, wintypes.DWORD, ctypes.c_void_p,
    ]  # fmt: skip
    _kernel.LocalFree.argtypes = [ctypes.c_void_p]
    _kernel.CloseHandle.argtypes = [wintypes.HANDLE]

    class _Attributes(ctypes.Structure):
        _fields_ = (
            ("length", wintypes.DWORD),
            ("descriptor", ctypes.c_void_p),
            ("inherited", wintypes.BOOL),
        )

    def make_private(folder: Path) -> None:
        """Makes a folder that only its owner, administrators and the system may open. OSError if it cannot be made.

        A folder made by `mkdir` inherits the rights of %PROGRAMDATA%, so every user could write files into it.
        """
        descriptor = ctypes.c_void_p()
        rules = "D:P(A;OICI;FA;;;SY)(A;OICI;FA;;;BA)(A;OICI;FA;;;OW)"
        if not _advapi.ConvertStringSecurityDescriptorToSecurityDescriptorW(rules, 1, byref(descriptor), None):
            raise ctypes.WinError(ctypes.get_last_error())
        try:
            attributes = _Attributes(ctypes.sizeof(_Attributes), descriptor, False)
            if not _kernel.CreateDirectoryW(str(folder), byref(attributes)):
                raise ctypes.WinError(ctypes.get_last_error())
        finally:
            _kernel.LocalFree(descriptor)

    def is_private(folder: Path) -> bool:
        """True for a folder (not a link) that belongs to this user or to the administrators."""
        if is_link(folder) or not folder.is_dir():
            return False
        owner, descriptor, token, size = ctypes.c_void_p(), ctypes.c_void_p(), wintypes.HANDLE(), wintypes.DWORD()
        if _advapi.GetNamedSecurityInfoW(str(folder), 1, 1, byref(owner), None, None, None, byref(descriptor)):
            return False
        try:
            if _advapi.IsWellKnownSid(owner, 26):  # administrators can change any folder anyway
                return True
            if not _advapi.OpenProcessToken(_kernel.GetCurrentProcess(), 0x0008, byref(token)):
                return False
            _advapi.GetTokenInformation(token, 1, None, 0, byref(size))
            user = ctypes.create_string_buffer(size.value)
            if not _advapi.GetTokenInformation(token, 1, user, size, byref(size)):
                return False
            # TOKEN_USER begins with a pointer to the user's SID.
            return bool(_advapi.EqualSid(owner, ctypes.cast(user, ctypes.POINTER(ctypes.c_void_p))[0]))
        finally:
            _kernel.LocalFree(descriptor)
            if token:
                _kernel.CloseHandle(token)

else:

    def make_private(folder: Path) -> None:
        """Makes a folder that only its owner may open. OSError if it cannot be made."""
        os.mkdir(folder, 0o700)

    def is_private(folder: Path) -> bool:
        """True for a folder (not a link) that this user owns and that no other user may write to."""
        found = os.lstat(folder)
        return stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid() and not found.st_mode & 0o022


def _bases(environ: Mapping[str, str]) -> Iterator[Path]:
    """Folders with ASCII paths in which all users may write; the first is the usual one."""
    drive = environ.get("SYSTEMDRIVE", "")
    for named in (environ.get("PROGRAMDATA", ""), environ.get("PUBLIC", ""), f"{drive}{os.sep}" if drive else ""):
        if named and named.isascii() and os.path.isabs(named):
            yield Path(named)


def _copied(native: Path, home: Path) -> Path:
    """`home`, after the folder `native` was copied into it. A copy is renamed into place once it is complete."""
    if not (home / "native").is_dir():
        home.mkdir(parents=True, exist_ok=True)
        with locked(home / "copying.lock"):
            if not (home / "native").is_dir():
                partial = home / "native.part"
                shutil.rmtree(partial, ignore_errors=True)
                shutil.copytree(native, partial)
                replace_file(partial, home / "native")
    return home
