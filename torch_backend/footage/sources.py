"""Interfaces of footage for an import: facts, sequential frames, single frames (plates); and helpers for messages."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol

from numpy.typing import NDArray

from ..contract import ExitCode, ImportParams, JobError, files_digest, mapped

LEAST_FRAMES = 8
"""Minimum number of frames for a freeze."""
LONGEST_PIXEL = 4
"""Largest plausible pixel aspect. Anamorphic pixels are at most about 2 times as wide as high."""


SLOWEST_FPS, FASTEST_FPS = 0.1, 1000.0
"""Range of plausible frame rates of image sequences. Values outside of it are mistakes."""


@dataclass
class SourceFrame:
    """One frame of the source."""

    number: int
    """Frame number: from 1 in a video, the file's number in a sequence."""
    seconds: float
    """Presentation time in seconds on the source's own clock."""
    pixels: NDArray[Any]
    """[H, W, 3], square pixels, upright: uint8 or uint16 display-referred sRGB. For footage that holds light
    (`SourceInfo.colour`): float16, scene-linear Rec.709, unclipped, see `plate_encoding`."""
    corrupt: bool = False
    """True if the decoder had to guess parts of the picture."""


@dataclass
class SourceInfo:
    """Facts about the footage that are known before decoding."""

    width: int
    """Width in pixels, upright and with square pixels."""
    height: int
    """Height in pixels."""
    fps: float
    """Frames per second; the average for a variable rate."""
    first: int
    """Number of the first frame."""
    last: int | None
    """Number of the last frame; None if the container does not store it."""
    deep: bool
    """True if working frames have 16 bits."""
    extended: bool
    """True if its plates may hold values below 0 and above 1: light, floats, other primaries than Rec.709."""
    colour: str
    """srgb, or linear for pictures that hold light: scene-linear, log, HDR."""
    key: list[Any]
    """Key of the footage: count, bytes and content of its files, and their interpretation."""
    reading: dict[str, Any] = field(default_factory=dict[str, Any])
    """Interpretation of the footage, with flags for assumed properties; stored in frames.json."""
    file: str = ""
    """The video, or the first picture of the sequence."""
    probe: tuple[float, ...] = ()
    """Linear Rec.709 light of the value `contract.PROBE` in the footage."""
    mismatch: str = ""
    """Clause why another program would show the files differently; empty if it would not."""
    former_key: list[Any] = field(default_factory=list[Any])
    """`key` in earlier versions, from names and modification times. Imports with this key stay valid."""


@dataclass(frozen=True)
class Overrides:
    """The user's overrides of properties of the footage."""

    matrix: str = ""
    """Key of `frame_rgb.MATRIX_OVERRIDES`; empty: from the file, else the assumption of players."""
    levels: str = ""
    """Key of `frame_rgb.RANGE_OVERRIDES`; empty: from the file, else the assumption of players."""
    pixel_aspect: Fraction | None = None
    """Width of a pixel over its height; None: from the files, else square."""
    look: str = ""
    """File of a look to apply to the footage, see `look`; empty: none."""


def overrides_of(config: ImportParams) -> Overrides:
    """The overrides in the parameters of an import. Raises JobError for a colour space together with a look."""
    matrix, levels = ("" if value == "auto" else value for value in (config.matrix, config.levels))
    if config.lut and config.colour_space:
        raise footage_error(
            f"Both a colour space ({config.colour_space}) and a look ({config.lut}) are set.",
            "Use only one: a look already converts the picture for a display.",
        )
    look = mapped(config.lut) if config.lut else ""
    return Overrides(matrix, levels, Fraction(config.pixel_aspect).limit_denominator(10_000) or None, look)


class Source(Protocol):
    """A video or a numbered sequence."""

    info: SourceInfo
    warnings: list[tuple[str, str]]

    def frames(self, first: int | None, last: int | None) -> Iterator[SourceFrame]:
        """Frames `first` to `last`, inclusive, in order. Omits undecodable frames, with a warning."""
        ...

    def plates(self, known: Known) -> PlateReader:
        """A reader for single frames of an import of this source, at the source's size and depth."""
        ...


@dataclass
class Known:
    """Facts from an import, for a `PlateReader`."""

    seconds: dict[int, float]
    """Frame number -> time in seconds since the first listed frame."""
    start: float | None
    """Time of the first listed frame on the source's own clock; None if the import did not record it."""
    agrees: Callable[[int, NDArray[Any]], bool]
    """Function that returns True if a frame's plate matches its working frame."""


class PlateReader(Protocol):
    """Reads single frames of a source in any order. Ascending order and near neighbours are fast."""

    def plate(self, number: int) -> NDArray[Any]:
        """Frame `number`, upright, with square pixels, unclipped, as codes of `plate_encoding`.

        Raises OSError or JobError (FOOTAGE) if the frame cannot be read.
        """
        ...

    def close(self) -> None:
        """Closes open files."""
        ...


def content_key_of(files: Mapping[int, Path]) -> list[Any]:
    """First part of `SourceInfo.key`: count, bytes and content of numbered files. A video has the number 1."""
    return [len(files), sum(file.stat().st_size for file in files.values()), files_digest(files)]


def footage_error(message: str, hint: str = "") -> JobError:
    """An error about the footage, for the artist."""
    return JobError(message, hint, ExitCode.FOOTAGE)


def frame_words(numbers: Sequence[int]) -> str:
    """Frame numbers as text: 'frame 4', or 'frames 3-5, 9'. Lists at most eight spans. `numbers` are ascending."""
    spans: list[list[int]] = []
    for number in numbers:
        if spans and number == spans[-1][1] + 1:
            spans[-1][1] = number
        else:
            spans.append([number, number])
    listed = [f"{a}" if a == b else f"{a}-{b}" for a, b in spans]
    more = f" and {len(listed) - 8} more spans" if len(listed) > 8 else ""
    return ("frame " if len(numbers) == 1 else "frames ") + ", ".join(listed[:8]) + more


def believable_aspect(aspect: Fraction, warnings: list[tuple[str, str]]) -> Fraction:
    """The pixel aspect if plausible; otherwise 1, with a warning."""
    if 1 / LONGEST_PIXEL <= aspect <= LONGEST_PIXEL:
        return aspect
    warnings.append((f"The footage claims pixels {float(aspect):g} times as wide as high: read as square.", ""))
    return Fraction(1)


def square_size(width: int, height: int, aspect: Fraction) -> tuple[int, int]:
    """(width, height) of a picture resampled to square pixels from the pixel aspect `aspect`. Neither side shrinks."""
    if aspect >= 1:
        return max(1, round(width * aspect)), height
    return width, max(1, round(height / aspect))
