"""The bill of materials of a release as CycloneDX JSON: packages of a set-up, from requirements/*.lock."""

from __future__ import annotations

import re
import tomllib
import urllib.parse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch_backend.contract import package_name

from .errors import LauncherError

LICENCES = "licences.toml"
"""File in requirements/ that maps packages to SPDX expressions."""
_PACKAGE = re.compile(r"(?P<name>[A-Za-z0-9][\w.-]*)==(?P<version>[^\s;\\]+)( ; (?P<marker>[^\\]+?))?( \\)?")
_HASH = re.compile(r"    --hash=sha256:(?P<digest>[0-9a-f]{64})( \\)?")


@dataclass(frozen=True)
class Package:
    """A package at one version, pinned by a lock."""

    name: str
    """Normalised name."""
    version: str
    """Version, including torch's build ("2.13.0+cpu")."""
    marker: str
    """PEP 508 marker of the systems and Pythons on which it is installed; empty for all."""
    hashes: tuple[str, ...]
    """SHA-256 of each wheel that a set-up may download."""


def read_lock(path: Path) -> list[Package]:
    """Packages of a lock file.

    Args:
        path: a file that tools/lock_requirements.py wrote.

    Raises:
        LauncherError: the file is missing or damaged.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise LauncherError(f"{path} cannot be read ({error}): get it back with `git checkout`.") from error
    packages: list[Package] = []
    for number, line in enumerate(lines, 1):
        pin, digest = _PACKAGE.fullmatch(line), _HASH.fullmatch(line)
        if pin:
            name = package_name(pin["name"])
            packages.append(Package(name, pin["version"], pin["marker"] or "", ()))
        elif digest and packages:
            last = packages[-1]
            packages[-1] = Package(last.name, last.version, last.marker, (*last.hashes, digest["digest"]))
        elif not line.startswith("#"):
            raise _damaged(path, f"line {number} is neither a package nor a hash")
        # After a backslash a hash must follow; in a truncated file it is missing.
        if line.endswith("\\") and (number == len(lines) or not _HASH.fullmatch(lines[number])):
            raise _damaged(path, f"a hash is missing after line {number}")
    without = [one.name for one in packages if not one.hashes]
    if without or not packages:
        raise _damaged(path, f"{without[0]} has no hash" if without else "it names no package")
    return packages


def _damaged(path: Path, why: str) -> LauncherError:
    return LauncherError(f"{path} is damaged: {why}. Get it back with `git checkout`, or write the locks again.")


def bill_of_materials(
    requirements: Path, locks: Sequence[str], product: dict[str, str], digest: str, time: str
) -> dict[str, Any]:
    """A CycloneDX 1.6 document of the extension and each package that a set-up may download.

    The same input gives the same document: it has no serial number, and its time is the commit's.

    Args:
        requirements: folder with the locks and the table of licences.
        locks: names of the locks, without suffix.
        product: id, version, name and licence (SPDX) of the extension.
        digest: SHA-256 of the extension's zip.
        time: time of the commit, ISO 8601 in UTC.

    Raises:
        LauncherError: a lock is damaged, or a package has no licence in the table.
    """
    licences = _licences(requirements / LICENCES)
    listed: dict[tuple[str, str], tuple[Package, list[str]]] = {}
    for lock in locks:
        for package in read_lock(requirements / f"{lock}.lock"):
            known, names = listed.setdefault((package.name, package.version), (package, []))
            hashes = tuple(sorted({*known.hashes, *package.hashes}))
            names.append(lock)
            merged = Package(known.name, known.version, known.marker, hashes)
            listed[package.name, package.version] = (merged, names)
    missing = sorted({name for name, _ in listed} - licences.keys())
    if missing:
        raise LauncherError(f"{requirements / LICENCES} has no licence for {', '.join(missing)}: add a line for each.")
    return {
        "$schema": "http://cyclonedx.org/schema/bom-1.6.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {
            "timestamp": time,
            "component": {
                "type": "application",
                "bom-ref": product["id"],
                "name": product["name"],
                "version": product["version"],
                "hashes": [{"alg": "SHA-256", "content": digest}],
                "licenses": [{"expression": product["licence"]}],
            },
        },
        "components": [_component(*listed[key], licences[key[0]]) for key in sorted(listed)],
    }


def _licences(path: Path) -> dict[str, str]:
    """Maps each package to its SPDX expression. Raises LauncherError if the file cannot be read."""
    try:
        return {package_name(name): str(text) for name, text in tomllib.loads(path.read_text(encoding="utf-8")).items()}
    except (OSError, ValueError) as error:
        raise LauncherError(f"{path} cannot be read ({error}): get it back with `git checkout`.") from error


def _component(package: Package, locks: Sequence[str], licence: str) -> dict[str, Any]:
    """CycloneDX component of a package. Wheels differ by system, so hashes are attached to its distributions."""
    purl = f"pkg:pypi/{package.name}@{urllib.parse.quote(package.version)}"
    public = package.version.partition("+")[0]
    properties = [{"name": "splannequin:lock", "value": lock} for lock in locks]
    properties += [{"name": "splannequin:marker", "value": package.marker}] if package.marker else []
    return {
        "type": "library",
        "bom-ref": purl,
        "name": package.name,
        "version": package.version,
        "licenses": [{"expression": licence}],
        "purl": purl,
        "externalReferences": [
            {
                "type": "distribution",
                "url": f"https://pypi.org/project/{package.name}/{public}/"
                if public == package.version
                else f"https://download.pytorch.org/whl/{package.version.partition('+')[2]}/{package.name}/",
                "hashes": [{"alg": "SHA-256", "content": one} for one in package.hashes],
            }
        ],
        "properties": properties,
    }
