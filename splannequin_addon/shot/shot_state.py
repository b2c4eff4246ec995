"""The progress of a shot as plain values."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ...torch_backend import contract


@dataclass
class ShotState:
    """The progress of a shot."""

    folder: Path
    """Shot folder."""
    info: dict[str, Any] = field(default_factory=dict[str, Any])
    """shot.json; empty if there is no shot."""
    frames: int = 0
    """Number of imported frames, 0 before the import."""
    read_as: list[str] = field(default_factory=list[str])
    """Sentences about how the footage was read; empty for a shot of an earlier version."""
    relative_source: str = ""
    """Path of the footage relative to the shot folder at the time of the import; empty if unknown."""
    shift: int = 0
    """Frame number in the shot minus frame number in the footage."""
    timecode: str = ""
    """SMPTE timecode of the first frame; empty if the footage has none."""
    solve: dict[str, Any] = field(default_factory=dict[str, Any])
    """solve.json; empty before the solve."""
    lacks_motion: bool = False
    """True if the search for motion has not ended."""
    runs: dict[str, dict[str, Any]] = field(default_factory=dict[str, dict[str, Any]])
    """Trained runs: name -> summary.json, with added `history`, `preview`, `extension`, `anew` (see `checkpoints`),
    `depth_source` and `has_new_cameras`."""
    unfinished: dict[str, dict[str, Any]] = field(default_factory=dict[str, dict[str, Any]])
    """Paused or running runs with a checkpoint and no summary: name -> `checkpoints.paused`, with added `history`,
    `preview`, `anew` and `has_new_cameras`."""
    takes: dict[str, dict[str, Any]] = field(default_factory=dict[str, dict[str, Any]])
    """Frozen takes: name -> take.json, with added `frame_count` and `mattes`."""
    damaged: dict[str, dict[str, str]] = field(default_factory=lambda: {"run": {}, "take": {}})
    """Runs and takes with damaged files: kind -> name -> sentence about the fault."""

    def listed(self, kind: str) -> list[str]:
        """Names of all runs or takes (`kind` "run" or "take"), including damaged ones, in display order."""
        whole = {*self.runs, *self.unfinished} if kind == "run" else {*self.takes}
        return sorted(whole | {*self.damaged[kind]})

    def timecode_at(self, frame: int) -> str:
        """Timecode of a frame of the clip; empty if the footage has none, or if the frame rate is below 1."""
        fps = float(self.info.get("fps", 0.0))
        counts = bool(self.timecode) and round(fps) >= 1
        return contract.later(self.timecode, frame - self.frame_range[0], fps) if counts else ""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the working frames in pixels, (0, 0) before the import."""
        return int(self.info.get("width", 0)), int(self.info.get("height", 0))

    @property
    def frame_range(self) -> tuple[int, int]:
        """First and last frame number of the clip's range."""
        return int(self.info.get("first", 0)), int(self.info.get("last", 0))
