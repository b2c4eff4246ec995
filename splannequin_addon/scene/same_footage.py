"""Checks whether an image or a movie clip shows given footage, however its path is written.

Two files are equal if the system says so (links, letter case, another mount) or if their contents are equal. Two
sequences are equal if their files are. It does not matter which file of a sequence a path names.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path

import bpy

from ...torch_backend import contract

# File name of an image in a sequence. As in Blender, the last number counts: `plate.v001.0005.exr` is frame 5.
_NUMBER = re.compile(r"(.*?)(\d+|#+|@+|%0?\d*d)([^\d#@%]*)", re.DOTALL)


def shows(data: bpy.types.Image | bpy.types.MovieClip | None, footage: Iterable[Path]) -> bool:
    """True if a data-block shows one of these: a video, a folder of images, or an image or pattern of a sequence.

    A single still image of a sequence does not count.
    """
    if data is None or not data.filepath:
        return False
    path = Path(os.path.abspath(bpy.path.abspath(data.filepath, library=data.library)))
    if data.source == "SEQUENCE":
        return any(_same_sequence(path, known) for known in footage)
    is_moving = data.source == "MOVIE"
    return any(_same_file(path, known, by_content=is_moving) for known in footage)


def _same_file(path: Path, known: Path, by_content: bool) -> bool:
    """True if two paths lead to the same file, or, with `by_content`, to equal copies."""
    if _place(path) == _place(known):
        return True
    try:
        if os.path.samefile(path, known):
            return True
        sizes = path.stat().st_size, known.stat().st_size
        if not by_content or not (path.is_file() and known.is_file()) or sizes[0] != sizes[1] or not sizes[0]:
            return False
        return contract.file_digest(path) == contract.file_digest(known)
    except (OSError, ValueError):  # one of the files is missing or unreadable
        return False


def _same_sequence(path: Path, known: Path) -> bool:
    """True if two paths name images of the same sequence, or of equal copies."""
    if _folder_of(path, known):
        return True
    first, second = _pictures(path), _pictures(known)
    if first is None or second is None:
        return False
    if _place(first[0]) == _place(second[0]) and first[1] == second[1]:
        return True
    common = sorted(first[2].keys() & second[2].keys())
    if not common:
        return False
    # Compare several frames that are far apart: the first frames of two clips may both be black.
    looked_at = {common[0], common[len(common) // 2], common[-1]}
    return all(_same_file(first[2][n], second[2][n], by_content=True) for n in looked_at)


def _folder_of(picture: Path, folder: Path) -> bool:
    """True if `folder` is an image's folder. A folder with a single sequence can be selected as footage."""
    return folder.is_dir() and _same_file(picture.parent, folder, by_content=False)


def _pictures(path: Path) -> tuple[Path, tuple[str, str], dict[int, Path]] | None:
    """(folder, (name before the number, name after it), number -> image) of the sequence that an image or pattern
    names; None if the name has no number."""
    found = _NUMBER.fullmatch(path.name)
    if found is None:
        return None
    before, after = os.path.normcase(found[1]), os.path.normcase(found[3])
    numbered: dict[int, Path] = {}
    try:
        with os.scandir(path.parent) as entries:
            for entry in entries:
                name = os.path.normcase(entry.name)
                digits = name[len(before) : len(name) - len(after)]
                if name.startswith(before) and name.endswith(after) and digits.isdecimal():
                    numbered[int(digits)] = path.parent / entry.name
    except (OSError, ValueError):  # the folder is missing: only the name is known
        pass
    return path.parent, (before, after), numbered


def _place(path: Path) -> str:
    """Normal form of a path, without opening the file."""
    try:
        return os.path.normcase(os.path.realpath(path))
    except (OSError, ValueError):
        return os.path.normcase(os.path.normpath(path))


def first_number(clip: bpy.types.MovieClip) -> int:
    """Splannequin's frame number of a movie clip's first frame."""
    number = _file_number(Path(bpy.path.abspath(clip.filepath))) if clip.source == "SEQUENCE" else 1
    return number + clip.frame_offset


def _file_number(path: Path) -> int:
    """Frame number of an image among its neighbours, as the import reads it; 1 if its name has none."""
    try:
        names = os.listdir(path.parent)
    except OSError:
        names = []
    found = contract.numbered_files({path.name, *names})
    return next((n for s in found for n, name in s.files.items() if name == path.name), 1)
