"""What a repair of an environment looks at: packages that are not whole, and what torch's build needs."""

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
    """Has pip forget packages that are not whole, so that it installs them anew; returns their names.

    pip writes a package's RECORD last: one without is unfinished. The contents of the others are compared with it, and
    it with what the last set-up recorded.

    Args:
        environment: folder of the virtual environment.
        recorded: what `record_packages` found after that set-up.
    """
    site, dropped = site_packages(environment), list[str]()
    for folder in sorted(site.glob("*.dist-info")) if site else ():
        if not _is_whole(folder, recorded.get(folder.name, {}).get("record")):
            shutil.rmtree(folder)
            dropped.append(folder.name.partition("-")[0])
    return dropped


def _is_whole(folder: Path, record: str | None) -> bool:
    """True if every file of a package has the hash that its RECORD names, and RECORD the given one, if one is given."""
    try:
        text = (folder / "RECORD").read_bytes()
        if record is not None and hashlib.sha256(text).hexdigest() != record:
            return False
        for row in csv.reader(text.decode("utf-8").splitlines()):
            # A .pyc that a wheel brings is compiled anew by pip, and by Python.
            if len(row) > 1 and row[1].startswith("sha256=") and not row[0].endswith(".pyc"):
                with open(folder.parent / row[0], "rb") as file:
                    digest = base64.urlsafe_b64encode(hashlib.file_digest(file, "sha256").digest())
                if digest.decode().rstrip("=") != row[1].removeprefix("sha256="):
                    return False
    except (OSError, ValueError, csv.Error):
        return False
    return True


def needs_cuda(environment: Path) -> bool:
    """True if the torch that is installed asks for NVIDIA's libraries, as PyPI's build for Linux does."""
    site = site_packages(environment)
    metadata = "".join(p.read_text(encoding="utf-8") for p in site.glob("torch-*.dist-info/METADATA")) if site else ""
    return re.search(r"^Requires-Dist: (nvidia|cuda|triton)\b", metadata, re.M) is not None
