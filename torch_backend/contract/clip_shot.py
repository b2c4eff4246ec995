"""Finds the shot folder of a clip. A folder with the shot of another clip is not used."""

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
    folder: Path, clip: str | Path, read_field: Callable[[Path, str, int], str] | None = None
) -> bool | None:
    """True if the shot in a folder was imported from a clip, False if from another one; None if unknown.

    If the clip lies where the footage lay relative to the shot, it counts as that footage: both were moved or copied
    together.

    Args:
        folder: shot folder.
        clip: absolute path.
        read_field: (file, name, most bytes) -> value under a name in a JSON file; empty if the file cannot be read.
    """
    read_field = read_field or json_field
    source = read_field(ShotFolder(folder).info_path, "source", SHORT_JSON)
    if not source:
        return None
    if _place(source) == _place(clip):
        return True
    relative = read_field(ShotFolder(folder).listing, "beside", LONGEST_JSON)
    if relative and not os.path.isabs(relative):
        if _place(folder / relative) == _place(clip):
            return True
        if os.path.exists(folder / relative):
            return False
    if os.path.exists(source):
        return False
    return _place(folder.parent / re.split(r"[\\/]", source)[-1]) == _place(clip)


def check_same_clip(folder: Path, clip: str | Path) -> None:
    """Raises JobError if the shot in a folder was imported from another clip than this one."""
    if is_imported_from(folder, clip) is False:
        source = json_field(ShotFolder(folder).info_path, "source", SHORT_JSON)
        raise JobError(
            f"{folder} is the shot folder of another clip: {source}.",
            "Choose another folder with --output, or another shot with --shot-name.",
            ExitCode.USAGE,
        )


def json_field(file: Path, name: str, longest: int) -> str:
    """Value under a name in a JSON file of at most `longest` bytes; empty if the file cannot be read."""
    try:
        return str(read_json(file, longest).get(name, ""))
    except (OSError, ValueError):
        return ""


def default_shot_folder(clip: Path, is_of: Callable[[Path, Path], bool | None] = is_imported_from) -> Path:
    """Default shot folder of a clip, next to the clip and with its name. If another clip's shot has that name, the
    clip's ending or a digest of its path is added."""
    names = clip.stem, clip.name if clip.suffix else f"{clip.name} 2", f"{clip.stem}-{path_digest(clip)}"
    places = [clip.with_name(name + SHOT_SUFFIX) for name in names]
    answers = [is_of(place, clip) for place in places]
    for answer in (True, None):
        if answer in answers:
            return places[answers.index(answer)]
    return places[-1]


def path_digest(path: str | Path, letters: int = _DIGEST_LETTERS) -> str:
    """Hexadecimal digest of an absolute path, the same in every run, to distinguish files of the same name."""
    return hashlib.sha256(_place(path).encode("utf-8", "surrogatepass")).hexdigest()[:letters]


def readable_stem(name: str, is_numbered: bool) -> str:
    """A file's name without its ending and, if `is_numbered`, without its frame number: plate.v001 of plate.v001.mp4,
    kitchen of kitchen.0001.png."""
    stem, dot, ending = name.rpartition(".")
    stem = stem if dot and stem and ending.isalnum() else name
    return (_NUMBER.sub("", stem) if is_numbered else stem) or stem


def collision_key(name: str) -> str:
    """`name` without case and with normalised accents: the same for names that some disks take for one file."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


def _place(path: str | Path) -> str:
    """Normalised path, without access to the disk."""
    return os.path.normcase(os.path.normpath(path))
