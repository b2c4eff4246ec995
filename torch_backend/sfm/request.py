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
    """What the parent asks for, from its JSON."""

    def __init__(self, path: Path) -> None:
        data = json.loads(path.read_text(encoding="utf-8"))
        self.data: dict[str, Any] = data
        """The whole request, as in the file."""
        self.scratch = path.parent
        self.database = self.scratch / "database.db"
        self.images = Path(data["images"])
        self.solved: list[str] = data["solved"]
        self.others: list[str] = data["others"]
        self.order: list[str] = sorted(self.solved + self.others, key=lambda name: int(Path(name).stem))
        self.camera_model: str = data["camera_model"]
        self.overlap: int = data["overlap"]
        self.features: int = data["features"]
        self.neighbours: int = data["neighbours"]
        self.threads: int = data["threads"]
        self.size: list[int] = data.get("size", [0, 0])
        """Pixels of the images, for a lens that is told beforehand."""
        self.focal: float = data.get("focal_px", 0.0)
        """Focal length that the lens is known to have, pixels; 0: not known."""
        self.start_focal: float = self.focal or data.get("start_focal_px", 0.0)
        """Focal length with which the solve begins, pixels: one that may be so; 0: COLMAP's guess."""
        self.hold_focal: bool = bool(self.focal) and bool(data.get("hold_focal"))
        self.hold_bend: bool = data.get("hold_bend", False)
        """The pictures have no lens any more: the model's bend stays at nothing."""
        self.masks = data.get("masks", "")
        """Folder of COLMAP's masks; empty: nothing is masked."""
        self.match: list[str] = data.get("match", [])
        """Pairs "name name" that this worker matches, and does nothing else; empty: it solves."""
        self.known: dict[str, Any] | None = data.get("known")
        self.peak: float = data.get("peak", 0.0)
        """Least contrast of a feature; 0: COLMAP's own."""
        self.wide: bool = data.get("wide", False)
        """Match more frames with each other than the overlap asks for."""
        self.mapper: str = data.get("mapper", "incremental")
        """"incremental" or "global"."""
        self.reuse: bool = data.get("reuse", False)
        """The database has the features and matches of a try before, and maybe frames that are not solved."""


def say(**message: Any) -> None:
    """One line to the parent."""
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
