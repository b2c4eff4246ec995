"""The folder of a take: which of its frames are right, and how new ones take the place of the previous ones."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Set
from dataclasses import dataclass
from pathlib import Path

from ...contract import (
    LAYERS,
    PICTURE,
    ExitCode,
    FreezeParams,
    JobError,
    TakeFolder,
    frame_number,
    is_whole_picture,
    remove_file,
    replace_file,
    sweep_half_written,
)
from ...shot import make_folder, write_json
from ..exr import read_key
from .plan import FrameSpec, PlannedTake


@dataclass(frozen=True)
class Place:
    """Where a take's frames are rendered to."""

    folder: TakeFolder
    """The take's own; or `beside`."""
    beside: TakeFolder | None
    """A folder in it, as long as another take of that name stands there whole: that one stays until this is done."""
    right_here: set[int]
    """Frames in the take's own folder that are as they would be rendered now."""
    right_beside: set[int]
    """Those in `beside`: it was begun before."""
    of_before: bool = False
    """There are frames of an earlier version, whose files do not say which belong together: they are made anew."""


def place_of(take: PlannedTake, params: FreezeParams) -> Place:
    """Makes the folder that the take is rendered to, and finds the frames that are right.

    One that is not asked for now is among them: a part of the range does not undo the rest of the take.
    """
    folder, spec = take.folder, take.spec
    make_folders(folder, spec)
    keys = stored_keys(folder, spec) if params.only_missing else {}
    right, next_folder, of_before = right_frames(take, keys), folder.next, "" in keys.values()
    right_in_next = set[int]()
    if params.only_missing and next_folder.root.is_dir():
        right_in_next = right_frames(take, stored_keys(next_folder, spec))
    for n in set(_numbers(next_folder)) - right_in_next:
        for file in files_of(next_folder, n):
            remove_file(file)
    stands = folder.facts.is_file() and bool(set(frames_of(folder)) - right)
    if not stands:
        place = Place(folder, next_folder, right, right_in_next)
        if next_folder.root.is_dir():  # killed while it took over
            take_over(take, place)
        return Place(folder, None, right | right_in_next, set(), of_before)
    _prepare(next_folder, spec)
    return Place(next_folder, next_folder, right, right_in_next, of_before)


def right_frames(take: PlannedTake, keys: dict[int, str | None]) -> set[int]:
    """The frames that are as they would be rendered now, of `stored_keys`."""
    return {n for n, key in keys.items() if key is not None and key == take.keys.get(n)}


def stored_keys(folder: TakeFolder, spec: FrameSpec) -> dict[int, str | None]:
    """Frame -> `stored_key`, of all frames of a take's folder."""
    return {n: stored_key(folder, n, spec) for n in frames_of(folder)}


def stored_key(folder: TakeFolder, frame: int, spec: FrameSpec) -> str | None:
    """The key that all files of a frame carry. Empty if one carries none: an earlier version wrote it.

    None if one lacks, is cut off, or is of another frame or take than the rest: a process was killed between them.
    """
    files = [folder.frame(frame), folder.preview(frame)]
    files += [folder.warp(frame)] if spec.has_warps else []
    files += [folder.deep(frame)] if spec.deep is not None else []
    if not all(map(is_whole_picture, files)):  # a copy may have been cut off
        return None
    keys = {read_key(file) for file in files}
    if None in keys:
        return None
    return "" if "" in keys else keys.pop() if len(keys) == 1 else None


def made_before(take: str) -> tuple[str, str]:
    """Warning about a take with frames of an earlier version, with the reason."""
    return (
        f"Frames of the take {take} were made by an earlier version, whose files do not say which belong together: "
        "they are made again.",
        "Name another take to keep them.",
    )


def outdated(take: PlannedTake, kept: Set[int]) -> tuple[str, str] | None:
    """A warning that frames of the take, other than those `kept`, are removed and not rendered again, because they
    show something else. None if there are none."""
    gone = set(frames_of(take.folder)) - kept
    if not gone:
        return None
    return (
        f"Frames of the take {take.folder.root.name} that show another instant or have other settings are removed and "
        f"not rendered again: {len(gone)}.",
        "Freeze the whole range to have them again, or name another take to keep them.",
    )


def clear(take: PlannedTake, done: Set[int]) -> None:
    """Removes all earlier frames except those in `done`, so that none of them passes for a frame of this take."""
    folder = take.folder
    stale = set(_numbers(folder)) - done
    for old in [folder.facts, *(file for n in stale for file in files_of(folder, n))] if stale else ():
        remove_file(old)
    write_json(folder.state, {"version": 1, "key": take.key})


def take_over(take: PlannedTake, place: Place) -> None:
    """Moves the frames that were rendered next to an earlier take into its place. If it is killed, the next freeze
    continues."""
    assert place.beside is not None
    clear(take, place.right_here)
    for n in frames_of(place.beside):
        for file, target in zip(reversed(files_of(place.beside, n)), reversed(files_of(take.folder, n)), strict=True):
            if file.is_file():  # the EXR last: a frame that has one has the others
                replace_file(file, target)
    shutil.rmtree(place.beside.root, ignore_errors=True)


def files_of(folder: TakeFolder, frame: int) -> list[Path]:
    """All files that a frame of a take has: EXR, deep EXR, warp, preview."""
    return [folder.frame(frame), folder.deep(frame), folder.warp(frame), folder.preview(frame)]


def make_folders(folder: TakeFolder, spec: FrameSpec) -> None:
    """Makes a take's folder. JobError if it holds frames of someone else's."""
    if not folder.state.is_file() and _numbers(folder):
        raise JobError(
            f"{folder.root} holds numbered pictures that were not made here.",
            "Name another take, or move them away.",
            ExitCode.FREEZE,
        )
    _prepare(folder, spec)


def _prepare(folder: TakeFolder, spec: FrameSpec) -> None:
    """Makes the folders of a take's frames, and removes what was half written to them."""
    warps, deeps = [folder.warps] if spec.has_warps else [], [folder.deeps] if spec.deep is not None else []
    for used in (folder.root, folder.previews, *warps, *deeps):
        make_folder(used)
        sweep_half_written(used)


def frames_of(folder: TakeFolder) -> list[int]:
    """Numbers of the frames that a take's folder has, ascending."""
    return _frames_in(folder.root.glob("*" + LAYERS))


def _numbers(folder: TakeFolder) -> list[int]:
    """Those of all files of frames."""
    folders = folder.root, folder.warps, folder.deeps
    files = [folder.previews.glob("*" + PICTURE), *(each.glob("*" + LAYERS) for each in folders)]
    return sorted({n for found in files for n in _frames_in(found)})


def _frames_in(paths: Iterable[Path]) -> list[int]:
    """Numbers of those files that are frames, ascending."""
    return sorted(n for p in paths if (n := frame_number(p.stem)) is not None)
