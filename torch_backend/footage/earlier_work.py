"""Work that was done on a shot's frames, when an import is about to give the shot other frames."""

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
    """The import gives the pictures that the shot has already: nothing is to be replaced."""


@dataclass(frozen=True)
class EarlierWork:
    """A solve, runs, takes, paint and so on, and the frames that they belong to."""

    shot: Shot
    words: list[str]
    """Of `contract.work_words`, not empty."""
    record: dict[str, Any]
    """frames.json of those frames; {} if it is damaged."""

    @classmethod
    def of(cls, shot: Shot, record: dict[str, Any]) -> EarlierWork | None:
        """None if no work was done on the shot."""
        words = work_words(shot)
        return cls(shot, words, record) if words else None

    def may_be_same(self, settings: Mapping[str, Any], info: SourceInfo) -> bool:
        """True if an import with these settings may give the same pictures; only decoding can decide it.

        `settings` and `info` are in the shot's numbers. The key of an import may differ for the same pictures: of a
        range that names all frames, a file that was packed anew, an import of an earlier version.
        """
        if not self.record or info.last is None:
            return bool(self.record)
        rows, before = self.record["frames"], dict(self.record.get("config") or {})
        first, last = settings["first"], settings["last"]
        first = info.first if first is None else max(info.first, first)
        last = info.last if last is None else min(info.last, last)
        plain = {name: value for name, value in settings.items() if name not in _RANGE}
        known = {name: before[name] for name in plain if name in before}
        return (first, last) == (rows[0]["frame"], rows[-1]["frame"]) and known == {name: plain[name] for name in known}

    def stop_if_same(self, record: Mapping[str, Any], fresh: Path) -> None:
        """Raises SamePictures if a new import's frames.json describes the pictures that the shot has.

        Of those, frames whose file was lost are taken from the new import, whose frames are in `fresh`.
        """
        whole = ("width", "height", "fps", "colour", "bits", "step")
        if any(record[name] != self.record.get(name) for name in whole) or not self._agree(record):
            return
        for row in self.record["frames"]:
            if not is_whole_png(self.shot.frames / row["file"]):
                replace_file(fresh / row["file"], self.shot.frames / row["file"])
        raise SamePictures

    def _agree(self, record: Mapping[str, Any]) -> bool:
        """True if all frames of a new frames.json are those of the old one, by number, time and content."""
        new, old = record["frames"], self.record["frames"]
        if [_place(row) for row in new] != [_place(row) for row in old]:
            return False
        return all(self._digest(was) in (None, now["digest"]) for was, now in zip(old, new, strict=True))

    def _digest(self, row: Mapping[str, Any]) -> str | None:
        """Digest of an old frame's picture; None if its file is lost, and an earlier import noted none."""
        if row.get("digest"):
            return str(row["digest"])
        path = self.shot.frames / str(row["file"])
        return digest_of(read_frame(path)) if is_whole_png(path) else None

    def order(self, record: Mapping[str, Any]) -> dict[str, Any]:
        """Facts for `Shot.publish_frames`, in addition to those of the new frames.json.

        Paint and masks stay with a frame that has the same number in the same footage, or the same pixels.
        """
        old = {int(row["frame"]): row for row in self.record.get("frames", ())}
        footage = record["footage"] == self.record.get("footage")
        numbers = [int(row["frame"]) for row in record["frames"] if int(row["frame"]) in old]
        digests = {int(row["frame"]): row["digest"] for row in record["frames"]}
        same = [n for n in numbers if footage or digests[n] == self._digest(old[n])]
        return {"replaced": next_name(self.shot), "same": same}

    def refusal(self) -> JobError:
        """The sentence for an import that was not allowed to replace it."""
        rows, name = self.record.get("frames"), self.shot.root.name
        clip, span = self.shot.info().source, f", frames {rows[0]['frame']} to {rows[-1]['frame']}" if rows else ""
        return JobError(
            f"{name} holds {', '.join(self.words)} of {clip}{span}: this import would replace its frames.",
            "Import into another shot folder, or consent with --replace (in Blender: confirm the question of Import "
            f"Clip): all of that then moves to {self.shot.replaced}, and nothing is deleted.",
            ExitCode.USAGE,
        )

    def kept(self, order: Mapping[str, Any]) -> tuple[str, str]:
        """The warning (message, hint) of an import that replaced it."""
        place = self.shot.replaced / str(order["replaced"])
        return (
            f"What was in the shot ({', '.join(self.words)}) is kept in {place}.",
            "It opens as a shot of its own; delete it once you do not need it.",
        )


def digest_of(pixels: np.ndarray[Any, Any]) -> str:
    """Identifies a picture by its pixels, whatever file they are in."""
    return content_key([str(pixels.dtype), list(pixels.shape)], _sha(pixels))


def footage_key(info: SourceInfo, shift: int) -> str:
    """Identifies footage and its numbering in the shot (`shift`: see `numbering`), whatever range is taken of it."""
    return content_key(info.key, shift)


def _sha(pixels: np.ndarray[Any, Any]) -> str:
    return hashlib.sha256(np.ascontiguousarray(pixels).data).hexdigest()


def _place(row: Mapping[str, Any]) -> tuple[int, float, bool]:
    return int(row["frame"]), round(float(row["seconds"]), 4), bool(row["solve"])
