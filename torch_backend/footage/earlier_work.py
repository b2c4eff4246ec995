"""Protects earlier work on a shot (solves, runs, paint) when an import is about to replace the shot's frames."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..contract import ExitCode, JobError, work_words
from ..replaced import next_name
from ..shot import Shot, content_key, replace_file
from .images import is_whole_png, read_frame
from .sources import SourceInfo

_RANGE = ("first", "last", "start")


class SamePictures(Exception):
    """Raised if an import yields the pictures that the shot already has, so that nothing is replaced."""


@dataclass(frozen=True)
class EarlierWork:
    """Earlier work on a shot, such as a solve, runs, takes and paint, with its frames."""

    shot: Shot
    words: list[str]
    """Result of `contract.work_words`, not empty."""
    record: dict[str, Any]
    """frames.json of the old frames; {} if it is damaged."""

    @classmethod
    def of(cls, shot: Shot, record: dict[str, Any]) -> EarlierWork | None:
        """The earlier work on a shot; None if there is none."""
        words = work_words(shot)
        return cls(shot, words, record) if words else None

    def may_be_same(self, settings: Mapping[str, Any], info: SourceInfo) -> bool:
        """True if an import with these settings may yield the same pictures. Only decoding gives certainty.

        `settings` and `info` use the shot's frame numbers.
        """
        if not self.record or info.last is None:
            return bool(self.record)
        # Imports of the same pictures may have different keys, for example with the full range named, or a repackaged
        # file.
        rows, before = self.record["frames"], dict(self.record.get("config") or {})
        first, last = settings["first"], settings["last"]
        first = info.first if first is None else max(info.first, first)
        last = info.last if last is None else min(info.last, last)
        plain = {name: value for name, value in settings.items() if name not in _RANGE}
        known = {name: before[name] for name in plain if name in before}
        return (first, last) == (rows[0]["frame"], rows[-1]["frame"]) and known == {name: plain[name] for name in known}

    def stop_if_same(self, record: Mapping[str, Any], fresh: Path) -> None:
        """Raises SamePictures if the frames.json of a new import describes the pictures of the shot.

        Before that, restores lost or damaged files of the shot from the new frames in `fresh`.
        """
        fields = ("width", "height", "fps", "colour", "bits", "step")
        if any(record[name] != self.record.get(name) for name in fields) or not self._agree(record):
            return
        for row in self.record["frames"]:
            if not is_whole_png(self.shot.frames / row["file"]):
                replace_file(fresh / row["file"], self.shot.frames / row["file"])
        raise SamePictures

    def _agree(self, record: Mapping[str, Any]) -> bool:
        """True if a new frames.json lists the same frames as the old one, by number, time and content."""
        new, old = record["frames"], self.record["frames"]
        if [_place(row) for row in new] != [_place(row) for row in old]:
            return False
        return all(self._digest(was) in (None, now["digest"]) for was, now in zip(old, new, strict=True))

    def _digest(self, row: Mapping[str, Any]) -> str | None:
        """Digest of an old frame's picture; None if the record has no digest and the file is lost."""
        if row.get("digest"):
            return str(row["digest"])
        path = self.shot.frames / str(row["file"])
        return digest_of(read_frame(path)) if is_whole_png(path) else None

    def order(self, record: Mapping[str, Any]) -> dict[str, Any]:
        """Instructions for `Shot.publish_frames`: `replaced`, the folder name of the old work, and `same`.

        `same` lists the frames that keep their paint and masks: same number in the same footage, or same pixels.
        """
        old = {int(row["frame"]): row for row in self.record.get("frames", ())}
        footage = record["footage"] == self.record.get("footage")
        numbers = [int(row["frame"]) for row in record["frames"] if int(row["frame"]) in old]
        digests = {int(row["frame"]): row["digest"] for row in record["frames"]}
        same = [n for n in numbers if footage or digests[n] == self._digest(old[n])]
        return {"replaced": next_name(self.shot), "same": same}

    def refusal(self) -> JobError:
        """The error for an import without consent to replace earlier work."""
        rows, name = self.record.get("frames"), self.shot.root.name
        clip, span = self.shot.info().source, f", frames {rows[0]['frame']} to {rows[-1]['frame']}" if rows else ""
        return JobError(
            f"{name} contains {', '.join(self.words)} of {clip}{span}. This import would replace its frames.",
            "Import into another shot folder, or agree with --replace (in Blender: confirm the question of Import "
            f"Clip). All of that then moves to {self.shot.replaced}, and nothing is deleted.",
            ExitCode.USAGE,
        )

    def kept(self, order: Mapping[str, Any]) -> tuple[str, str]:
        """The warning (message, hint) after an import that replaced earlier work."""
        place = self.shot.replaced / str(order["replaced"])
        return (
            f"The shot's earlier work ({', '.join(self.words)}) is kept in {place}.",
            "It opens as a separate shot; delete it when it is no longer needed.",
        )


def digest_of(pixels: np.ndarray[Any, Any]) -> str:
    """Hash of a picture's pixels, independent of the file format."""
    return content_key([str(pixels.dtype), list(pixels.shape)], _sha(pixels))


def footage_key(info: SourceInfo, shift: int) -> str:
    """Key of footage and its numbering in the shot (`shift`: see `numbering`), independent of the imported range."""
    return content_key(info.key, shift)


def _sha(pixels: np.ndarray[Any, Any]) -> str:
    return hashlib.sha256(np.ascontiguousarray(pixels).data).hexdigest()


def _place(row: Mapping[str, Any]) -> tuple[int, float, bool]:
    return int(row["frame"]), round(float(row["seconds"]), 4), bool(row["solve"])
