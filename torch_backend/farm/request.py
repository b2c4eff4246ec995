"""Reads the request that a task gets from its template. This module is separate from `template`, which loads torch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..contract import SHORT_JSON, SHOT_SUFFIX, ExitCode, JobError, read_json

VERSION = 1
"""Version of the file into which `template` writes a task's request."""


def read_request(path: str | Path) -> dict[str, Any]:
    """The request that `template` wrote. JobError if it is invalid, or of another version."""
    try:
        data = read_json(path, SHORT_JSON)
        if data.get("version") != VERSION:
            raise ValueError("it was written by another version")
    except (OSError, ValueError) as error:
        raise JobError(f"{path} is not a request of a farm template: {error}.", "", ExitCode.USAGE) from error
    return data


def shot_name(root: Path) -> str:
    """Name of a shot's folder in the output folder."""
    return root.name.removesuffix(SHOT_SUFFIX)
