"""Which shot folder is a clip's: a folder that holds another clip's shot is never used for it."""

from __future__ import annotations

import hashlib
import os
import re
import unicodedata
from collections.abc import Callable
from pathlib import Path

from .errors import ExitCode, JobError
from .files import LONGEST_JSON, SHORT_JSON, read_json
from .shot_folder import SHOT_SUFFIX, ShotFolder

_DIGEST_LETTERS = 6
_NUMBER = re.compile(r"[._-]?(?<![0-9A-Za-z])(?:#+|@+|%0?[0-9]*d|[0-9]+)$")


def is_imported_from(
    folder: Path, clip: str | Path, told: Callable[[Path, str, int], str] | None = None
) -> bool | None:
    """True if the shot in a folder was imported from a clip, False if from another one; None if unknown.

    What lies where the shot's footage lay, seen from the shot, is its own: both were moved or copied together.

    Args:
        folder: shot folder.
        clip: absolute path.
        told: (file, name, most bytes) -> what a JSON file says under a name; empty if it cannot be read.
    """
    told = told or told_by
    source = told(ShotFolder(folder).info_path, "source", SHORT_JSON)
    if not source:
        return None
    if _place(source) == _place(clip):
        return True
    beside = told(ShotFolder(folder).listing, "beside", LONGEST_JSON)
    if beside and not os.path.isabs(beside):
        if _place(folder / beside) == _place(clip):
            return True
        if os.path.exists(folder / beside):
            return False
    if os.path.exists(source):
        return False
    return _place(folder.parent / re.split(r"[\\/]", source)[-1]) == _place(clip)


def refuse_anothers(folder: Path, clip: str | Path) -> None:
    """JobError if the shot in a folder was imported from another clip than this one."""
    if is_imported_from(folder, clip) is False:
        source = told_by(ShotFolder(folder).info_path, "source", SHORT_JSON)
        raise JobError(
            f"{folder} is the shot of another clip: {source}.",
            "Name another folder with --output, or another shot with --shot-name.",
            ExitCode.USAGE,
        )


def told_by(file: Path, name: str, longest: int) -> str:
    """What a JSON file of at most `longest` bytes says under a name; empty if it cannot be read."""
    try:
        return str(read_json(file, longest).get(name, ""))
    except (OSError, ValueError):
        return ""


def shot_beside(clip: Path, is_of: Callable[[Path, Path], bool | None] = is_imported_from) -> Path:
    """The shot folder of a clip for which none was chosen, beside it: called as the clip; with the clip's ending, or a
    digest of its path, where another clip's shot is called so."""
    names = clip.stem, clip.name if clip.suffix else f"{clip.name} 2", f"{clip.stem}-{path_digest(clip)}"
    places = [clip.with_name(name + SHOT_SUFFIX) for name in names]
    owned = [is_of(place, clip) for place in places]
    for wanted in (True, None):
        if wanted in owned:
            return places[owned.index(wanted)]
    return places[-1]


def path_digest(path: str | Path, letters: int = _DIGEST_LETTERS) -> str:
    """Hexadecimal digest of an absolute path: names that read alike are told apart by it, in every run."""
    return hashlib.sha256(_place(path).encode("utf-8", "surrogatepass")).hexdigest()[:letters]


def readable_stem(name: str, is_numbered: bool) -> str:
    """A file's name without its ending, and without the number of a frame if it has one: plate.v001.mp4 is plate.v001,
    kitchen.0001.png is kitchen."""
    stem, dot, ending = name.rpartition(".")
    stem = stem if dot and stem and ending.isalnum() else name
    return (_NUMBER.sub("", stem) if is_numbered else stem) or stem


def same_name(name: str) -> str:
    """What names have in common that are one file on some disk: case and accents count there as written otherwise."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


def _place(path: str | Path) -> str:
    """What two ways to write the path of one file have in common; nothing is looked up."""
    return os.path.normcase(os.path.normpath(path))
