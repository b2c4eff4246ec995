"""Checks for the repair of an environment: damaged packages, and CUDA libraries that torch needs."""

from __future__ import annotations

import base64
import csv
import hashlib
import re
import shutil
from pathlib import Path
from typing import Any

from torch_backend.contract import site_packages


def drop_damaged(environment: Path, recorded: dict[str, Any]) -> list[str]:
    """Removes the metadata of damaged packages, so that pip installs them again; returns their names.

    pip writes a package's RECORD last, so a package without RECORD is unfinished. Else the files are compared with
    RECORD, and RECORD with the hash from the last set-up.

    Args:
        environment: folder of the virtual environment.
        recorded: result of `record_packages` after the last set-up.
    """
    site, dropped = site_packages(environment), list[str]()
    for folder in sorted(site.glob("*.dist-info")) if site else ():
        if not _is_whole(folder, recorded.get(folder.name, {}).get("record")):
            shutil.rmtree(folder)
            dropped.append(folder.name.partition("-")[0])
    return dropped


def _is_whole(folder: Path, record: str | None) -> bool:
    """True if RECORD has the hash `record` (if not None), and every file of the package the hash in RECORD."""
    try:
        text = (folder / "RECORD").read_bytes()
        if record is not None and hashlib.sha256(text).hexdigest() != record:
            return False
        for row in csv.reader(text.decode("utf-8").splitlines()):
            # pip and Python recompile the .pyc files of a wheel.
            if len(row) > 1 and row[1].startswith("sha256=") and not row[0].endswith(".pyc"):
                with open(folder.parent / row[0], "rb") as file:
                    digest = base64.urlsafe_b64encode(hashlib.file_digest(file, "sha256").digest())
                if digest.decode().rstrip("=") != row[1].removeprefix("sha256="):
                    return False
    except (OSError, ValueError, csv.Error):
        return False
    return True


def needs_cuda(environment: Path) -> bool:
    """True if the installed torch requires NVIDIA's libraries, as PyPI's build for Linux does."""
    site = site_packages(environment)
    metadata = "".join(p.read_text(encoding="utf-8") for p in site.glob("torch-*.dist-info/METADATA")) if site else ""
    return re.search(r"^Requires-Dist: (nvidia|cuda|triton)\b", metadata, re.M) is not None
