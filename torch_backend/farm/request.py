"""What a task is asked for, as it comes out of its template: read without what makes templates, which loads torch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..contract import SHORT_JSON, SHOT_SUFFIX, ExitCode, JobError, read_json

VERSION = 1
"""Of the file that `template` writes a task's request into."""


def read_request(path: str | Path) -> dict[str, Any]:
    """What `template` wrote. JobError if it is invalid, or from a newer version."""
    try:
        data = read_json(path, SHORT_JSON)
        if data.get("version") != VERSION:
            raise ValueError("it is not of this version")
    except (OSError, ValueError) as error:
        raise JobError(f"{path} is no request of a farm's template: {error}.", "", ExitCode.USAGE) from error
    return data


def shot_name(root: Path) -> str:
    """Folder of a shot below the output folder."""
    return root.name.removesuffix(SHOT_SUFFIX)
