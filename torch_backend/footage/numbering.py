"""Frame numbers of a shot that do not follow the footage's own: `--start`.

A shot counts one number everywhere. Where the footage counts differently, the difference is recorded in frames.json,
and `Renumbered` is the only place that applies it: whoever opens the footage sees the shot's numbers.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from numpy.typing import NDArray

from ..contract import ImportParams
from .sources import Known, PlateReader, Source, SourceFrame, SourceInfo

OWN_NUMBERS = "Frames are named by the footage's own numbers here."
"""Added to the hint of a warning about single frames of footage that the shot numbers otherwise."""


def shift_of(info: SourceInfo, config: ImportParams) -> int:
    """Number of a frame in the shot minus its number in the footage, as an import asks for it.

    `start` is the number of the first frame of the range, also where that frame is missing: gaps stay gaps.
    """
    if config.start is None:
        return 0
    return config.start - (info.first if config.first is None else max(info.first, config.first))


def recorded_shift(record: dict[str, Any]) -> int:
    """The same of a finished import; `record` is frames.json. Not computed again: the footage may have lost files."""
    return int(record.get("shift") or 0)


def renumbered(source: Source, shift: int) -> Source:
    """The source in the shot's numbers: itself where they are the footage's own."""
    return Renumbered(source, shift) if shift else source


class Renumbered:
    """A source whose frame numbers are `shift` higher than those of its files."""

    def __init__(self, source: Source, shift: int) -> None:
        self._source, self._shift = source, shift
        self.warnings = source.warnings
        last = source.info.last
        self.info = replace(source.info, first=source.info.first + shift, last=None if last is None else last + shift)

    def frames(self, first: int | None, last: int | None) -> Iterator[SourceFrame]:
        """See `Source.frames`."""
        earlier = len(self.warnings)
        own = (None if number is None else number - self._shift for number in (first, last))
        for frame in self._source.frames(*own):
            yield replace(frame, number=frame.number + self._shift)
        self.warnings[earlier:] = [
            (message, f"{hint} {OWN_NUMBERS}".strip()) for message, hint in self.warnings[earlier:]
        ]

    def plates(self, known: Known) -> PlateReader:
        """See `Source.plates`."""
        return _RenumberedPlates(self._source, known, self._shift)


class _RenumberedPlates:
    """Plates by the shot's numbers."""

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
