"""How far a shot has come. Plain values."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ...torch_backend import contract


@dataclass
class ShotState:
    """How far a shot has come."""

    folder: Path
    """Shot folder."""
    info: dict[str, Any] = field(default_factory=dict[str, Any])
    """shot.json; empty if there is no shot."""
    frames: int = 0
    """Imported frames, 0 before the import."""
    read_as: list[str] = field(default_factory=list[str])
    """How the footage was read, in sentences; empty for one of an earlier version."""
    beside: str = ""
    """Where the footage lay seen from the shot folder, when it was imported; empty if that is not known."""
    shift: int = 0
    """Number of a frame in the shot minus its number in the footage."""
    timecode: str = ""
    """SMPTE timecode of the first frame; empty if the footage carries none."""
    solve: dict[str, Any] = field(default_factory=dict[str, Any])
    """solve.json; empty before the solve."""
    lacks_motion: bool = False
    """The search for what moves has not ended."""
    runs: dict[str, dict[str, Any]] = field(default_factory=dict[str, dict[str, Any]])
    """Trained runs: name -> summary.json, with `history`, `preview`, `extension`, `anew` (see `checkpoints`) and
    `other_cameras` added."""
    unfinished: dict[str, dict[str, Any]] = field(default_factory=dict[str, dict[str, Any]])
    """Runs that have a checkpoint and no summary, paused or at work: name -> what `checkpoints.paused` tells, with
    `history`, `preview`, `anew` and `other_cameras` added."""
    takes: dict[str, dict[str, Any]] = field(default_factory=dict[str, dict[str, Any]])
    """Frozen takes: name -> take.json, with `frame_count` added."""
    damaged: dict[str, dict[str, str]] = field(default_factory=lambda: {"run": {}, "take": {}})
    """Runs and takes whose files are not what we write: kind -> name -> what is wrong, in a sentence."""

    def listed(self, kind: str) -> list[str]:
        """Names of all runs or takes (`kind` "run" or "take"), damaged ones too, as they are shown."""
        whole = {*self.runs, *self.unfinished} if kind == "run" else {*self.takes}
        return sorted(whole | {*self.damaged[kind]})

    def timecode_at(self, frame: int) -> str:
        """Timecode of a frame of the clip; empty if the footage carries none, or cannot be counted."""
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
