"""The folder of a take: finds frames that are up to date, and replaces outdated frames by new ones."""

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
    """The folder to which a take's frames are rendered, and the frames that are up to date."""

    folder: TakeFolder
    """Folder for new frames: the take's own, or `replacement`."""
    replacement: TakeFolder | None
    """Subfolder for new frames if the take's folder holds a complete take of other inputs. That take is kept until the
    new one is complete. None: new frames go to the take's own folder."""
    current: set[int]
    """Up-to-date frames in the take's own folder."""
    replacement_current: set[int]
    """Up-to-date frames in `replacement`, from an interrupted freeze."""
    has_unkeyed: bool = False
    """True if there are frames of an earlier version, whose files have no keys; they are rendered again."""


def place_of(take: PlannedTake, params: FreezeParams) -> Place:
    """Creates the folder to which the take is rendered, and finds the frames that are up to date.

    Frames outside the requested range are included, so that freezing a part of the range keeps the rest of the take.
    """
    folder, spec = take.folder, take.spec
    make_folders(folder, spec)
    keys = stored_keys(folder, spec) if params.only_missing else {}
    current, next_folder, has_unkeyed = current_frames(take, keys), folder.next, "" in keys.values()
    current_in_next = set[int]()
    if params.only_missing and next_folder.root.is_dir():
        current_in_next = current_frames(take, stored_keys(next_folder, spec))
    for n in set(_numbers(next_folder)) - current_in_next:
        for file in files_of(next_folder, n):
            remove_file(file)
    has_earlier_take = folder.facts.is_file() and bool(set(frames_of(folder)) - current)
    if not has_earlier_take:
        place = Place(folder, next_folder, current, current_in_next)
        if next_folder.root.is_dir():  # the last freeze was killed in `take_over`
            take_over(take, place)
        return Place(folder, None, current | current_in_next, set(), has_unkeyed)
    _prepare(next_folder, spec)
    return Place(next_folder, next_folder, current, current_in_next, has_unkeyed)


def current_frames(take: PlannedTake, keys: dict[int, str | None]) -> set[int]:
    """The up-to-date frames, given `keys` from `stored_keys`."""
    return {n for n, key in keys.items() if key is not None and key == take.keys.get(n)}


def stored_keys(folder: TakeFolder, spec: FrameSpec) -> dict[int, str | None]:
    """Frame number -> `stored_key` for all frames in a take's folder."""
    return {n: stored_key(folder, n, spec) for n in frames_of(folder)}


def stored_key(folder: TakeFolder, frame: int, spec: FrameSpec) -> str | None:
    """The key that all files of a frame share. Empty if a file has no key, because an earlier version wrote it.

    None if a file is missing, truncated, or has another key than the rest, because a process was killed.
    """
    files = [folder.frame(frame), folder.preview(frame)]
    files += [folder.warp(frame)] if spec.has_warps else []
    files += [folder.deep(frame)] if spec.deep is not None else []
    if not all(map(is_whole_picture, files)):  # a copied file may be truncated
        return None
    keys = {read_key(file) for file in files}
    if None in keys:
        return None
    return "" if "" in keys else keys.pop() if len(keys) == 1 else None


def unkeyed_warning(take: str) -> tuple[str, str]:
    """(warning, hint) about a take with frames of an earlier version."""
    return (
        f"Frames of the take {take} were written by an earlier version, which did not record which belong together: "
        "they are rendered again.",
        "Choose another take name to keep them.",
    )


def outdated(take: PlannedTake, kept: Set[int]) -> tuple[str, str] | None:
    """(warning, hint) that outdated frames of the take, not in `kept`, are removed and not rendered again.

    None if there are no such frames.
    """
    removed = set(frames_of(take.folder)) - kept
    if not removed:
        return None
    return (
        f"Frames of the take {take.folder.root.name} with another instant or other settings are removed and not "
        f"rendered again: {len(removed)}.",
        "Freeze the whole range to render them again, or choose another take name to keep them.",
    )


def clear(take: PlannedTake, done: Set[int]) -> None:
    """Removes all earlier frames except those in `done`, so that no outdated frame remains in the take."""
    folder = take.folder
    stale = set(_numbers(folder)) - done
    for old in [folder.facts, *(file for n in stale for file in files_of(folder, n))] if stale else ():
        remove_file(old)
    write_json(folder.state, {"version": 1, "key": take.key})


def take_over(take: PlannedTake, place: Place) -> None:
    """Replaces an earlier take by the frames in `place.replacement`. After a kill, the next freeze continues."""
    assert place.replacement is not None
    clear(take, place.current)
    for n in frames_of(place.replacement):
        for file, target in zip(
            reversed(files_of(place.replacement, n)), reversed(files_of(take.folder, n)), strict=True
        ):
            if file.is_file():  # the EXR is moved last: if it exists, so do the other files
                replace_file(file, target)
    shutil.rmtree(place.replacement.root, ignore_errors=True)


def files_of(folder: TakeFolder, frame: int) -> list[Path]:
    """Paths of all files of a frame: EXR, deep EXR, warp, preview."""
    return [folder.frame(frame), folder.deep(frame), folder.warp(frame), folder.preview(frame)]


def make_folders(folder: TakeFolder, spec: FrameSpec) -> None:
    """Creates a take's folder. JobError if it contains numbered pictures from elsewhere."""
    if not folder.state.is_file() and _numbers(folder):
        raise JobError(
            f"{folder.root} contains numbered pictures that Splannequin did not write.",
            "Choose another take name, or move them.",
            ExitCode.FREEZE,
        )
    _prepare(folder, spec)


def _prepare(folder: TakeFolder, spec: FrameSpec) -> None:
    """Creates the folders of a take's frames, and removes partially written files from them."""
    warps, deeps = [folder.warps] if spec.has_warps else [], [folder.deeps] if spec.deep is not None else []
    for used in (folder.root, folder.previews, *warps, *deeps):
        make_folder(used)
        sweep_half_written(used)


def frames_of(folder: TakeFolder) -> list[int]:
    """Numbers of the frames in a take's folder, ascending."""
    return _frames_in(folder.root.glob("*" + LAYERS))


def _numbers(folder: TakeFolder) -> list[int]:
    """Numbers of all frames of which any file exists, ascending."""
    folders = folder.root, folder.warps, folder.deeps
    files = [folder.previews.glob("*" + PICTURE), *(inner.glob("*" + LAYERS) for inner in folders)]
    return sorted({n for found in files for n in _frames_in(found)})


def _frames_in(paths: Iterable[Path]) -> list[int]:
    """Frame numbers of the files that are named like frames, ascending."""
    return sorted(n for p in paths if (n := frame_number(p.stem)) is not None)
