"""The worker's request and answer, and COLMAP's database in its scratch folder."""

from __future__ import annotations

import json
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pycolmap

from . import colmap_types as colmap

SEED = 0


class Request:
    """The parent's request, read from its JSON file."""

    def __init__(self, path: Path) -> None:
        data = json.loads(path.read_text(encoding="utf-8"))
        self.data: dict[str, Any] = data
        """The complete request as in the file."""
        self.scratch = path.parent
        self.database = self.scratch / "database.db"
        self.images = Path(data["images"])
        self.solved: list[str] = data["solved"]
        self.unsolved: list[str] = data["others"]
        self.order: list[str] = sorted(self.solved + self.unsolved, key=lambda name: int(Path(name).stem))
        self.camera_model: str = data["camera_model"]
        self.overlap: int = data["overlap"]
        self.features: int = data["features"]
        self.neighbours: int = data["neighbours"]
        self.threads: int = data["threads"]
        self.size: list[int] = data.get("size", [0, 0])
        """Width and height of the images in pixels, for an initial lens."""
        self.focal: float = data.get("focal_px", 0.0)
        """Known focal length of the lens in pixels; 0: unknown."""
        self.start_focal: float = self.focal or data.get("start_focal_px", 0.0)
        """Initial focal length in pixels, known or likely; 0: COLMAP's guess."""
        self.hold_focal: bool = bool(self.focal) and bool(data.get("hold_focal"))
        self.hold_bend: bool = data.get("hold_bend", False)
        """The images are already undistorted: the model's distortion is fixed at 0."""
        self.masks = data.get("masks", "")
        """Folder of COLMAP's masks; empty: no masks."""
        self.match: list[str] = data.get("match", [])
        """Pairs "name name". If there are any, this worker only matches them; if empty, it solves."""
        self.known: dict[str, Any] | None = data.get("known")
        self.peak: float = data.get("peak", 0.0)
        """Smallest contrast of a feature; 0: COLMAP's default."""
        self.wide: bool = data.get("wide", False)
        """Match more pairs of frames than `overlap` gives."""
        self.mapper: str = data.get("mapper", "incremental")
        """"incremental" or "global"."""
        self.reuse: bool = data.get("reuse", False)
        """The database holds features and matches of an earlier attempt, possibly of frames outside `solved` too."""


def say(**message: Any) -> None:
    """Sends the parent one line of JSON."""
    sys.stdout.write(json.dumps(message) + "\n")
    sys.stdout.flush()


@contextmanager
def closing_database(request: Request) -> Generator[pycolmap.Database]:
    """COLMAP's database, closed afterwards."""
    database = colmap.open_database(request.database)
    try:
        yield database
    finally:
        database.close()
