"""What a set-up installed into a virtual environment, and whether it is still there unchanged.

The launcher records it, and looks before each command; Blender looks before it starts the backend. A look reads every
RECORD and asks for the size of libraries and top modules. That takes 10 ms for the backend's 26,000 files; asking for
every size would take 70. A repair compares all contents.
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
"""The launcher's folder in an environment that it makes."""
SETUP_BEGUN = "installing"
"""A file that stands there while packages are written."""
SETUP_STAMP = "installed.json"
"""What the last finished set-up installed."""
LONGEST_RECORD = 1 << 26
"""Bytes of a RECORD that are read; torch's has 1.5 MB."""
_LIBRARY = re.compile(r"\.(so|pyd|dll|dylib)(\.|$)")


def site_packages(environment: Path) -> Path | None:
    """The folder of an environment that its packages lie in; None if there is none."""
    found = [*environment.glob("lib/python3*/site-packages"), *environment.glob("Lib/site-packages")]
    return found[0] if found else None


def package_name(name: str) -> str:
    """A package's name as pip compares it: `PyYAML` and `pyyaml` are one, so are `warp_lang` and `warp-lang`."""
    return re.sub(r"[-_.]+", "-", name).lower()


def record_packages(environment: Path, names: Iterable[str]) -> dict[str, Any]:
    """What is installed of the packages with these names: name of the dist-info -> its RECORD's SHA-256, and the size
    of files by their path in site-packages. OSError or ValueError if a RECORD cannot be read."""
    site, wanted = site_packages(environment), {package_name(n) for n in names}
    facts: dict[str, Any] = {}
    for folder in sorted(site.glob("*.dist-info")) if site else ():
        if package_name(folder.name.partition("-")[0]) in wanted:
            text = _record(folder)
            facts[folder.name] = {"record": hashlib.sha256(text).hexdigest(), "files": _sizes(text)}
    return facts


def changed_packages(environment: Path, recorded: dict[str, Any]) -> list[str]:
    """Names of the packages that are no longer as `record_packages` found them: removed, exchanged, or damaged.

    A file whose size is as before is not read: `pip`'s own RECORD has the hash of each, for a repair.
    """
    site = site_packages(environment)
    return [folder.partition("-")[0] for folder, facts in recorded.items() if not site or _changed(site, folder, facts)]


def changed_since_set_up(environment: Path) -> list[str]:
    """`changed_packages` by an environment's own stamp; empty where that records none."""
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
    """Size by path of libraries and of top modules, of a RECORD's lines `path,sha256=...,size`."""
    sizes: dict[str, int] = {}
    for line in record.decode("utf-8", "replace").splitlines():
        path, _, size = (*line.rsplit(",", 2), "", "")[:3]
        # A path with a comma is quoted: no library or top module has one.
        if size.isdigit() and not path.startswith('"') and (path.count("/") <= 1 or _LIBRARY.search(path)):
            sizes[path] = int(size)
    return sizes
