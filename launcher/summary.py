"""Reads DIR/summary.json of a command, and the status of the jobs in DIR."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torch_backend.contract import JOBS_FOLDER, SHOT_SUFFIX, STATUS_FILE, read_json


def read_summary(output: Path) -> dict[str, Any]:
    """Contents of DIR/summary.json; {} if it is missing or unreadable."""
    try:
        return read_json(output / "summary.json")
    except (OSError, ValueError):
        return {}


def failed_job(output: Path) -> str:
    """Error message of the newest job of the shots in `output` if that job failed; else empty."""
    try:
        found = output.glob(f"*{SHOT_SUFFIX}/{JOBS_FOLDER}/*/{STATUS_FILE}")
        statuses = sorted(found, key=lambda path: path.stat().st_mtime)
        status = read_json(statuses[-1]) if statuses else {}
    except (OSError, ValueError):
        return ""
    words = (status.get("message", ""), status.get("hint", ""))
    return " ".join(filter(None, map(str, words))) if status.get("state") == "failed" else ""
