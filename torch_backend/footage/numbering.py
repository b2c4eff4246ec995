"""Frame numbers of a shot that differ from the footage's own: `--start`.

All code uses the shot's frame numbers. If the footage counts differently, frames.json records the difference, and only
`Renumbered` applies it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from numpy.typing import NDArray

from ..contract import ImportParams
from .sources import Known, PlateReader, Source, SourceFrame, SourceInfo

FOOTAGE_NUMBERS = "Frames are named by the footage's own numbers here."
"""Sentence added to the hint of a warning about single frames, if shot and footage count differently."""


def shift_of(info: SourceInfo, config: ImportParams) -> int:
    """Shift requested by an import: number of a frame in the shot minus its number in the footage.

    `start` is the number of the first frame of the range, even if that frame is missing, so that gaps are preserved.
    """
    if config.start is None:
        return 0
    return config.start - (info.first if config.first is None else max(info.first, config.first))


def recorded_shift(record: dict[str, Any]) -> int:
    """The shift of a finished import, from its frames.json. Recomputing it could fail: the footage may lack files."""
    return int(record.get("shift") or 0)


def renumbered(source: Source, shift: int) -> Source:
    """The source with the shot's frame numbers; the same object if `shift` is 0."""
    return Renumbered(source, shift) if shift else source


class Renumbered:
    """A source with all frame numbers raised by `shift`."""

    def __init__(self, source: Source, shift: int) -> None:
        self._source, self._shift = source, shift
        self.warnings = source.warnings
        last = source.info.last
        self.info = replace(source.info, first=source.info.first + shift, last=None if last is None else last + shift)

    def frames(self, first: int | None, last: int | None) -> Iterator[SourceFrame]:
        """See `Source.frames`."""
        earlier = len(self.warnings)
        span = (None if number is None else number - self._shift for number in (first, last))
        for frame in self._source.frames(*span):
            yield replace(frame, number=frame.number + self._shift)
        self.warnings[earlier:] = [
            (message, f"{hint} {FOOTAGE_NUMBERS}".strip()) for message, hint in self.warnings[earlier:]
        ]

    def plates(self, known: Known) -> PlateReader:
        """See `Source.plates`."""
        return _RenumberedPlates(self._source, known, self._shift)


class _RenumberedPlates:
    """Plate reader with the shot's frame numbers."""

    def __init__(self, source: Source, known: Known, shift: int) -> None:
        self._shift = shift
        seconds = {number - shift: at for number, at in known.seconds.items()}
        self._reader = source.plates(Known(seconds, known.start, lambda n, picture: known.agrees(n + shift, picture)))

    def plate(self, number: int) -> NDArray[Any]:
        """See `PlateReader.plate`."""
        return self._reader.plate(number - self._shift)

    def close(self) -> None:
        """See `PlateReader.close`."""
        self._reader.close()
