"""Finds the files of an image sequence in a folder."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import OpenImageIO as oiio

from ..contract import (
    JobError,
    NumberedFiles,
    ending,
    matching_files,
    numbered_files,
)
from .sources import (
    LEAST_FRAMES,
    footage_error,
)

FEW = 2


# Formats of OpenImageIO without stored pictures: null generates pictures, term writes text.
_NO_PICTURES = {"null", "term"}


def _picture_endings() -> frozenset[str]:
    formats = (one.partition(":") for one in oiio.get_string_attribute("extension_list").split(";"))
    readable = set(oiio.get_string_attribute("input_format_list").split(",")) - _NO_PICTURES
    return frozenset(f".{end}" for name, _, ends in formats if name in readable for end in ends.split(","))


PICTURES = _picture_endings()
"""File extensions that OpenImageIO reads, lower case."""


@dataclass(frozen=True)
class PictureSequence:
    """The files of a numbered image sequence."""

    folder: Path
    numbered: NumberedFiles

    @property
    def pattern(self) -> str:
        """Name of the files, with # for the frame number."""
        return self.numbered.pattern

    @property
    def files(self) -> dict[int, Path]:
        """Frame number -> file, ascending."""
        return {number: self.folder / name for number, name in self.numbered.files.items()}


def find_sequence(path: Path) -> PictureSequence:
    """Finds the sequence for a folder, one of its files, or a pattern (shot.####.exr, *_left.%04d.png).

    Raises JobError if there is no sequence, if the file has no number, or if several sequences match.
    """
    if path.is_dir():
        return _only(path, _sequences_in(path, _names_in(path)), f"The folder {path} contains", _no_sequence_in(path))
    if not path.exists():
        found = matching_files(_names_in(path.parent), path.name)
        missing = footage_error(
            f"No pictures match {path}.", "Check the folder and the pattern: # or %04d stands for the frame number."
        )
        return _only(path.parent, [s for s in found if _is_readable(s)], f"{path} means", missing)
    found = sequence_of_file(path)
    if found is None:
        raise footage_error(
            f"{path.name} is a single picture, not part of a numbered sequence.",
            "A freeze needs a clip: choose a video or a sequence.",
        )
    return found


def sequence_of_file(path: Path) -> PictureSequence | None:
    """The sequence that a picture belongs to; None for a single picture. Raises JobError if it belongs to several."""
    found = [s for s in _sequences_in(path.parent, _names_in(path.parent)) if path.name in s.files.values()]
    return _only(path.parent, found, f"{path.name} belongs to", None) if found else None


def numbered_neighbours(path: Path) -> NumberedFiles | None:
    """The numbered files of any extension that a file belongs to; None for a single file."""
    found = numbered_files(_names_in(path.parent))
    return next((s for s in found if len(s.files) >= FEW and path.name in s.files.values()), None)


def unreadable_pictures(pattern: str) -> JobError:
    """The error for numbered files that OpenImageIO cannot read."""
    return footage_error(
        f"{pattern} cannot be read: OpenImageIO does not know the file extension "
        f"{ending(pattern) or 'of these pictures'}.",
        "Convert them to PNG, TIFF or EXR.",
    )


def _names_in(folder: Path) -> list[str]:
    try:
        with os.scandir(folder) as entries:
            # Skip files with a leading dot, in which macOS and other programs store metadata.
            return [entry.name for entry in entries if not entry.name.startswith(".") and entry.is_file()]
    except OSError:
        return []


def _sequences_in(folder: Path, names: list[str]) -> list[NumberedFiles]:
    readable = [name for name in names if Path(name).suffix.lower() in PICTURES]
    return [s for s in numbered_files(readable) if len(s.files) >= FEW or s.twice]


def _is_readable(numbered: NumberedFiles) -> bool:
    """True if OpenImageIO reads these files, by their extension."""
    return Path(next(iter(numbered.files.values()))).suffix.lower() in PICTURES


def _only(folder: Path, found: list[NumberedFiles], who: str, missing: JobError | None) -> PictureSequence:
    """The only found sequence. Raises JobError if there are several, or two files with the same number."""
    if not found and missing is not None:
        raise missing
    if len(found) > 1:
        names = ", ".join(s.pattern for s in found[:4]) + (", ..." if len(found) > 4 else "")
        raise footage_error(
            f"{who} {len(found)} image sequences ({names}).",
            f"Choose one by its pattern, such as {found[0].pattern}, or by one of its pictures.",
        )
    if found[0].twice:
        raise footage_error(
            f"{found[0].twice[0]} and {found[0].twice[1]} have the same frame number.",
            "Move one of the two sequences to another folder.",
        )
    return PictureSequence(folder, found[0])


def _no_sequence_in(folder: Path) -> JobError:
    candidates = sorted(numbered_files(_names_in(folder)), key=lambda s: -len(s.files))
    if candidates and len(candidates[0].files) >= LEAST_FRAMES and not _is_readable(candidates[0]):
        return unreadable_pictures(candidates[0].pattern)
    return footage_error(
        f"The folder {folder} contains no numbered image sequence.", "Choose a folder with frames, or a video."
    )
