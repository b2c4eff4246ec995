"""Records what a set-up installed into a virtual environment, and checks whether it is unchanged.

The launcher records it, and checks it before each command. Blender checks it before it starts the backend. A check
reads every RECORD and the sizes of libraries and top-level modules. A repair compares all contents.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from .files import is_json_object, open_regular, read_json

SETUP_NOTES = ".splannequin"
"""Folder of the launcher in an environment that it makes."""
SETUP_BEGUN = "installing"
"""File in that folder while packages are being written."""
SETUP_STAMP = "installed.json"
"""File in that folder: record of the last finished set-up."""
LONGEST_RECORD = 1 << 26
"""Largest RECORD that is read, in bytes. Torch's has 1.5 MB."""
_LIBRARY = re.compile(r"\.(so|pyd|dll|dylib)(\.|$)")


def site_packages(environment: Path) -> Path | None:
    """Folder of an environment's packages; None if there is none."""
    found = [*environment.glob("lib/python3*/site-packages"), *environment.glob("Lib/site-packages")]
    return found[0] if found else None


def package_name(name: str) -> str:
    """A package's name as pip compares it: `PyYAML` equals `pyyaml`, and `warp_lang` equals `warp-lang`."""
    return re.sub(r"[-_.]+", "-", name).lower()


def record_packages(environment: Path, names: Iterable[str]) -> dict[str, Any]:
    """Record of the installed packages among `names`: name of the dist-info -> SHA-256 of its RECORD, and sizes of
    files by their path in site-packages. OSError or ValueError if a RECORD cannot be read."""
    site, packages = site_packages(environment), {package_name(n) for n in names}
    facts: dict[str, Any] = {}
    for folder in sorted(site.glob("*.dist-info")) if site else ():
        if package_name(folder.name.partition("-")[0]) in packages:
            text = _record(folder)
            facts[folder.name] = {"record": hashlib.sha256(text).hexdigest(), "files": _sizes(text)}
    return facts


def changed_packages(environment: Path, recorded: dict[str, Any]) -> list[str]:
    """Names of the packages that were removed, replaced or damaged since `record_packages`.

    Files are compared by size. A repair also compares the hash of each file, which is in its RECORD.
    """
    site = site_packages(environment)
    return [folder.partition("-")[0] for folder, facts in recorded.items() if not site or _changed(site, folder, facts)]


def changed_since_set_up(environment: Path) -> list[str]:
    """`changed_packages` since the set-up of an environment; empty if its stamp records no packages."""
    try:
        recorded = read_json(environment / SETUP_NOTES / SETUP_STAMP).get("packages", {})
    except (OSError, ValueError):
        return []
    return changed_packages(environment, recorded) if is_json_object(recorded) else []


def _changed(site: Path, folder: str, facts: Any) -> bool:
    try:
        if hashlib.sha256(_record(site / folder)).hexdigest() != facts["record"]:
            return True
        return any(os.stat(site / path).st_size != size for path, size in facts["files"].items())
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return True


def _record(folder: Path) -> bytes:
    with open_regular(folder / "RECORD") as source:
        return source.read(LONGEST_RECORD)


def _sizes(record: bytes) -> dict[str, int]:
    """Path -> size of libraries and top-level modules, from a RECORD's lines `path,sha256=...,size`."""
    # Some sizes only: 10 ms a check. All of the backend's 26,000 files would take 70 ms.
    sizes: dict[str, int] = {}
    for line in record.decode("utf-8", "replace").splitlines():
        path, _, size = (*line.rsplit(",", 2), "", "")[:3]
        # A path with a comma is quoted, but no library or top-level module has a comma.
        if size.isdigit() and not path.startswith('"') and (path.count("/") <= 1 or _LIBRARY.search(path)):
            sizes[path] = int(size)
    return sizes
