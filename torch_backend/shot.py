"""The shot as the backend uses it: adds the content of shot.json to the paths of `contract.ShotFolder`."""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .contract import (
    SHOT_SUFFIX,
    UNPUBLISHED_FILE,
    MissingError,
    ShotFolder,
    atomic_path,
    check_version,
    checked_name,
    content_key,
    disk_error,
    from_dict,
    is_disk_full,
    locked,
    make_folder,
    need_disk,
    path_error,
    read_json,
    refuse_foreign,
    remove_file,
    replace_file,
    replacing_folder,
    restore_folder,
    try_lock,
    working_on,
    write_atomic,
    write_json,
)
from .replaced import keep_replaced
from .replacing import settle_solve

__all__ = [
    "SHOT_SUFFIX", "Shot", "ShotInfo", "atomic_path", "checked_name", "content_key", "disk_error", "is_disk_full",
    "locked", "make_folder", "need_disk", "path_error", "remove_file", "replace_file", "replacing_folder",
    "restore_folder", "try_lock", "working_on", "write_atomic", "write_json",
]  # fmt: skip
"""Includes the functions of `contract` with which stations write into a shot."""

SHOT_VERSION = 1
IMPORTED = ("source", "first", "last", "step", "fps", "width", "height", "colour")
"""Fields of shot.json that an import sets."""


@dataclass
class ShotInfo:
    """Content of shot.json."""

    name: str
    """What the artist calls the shot."""
    source: str = ""
    """Absolute path of the footage that was imported, as the user entered it."""
    first: int = 0
    """First frame number of the range, 0 before import."""
    last: int = 0
    """Last frame number of the range, inclusive."""
    step: int = 1
    """Stride between the frames that are solved and trained on."""
    fps: float = 0.0
    """Frames per second of the source."""
    width: int = 0
    """Width in pixels of the working frames."""
    height: int = 0
    """Height in pixels of the working frames."""
    colour: str = "srgb"
    """`linear` if the source is scene-linear, else `srgb`. Working frames are always display-referred sRGB."""
    t_star: int | None = None
    """Frame number at which time stands still; None until chosen."""
    created: float = field(default_factory=time.time)
    """Seconds since the epoch."""
    version: int = SHOT_VERSION
    """Version of the shot format."""


class Shot(ShotFolder):
    """A shot folder on disk. Holds paths, not state: every read goes to the files."""

    @classmethod
    def open(cls, root: str | Path) -> Shot:
        """An existing shot. FileNotFoundError if there is none, ValueError if it is from a newer version."""
        shot = cls(root)
        if not shot.info_path.is_file():
            raise MissingError(f"{shot.root} is not a shot folder: it has no shot.json", "Check the name.")
        shot.info()
        settle_solve(shot)
        return shot

    @classmethod
    def create(cls, root: str | Path, name: str = "") -> Shot:
        """Opens the shot at `root`, or makes an empty one there. JobError if the folder holds other files."""
        shot = cls(root)
        if shot.info_path.is_file():
            return cls.open(root)
        refuse_foreign(shot.root)
        shot.root.mkdir(parents=True, exist_ok=True)
        shot.save(ShotInfo(name=name or shot.root.name.removesuffix(SHOT_SUFFIX)))
        return shot

    def publish_frames(self) -> None:
        """Completes an import: moves work on the replaced frames to SHOT/replaced, and updates shot.json.

        Does nothing unless an import left UNPUBLISHED_FILE. Only the shot's writer may call this. If an import is
        killed before its last step, the next job completes it.
        """
        news = self.frames / UNPUBLISHED_FILE
        if not news.is_file():
            return
        with contextlib.suppress(ValueError, KeyError, TypeError):  # damaged by another program: frames.json is valid
            record = read_json(news)
            info = from_dict(ShotInfo, {**dataclasses.asdict(self.info()), **{name: record[name] for name in IMPORTED}})
            if record.get("replaced"):
                keep_replaced(self, str(record["replaced"]), [int(frame) for frame in record["same"]])
            shutil.rmtree(self.own(self.solve), ignore_errors=True)
            self.save(info)
        remove_file(news)

    def info(self) -> ShotInfo:
        """Current content of shot.json."""
        data = read_json(self.info_path)
        check_version(data, str(self.info_path), SHOT_VERSION)
        return from_dict(ShotInfo, data)

    def save(self, info: ShotInfo) -> None:
        """Rewrites shot.json."""
        write_json(self.info_path, dataclasses.asdict(info))

    def update(self, **changes: Any) -> ShotInfo:
        """Rewrites shot.json with some fields changed, and returns it."""
        info = dataclasses.replace(self.info(), **changes)
        self.save(info)
        return info
