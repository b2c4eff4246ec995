"""What a task is asked for, as it comes out of its template: read without what makes templates, which loads torch."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..contract import SHOT_SUFFIX, ExitCode, JobError
from ..contract.files import is_json_object

VERSION = 1
"""Of the file that `template` writes a task's request into."""


def read_request(path: str | Path) -> dict[str, Any]:
    """What `template` wrote. JobError if it is none, or from a newer version."""
    try:
        data: Any = json.loads(Path(path).read_text(encoding="utf-8"))
        if not is_json_object(data) or data.get("version") != VERSION:
            raise ValueError("it is not of this version")
    except (OSError, ValueError) as error:
        raise JobError(f"{path} is no request of a farm's template: {error}.", "", ExitCode.USAGE) from error
    return data


def shot_name(root: Path) -> str:
    """Folder of a shot below the output folder."""
    return root.name.removesuffix(SHOT_SUFFIX)
