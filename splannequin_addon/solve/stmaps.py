"""ST maps of the solve's lens, written by the backend. No bpy."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..process import backend, children


def begin(shot: Path, width: int = 0) -> children.Question:
    """Makes the backend write the maps of a solved shot into its solve folder, without waiting.

    Args:
        shot: shot folder.
        width: width of the maps in pixels; 0: the working frames' width.

    Raises:
        contract.JobError: there is no backend, or it cannot be started.
    """
    return backend.ask("--json", "stmaps", str(shot.absolute()), "--width", str(width))


def answer(question: children.Question) -> dict[str, Any]:
    """Paths and size of the maps, and the overscan that the lens needs. Raises JobError if they were not written."""
    return dict(json.loads(question.answer("The ST maps were not written: {}")))


def sentences(facts: dict[str, Any]) -> list[str]:
    """Sentences about the written maps."""
    undistort, redistort = Path(facts["undistort"]), Path(facts["redistort"])
    across, down = facts["overscan_percent"]
    lines = [f"{undistort.name} and {redistort.name} are in {undistort.parent}."]
    if across or down:
        lines.append(
            f"The lens sees {across:.1f} % of the width and {down:.1f} % of the height beyond each side. Freeze "
            "with overscan to include this area."
        )
    return lines
