"""The command `package`: builds the extension's zip, a repository folder for it, checksums and an SBOM.

A package is a folder `splannequin-VERSION`, written completely or not at all, ready for any web server:

    splannequin-VERSION.zip   the extension, built and validated by Blender
    index.json, index.html    Blender's listing of the folder, which makes it an extension repository
    sbom.cdx.json             bill of materials of a set-up's downloads (`sbom`)
    SHA256SUMS                SHA-256 of each file

Nothing in it is signed with a key.
"""

from __future__ import annotations

import datetime
import hashlib
import json
import os
import shutil
import subprocess
import time
import tomllib
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from torch_backend.contract import ExitCode, program, replacing_folder
from torch_backend.shot import locked, write_json

from .blender import BPY_WHEELS, Blender, get_blender, named_blender
from .children import run_child, say
from .environments import TORCH_LOCKS
from .errors import LauncherError
from .places import ROOT, WINDOWS
from .sbom import bill_of_materials

LOCKS = ("backend", *TORCH_LOCKS, *(f"bpy-{series}" for series in sorted(BPY_WHEELS)))
"""Locks of a user's set-up. Locks of tests and benchmarks are not in the zip."""
SUMS = "SHA256SUMS"
SBOM = "sbom.cdx.json"
_LISTING = ("index.json", "index.html")
_FILE_MODE = 0o100644 << 16
"""Attributes of every file in the zip: a regular file, readable by all. Attributes on disk depend on the umask."""


@dataclass(frozen=True)
class Source:
    """The files that a package is built from."""

    folder: Path
    """A copy of the files that Git tracks, or would add."""
    commit: str
    """Hash of the commit that is checked out."""
    time: datetime.datetime
    """Time of that commit, in UTC."""
    changed: int
    """Number of files that differ from the commit."""


def package(blenders: Sequence[str], output: Path) -> int:
    """Builds the package of the checked-out tree; returns an exit code.

    Args:
        blenders: paths of Blenders. The first builds, all of them validate. Empty: the Blender of `get_blender`.
        output: folder for the package, blender.log and summary.json.

    Raises:
        LauncherError: the package could not be built; an older one of the same version is unchanged.
    """
    started = time.monotonic()
    chosen = [named_blender(path) for path in blenders] or [get_blender()[0]]
    work = output / ".work"
    with locked(output / ".package.lock", lambda: say("another `package` is running in this folder; waiting for it")):
        shutil.rmtree(work, ignore_errors=True)  # left by a killed run
        try:
            source = copy_source(work / "source")
            product = read_manifest(source.folder / "blender_manifest.toml")
            name = f"{product['id']}-{product['version']}"
            target = output / (f"{name}-uncommitted" if source.changed else name)
            with replacing_folder(target) as fresh:
                digest = _fill(fresh, name, product, source, chosen, output / "blender.log")
                flush(fresh)
            flush(output)
        finally:
            shutil.rmtree(work, ignore_errors=True)
    _report(target, name, digest, source, chosen, output, time.monotonic() - started)
    return ExitCode.OK


def copy_source(folder: Path) -> Source:
    """Copies the files of the checkout that Git tracks or would add; other files must not get into a zip.

    Raises LauncherError if the launcher is not in a Git checkout, or Git fails.
    """
    if program("git") is None:
        raise LauncherError("A package is built from a Git checkout, and there is no `git` on the PATH: install it.")
    if not (ROOT / ".git").exists():
        raise LauncherError(f"A package is built from a Git checkout, and {ROOT} is not one: clone the repository.")
    commit, seconds = _git("log", "-1", "--format=%H %ct").decode().split()
    # The option is explicit because a user's settings may leave untracked files out of the status.
    status = _git("status", "--porcelain", "-z", "--no-renames", "--untracked-files=all")
    changed = [line for line in status.split(b"\0") if line]
    names = _git("ls-files", "-z", "--cached", "--others", "--exclude-standard").split(b"\0")
    for name in filter(None, map(os.fsdecode, names)):
        path = ROOT / name
        if path.is_file() and not path.is_symlink():  # Blender does not pack links
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(path.read_bytes())
    return Source(folder, commit, datetime.datetime.fromtimestamp(int(seconds), datetime.UTC), len(changed))


def _git(*words: str) -> bytes:
    # --no-optional-locks keeps `git status` from writing into the checkout.
    command = [program("git") or "git", "--no-optional-locks", "-C", str(ROOT), *words]
    done = subprocess.run(command, capture_output=True)
    if done.returncode:
        reasons = done.stderr.decode("utf-8", "replace").strip().splitlines() or ["it printed nothing"]
        raise LauncherError(f"Git cannot read {ROOT}: {reasons[0].removeprefix('fatal: ').rstrip('.')}.")
    return done.stdout


def _fill(
    fresh: Path, name: str, product: dict[str, str], source: Source, blenders: Sequence[Blender], log: Path
) -> str:
    """Writes every file of a package into an empty folder and checks it; returns the SHA-256 of the zip."""
    archive, built = fresh / f"{name}.zip", source.folder.parent / "built.zip"
    tool = _Tool(source.folder.parent / "user", log)
    tool.run(blenders[0], built, "build", "--source-dir", str(source.folder), "--output-filepath", str(built))
    repack(built, archive, source.time)
    for blender in blenders:
        tool.run(blender, archive, "validate", str(archive))
    tool.run(blenders[0], fresh / _LISTING[0], "server-generate", "--repo-dir", str(fresh), "--html")
    digest = sha256(archive)
    check_listing(fresh, archive.name, digest)
    when = source.time.strftime("%Y-%m-%dT%H:%M:%SZ")
    bill = bill_of_materials(source.folder / "requirements", LOCKS, product, digest, when)
    write_json(fresh / SBOM, bill)
    names = (archive.name, *_LISTING, SBOM)
    sums = "".join(f"{sha256(fresh / one)}  {one}\n" for one in sorted(names))
    (fresh / SUMS).write_text(sums, encoding="utf-8", newline="\n")
    found = {path.name for path in fresh.iterdir()}
    if found != {*names, SUMS}:
        raise LauncherError(f"Blender left files in {fresh} that were not expected: {', '.join(sorted(found))}.")
    return digest


def read_manifest(path: Path) -> dict[str, str]:
    """id, version, name and licence (SPDX) of the extension. Raises LauncherError if its manifest is damaged."""
    try:
        manifest = tomllib.loads(path.read_text(encoding="utf-8"))
        product = {key: str(manifest[key]) for key in ("id", "version", "name")}
        product["licence"] = str(manifest["license"][0]).removeprefix("SPDX:")
    except (OSError, ValueError, KeyError, IndexError, TypeError) as error:
        raise LauncherError(f"{ROOT / path.name} cannot be read ({error!r}): correct it, and start again.") from error
    return product


class _Tool:
    """Blender's tool for extensions, run with empty user folders, so that the user's Blender is not changed."""

    def __init__(self, user: Path, log: Path) -> None:
        self.user = user
        self.log = log
        log.write_bytes(b"")

    def run(self, blender: Blender, result: Path, *arguments: str) -> None:
        """Runs one command of the tool. Raises LauncherError if it fails or does not write the file `result`."""
        begin = self.log.stat().st_size
        with open(self.log, "ab") as log:
            command = blender.extension_tool(*arguments)
            code = run_child(command, cwd=ROOT, log=log, BLENDER_USER_RESOURCES=str(self.user))
        if code == 0 and result.is_file():
            return
        with open(self.log, "rb") as log:
            log.seek(begin)
            lines = [line.strip() for line in log.read().decode("utf-8", "replace").splitlines() if line.strip()]
        errors = [line for line in lines if "error" in line.lower()] or lines or ["it printed nothing"]
        reason = errors[-1].removeprefix("FATAL_ERROR: ").removeprefix("Error: ").rstrip(".")
        full = any("No space left" in line for line in lines)
        raise LauncherError(
            f"{blender.label} cannot {arguments[0]} the extension: {reason}; its whole output is in {self.log}.",
            ExitCode.DISK if full else ExitCode.ENVIRONMENT,
        )


def repack(built: Path, target: Path, when: datetime.datetime) -> None:
    """Rewrites Blender's zip with its files in order of name, with one time and one set of attributes.

    Blender packs files in the order in which the disk lists them, with the time and attributes of each. The new zip has
    the same bytes for the same commit, if the launcher's Python has the same zlib.

    Args:
        built: the zip that Blender built.
        target: the zip to write.
        when: time of all files in the zip.

    Raises:
        LauncherError: Blender's zip, or the new one, is damaged.
    """
    try:
        _write_sorted(built, target, when)
        with zipfile.ZipFile(target) as packed:
            damaged = packed.testzip()
    except (zipfile.BadZipFile, zlib.error, EOFError) as error:
        raise LauncherError(f"Blender's zip {built} is damaged ({error}): start again.") from error
    if damaged is not None:
        raise LauncherError(f"{target} is damaged after it was written ({damaged}): check the disk, and start again.")


def _write_sorted(built: Path, target: Path, when: datetime.datetime) -> None:
    with zipfile.ZipFile(built) as source, zipfile.ZipFile(target, "w", compresslevel=9) as packed:
        for name in sorted(source.namelist()):
            info = zipfile.ZipInfo(name, when.timetuple()[:6])
            info.compress_type, info.external_attr, info.create_system = zipfile.ZIP_DEFLATED, _FILE_MODE, 3
            packed.writestr(info, source.read(name))


def check_listing(folder: Path, archive: str, digest: str) -> None:
    """Raises LauncherError unless index.json lists only the zip, with its size and SHA-256."""
    try:
        listed = json.loads((folder / "index.json").read_text(encoding="utf-8"))["data"]
        facts = [(one["archive_url"], one["archive_size"], one["archive_hash"]) for one in listed]
    except (ValueError, KeyError, TypeError) as error:
        raise LauncherError(f"Blender's listing {folder / 'index.json'} cannot be read: {error!r}.") from error
    expected = (f"./{archive}", (folder / archive).stat().st_size, f"sha256:{digest}")
    if facts != [expected]:
        raise LauncherError(f"Blender's listing {folder / 'index.json'} does not describe {archive}: {facts}.")


def sha256(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def flush(folder: Path) -> None:
    """Flushes a folder to disk: its files and its directory entries."""
    for path in folder.iterdir():
        if path.is_file():
            with open(path, "rb+") as file:
                os.fsync(file.fileno())
    if not WINDOWS:  # Windows cannot open a folder
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _report(
    target: Path, name: str, digest: str, source: Source, blenders: Sequence[Blender], output: Path, seconds: float
) -> None:
    """Writes summary.json and prints the last lines."""
    archive, labels = target / f"{name}.zip", [blender.label for blender in blenders]
    summary = {
        "command": "package",
        "exit_code": 0,
        "package": str(target),
        "zip": str(archive),
        "sha256": digest,
        "commit": source.commit,
        "changed_files": source.changed,
        "blender": labels,
        "wall_seconds": round(seconds, 2),
    }
    write_json(output / "summary.json", summary)
    say(f"Package:    {target}")
    say(f"Extension:  {archive.name}, {archive.stat().st_size / 1e6:.1f} MB, SHA-256 {digest}")
    say(f"Built by {labels[0]} from commit {source.commit[:12]}; valid for {', '.join(labels)}.")
    if source.changed:
        say(f"This is not a release: {source.changed} files differ from the commit. Commit them and start again.")
    say(f"Nothing is signed with a key: {SUMS} shows whether a file is damaged, not who made it.")
