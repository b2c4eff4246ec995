"""What footage is to an import: its facts, its frames one after the other, single ones again; and words for them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol

from numpy.typing import NDArray

from ..contract import ExitCode, ImportParams, JobError, files_digest, mapped

LEAST_FRAMES = 8
"""Frames that a freeze needs."""
LONGEST_PIXEL = 4
"""Anamorphic pixels are at most about 2 times as wide as high."""


SLOWEST_FPS, FASTEST_FPS = 0.1, 1000.0
"""Rates of image sequences that are trusted: what else a file or a person says is a slip."""


@dataclass
class SourceFrame:
    """One frame as the source holds it."""

    number: int
    """Frame number: from 1 in a video, the file's number in a sequence."""
    seconds: float
    """Presentation time in seconds on the source's own clock."""
    pixels: NDArray[Any]
    """[H, W, 3], square pixels, upright: uint8 or uint16 display-referred sRGB, or of footage that holds light
    (`SourceInfo.colour`) float16, scene-linear Rec.709 with nothing cut, as `plate_encoding` has it."""
    corrupt: bool = False
    """The decoder had to guess parts of it."""


@dataclass
class SourceInfo:
    """What is known of the footage before it is decoded."""

    width: int
    """Width in pixels, upright and with square pixels."""
    height: int
    """Height in pixels."""
    fps: float
    """Frames per second, the average if they vary."""
    first: int
    """Number of the first frame."""
    last: int | None
    """Number of the last frame; None where the container does not say."""
    deep: bool
    """True if working frames keep 16 bits."""
    extended: bool
    """True if its plates may hold values below 0 and above 1: light, floats, other primaries than Rec.709."""
    colour: str
    """srgb, or linear for pictures that hold light: scene-linear, log, HDR."""
    key: list[Any]
    """What tells this footage from another: its files' count, bytes and content, and how they are read."""
    reading: dict[str, Any] = field(default_factory=dict[str, Any])
    """How it is read, and what of that was assumed: the record in frames.json says so."""
    file: str = ""
    """The video, or the first picture of the sequence."""
    probe: tuple[float, ...] = ()
    """Linear Rec.709 light that `contract.PROBE` means in its files."""
    unlike: str = ""
    """Why another program would show the files otherwise than they are read here, a clause; empty if it would not."""
    former_key: list[Any] = field(default_factory=list[Any])
    """`key` as earlier versions made it, of names and modification times: imports that carry it stay finished."""


@dataclass(frozen=True)
class Told:
    """What a person says of the footage in place of its files."""

    matrix: str = ""
    """One of `frame_rgb.MATRIX_OVERRIDES`; empty: what the file says, or players assume."""
    levels: str = ""
    """One of `frame_rgb.RANGE_OVERRIDES`; empty: what the file says, or players assume."""
    pixel_aspect: Fraction | None = None
    """Width of a pixel over its height; None: what the files say, else square."""
    look: str = ""
    """File of a look through which the footage is seen, see `look`; empty: none."""


def told_in(config: ImportParams) -> Told:
    """What of it an import was asked for."""
    matrix, levels = ("" if value == "auto" else value for value in (config.matrix, config.levels))
    if config.lut and config.colour_space:
        raise footage_error(
            f"A colour space ({config.colour_space}) and a look ({config.lut}) are both given.",
            "Give one of them: a look already makes a picture for a display.",
        )
    look = mapped(config.lut) if config.lut else ""
    return Told(matrix, levels, Fraction(config.pixel_aspect).limit_denominator(10_000) or None, look)


class Source(Protocol):
    """A video or a numbered sequence."""

    info: SourceInfo
    warnings: list[tuple[str, str]]

    def frames(self, first: int | None, last: int | None) -> Iterator[SourceFrame]:
        """Frames `first` to `last`, inclusive, in order. Those that cannot be decoded are left out, with a warning."""
        ...

    def plates(self, known: Known) -> PlateReader:
        """Reads single frames of an import of this source again, at the source's own size and depth."""
        ...


@dataclass
class Known:
    """Facts that an import stored about the frames that are read again."""

    seconds: dict[int, float]
    """Time of each listed frame since the first of them, by its number."""
    start: float | None
    """Time of the first listed frame on the source's own clock; None if the import did not record it."""
    agrees: Callable[[int, NDArray[Any]], bool]
    """Whether a frame's plate shows what its working frame shows."""


class PlateReader(Protocol):
    """Single frames of a source, in any order; ascending ones, and their near neighbours, are quick."""

    def plate(self, number: int) -> NDArray[Any]:
        """Frame `number`, upright, with square pixels, uncut, as `plate_encoding` has it.

        OSError or JobError (FOOTAGE) if it cannot be read.
        """
        ...

    def close(self) -> None:
        """Frees what is held open."""
        ...


def content_key_of(files: Mapping[int, Path]) -> list[Any]:
    """What `SourceInfo.key` begins with: count, bytes and content of numbered files; 1 is the number of a video."""
    return [len(files), sum(file.stat().st_size for file in files.values()), files_digest(files)]


def footage_error(message: str, hint: str = "") -> JobError:
    """An error about the footage, as the artist reads it."""
    return JobError(message, hint, ExitCode.FOOTAGE)


def frame_words(numbers: Sequence[int]) -> str:
    """'frame 4', or 'frames 3-5, 9' for 3, 4, 5 and 9; at most eight spans are listed. `numbers` ascend."""
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
    """Width of a pixel over its height; 1, with a warning, if no camera or lens has such pixels."""
    if 1 / LONGEST_PIXEL <= aspect <= LONGEST_PIXEL:
        return aspect
    warnings.append((f"The footage claims pixels {float(aspect):g} times as wide as high: taken as square.", ""))
    return Fraction(1)


def square_size(width: int, height: int, aspect: Fraction) -> tuple[int, int]:
    """Size of a picture once its pixels, `aspect` times as wide as high, are square; neither side shrinks."""
    if aspect >= 1:
        return max(1, round(width * aspect)), height
    return width, max(1, round(height / aspect))
