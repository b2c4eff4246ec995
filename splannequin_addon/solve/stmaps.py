"""ST maps of the solve's lens: the backend writes them beside Blender. No bpy."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..process import backend, children


def begin(shot: Path, width: int = 0) -> children.Question:
    """Has the maps of a solved shot written into its solve folder, without waiting.

    Args:
        shot: shot folder.
        width: of the maps in pixels; 0: the working frames'.

    Raises:
        contract.JobError: there is no backend, or it cannot be started.
    """
    return backend.ask("--json", "stmaps", str(shot.absolute()), "--width", str(width))


def answer(asked: children.Question) -> dict[str, Any]:
    """Where the maps are, their size, and what the lens needs. JobError if they were not written."""
    return dict(json.loads(asked.answer("The ST maps were not written: {}")))


def sentences(facts: dict[str, Any]) -> list[str]:
    """What was written, for people."""
    undistort, redistort = Path(facts["undistort"]), Path(facts["redistort"])
    across, down = facts["overscan_percent"]
    lines = [f"{undistort.name} and {redistort.name} are in {undistort.parent}."]
    if across or down:
        lines.append(
            f"The lens sees {across:.1f} % of the width beyond each side, and {down:.1f} % of the height: "
            "freeze with overscan to have that too."
        )
    return lines
