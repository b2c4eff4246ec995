"""Where clip, shot folder and what was made from it lie: a folder that is moved as a whole goes on working.

The settings keep paths relative to the .blend once it is saved, as Blender keeps its own. Those of older files, which
kept them whole, are searched for beside the .blend when it is opened. A shot folder that was here and is gone is told
from one that is still to be made, and can be located.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy
from bpy.app.handlers import persistent

from ...torch_backend import contract
from ..access import library_of, settings_of
from ..scene import paths
from ..scene.ownership import BAKES, DIGITS, MATTE_SHOT, TAG
from . import inventory, scene_objects, selection
from .shot_state import ShotState

_SETTINGS = ("clip", "shot_path", "cameras_path", "st_map", "lut", "ignore_path", "people_path", "shot_seen")
"""Settings of a shot that hold a path."""
_OUTPUT = "filepath"
"""Of a scene's render settings: the output path, which may be ours."""
_saving: list[str] = []
"""Paths of `_holders` as they were before the save, to restore them after it."""


def source_of(state: ShotState) -> str:
    """The footage that a shot was imported from, where it is now: as it was named, or beside the shot, with which it
    was moved. Empty if it is in neither place."""
    named, beside = str(state.info.get("source", "")), state.beside
    candidates = [Path(named), state.folder.parent / re.split(r"[\\/]", named)[-1]]
    if beside:
        candidates.insert(1, state.folder / beside)
    return next((os.path.normpath(p) for p in candidates if named and _there(p)), "")


def locate(scene: bpy.types.Scene, folder: Path) -> None:
    """Makes `folder` the scene's shot, in place of one that was moved or renamed: what was made from that stays.

    Raises:
        contract.JobError: there is no shot in it.
    """
    try:
        state = inventory.read(folder)
    except (OSError, ValueError, KeyError) as error:
        raise contract.JobError(f"{folder} cannot be read: {error}", "", contract.ExitCode.USAGE) from error
    if not state.info:
        hint = "Choose the folder that holds shot.json; its name ends with .splannequin unless it was renamed."
        raise contract.JobError(f"{folder} is no shot folder.", hint, contract.ExitCode.USAGE)
    held, before = settings_of(scene), selection.folder_of(settings_of(scene))
    entry = scene_objects.of(scene, before) if before is not None else None
    if entry is not None and scene_objects.of(scene, folder) in (None, entry):
        entry.name, entry.folder = scene_objects.name_of(folder), paths.blend_path(folder)
    for image in bpy.data.images:
        path = Path(paths.absolute(image.filepath))
        if before is not None and image.get(TAG) and before in path.parents and not path.exists():
            image.filepath = paths.blend_path(folder / path.relative_to(before))
    for owner, name in _outside():
        path = Path(paths.absolute(_get(owner, name)))
        if before is not None and before in (path, _rendered_of(path)) and not before.exists():
            _set(owner, name, paths.blend_path(folder / path.relative_to(before)))
    held.shot_path = held.shot_seen = paths.blend_path(folder)
    source = source_of(state)
    if source and not (held.clip and _there(Path(paths.absolute(held.clip)))):
        held.clip = paths.blend_path(Path(source))


def _there(path: Path) -> bool:
    """True if footage is there: a file, a folder of pictures, or a pattern in a folder that is there."""
    return path.exists() or (contract.is_pattern(path.name) and path.parent.is_dir())


def _holders() -> Iterator[tuple[Any, str]]:
    """(owner, property) of every path of ours in the file."""
    for scene in [s for s in bpy.data.scenes if not library_of(s)]:
        held = settings_of(scene)
        for one in [held, *held.shots]:
            yield from ((one, name) for name in _SETTINGS)
        yield from ((entry, "folder") for entry in held.made)
    yield from _outside()


def _outside() -> Iterator[tuple[Any, str]]:
    """`_holders` beside our settings: output paths, the artist's too, and images that are painted on."""
    yield from ((scene.render, _OUTPUT) for scene in bpy.data.scenes)
    yield from ((i, MATTE_SHOT) for i in bpy.data.images if not i.library and isinstance(i.get(MATTE_SHOT), str))


def _get(owner: bpy.types.bpy_struct, name: str) -> str:
    """A path that an owner holds."""
    return str(owner[name] if isinstance(owner, bpy.types.Image) else getattr(owner, name))


def _set(owner: bpy.types.bpy_struct, name: str, path: str) -> None:
    """Has it hold another."""
    if isinstance(owner, bpy.types.Image):
        owner[name] = path
    else:
        setattr(owner, name, path)


def _rendered_of(path: Path) -> Path | None:
    """The shot whose take an output path of ours is for; None of the artist's own."""
    ours = path.name == DIGITS and len(path.parents) > 2 and path.parents[1].name == BAKES
    return path.parents[2] if ours else None


def _relative(path: str, base: str) -> str:
    """`path` as a .blend in the folder `base` should hold it."""
    return paths.relative(path, base) if path and base else path


@persistent
def _before_save(file: object = "", *_: object) -> None:
    """Paths become relative to where the file is being saved; with Blender's *Relative Paths* off only those that were
    relative to where it was."""
    _saving.clear()
    if not isinstance(file, str) or not file:  # the startup file
        return
    all_of_them = bpy.context.preferences.filepaths.use_relative_paths
    for owner, name in _holders():
        path = _get(owner, name)
        _saving.append(path)
        if name == _OUTPUT and not _known(Path(paths.absolute(path)), name):
            continue  # the artist's
        if path and (all_of_them or path.startswith("//")):
            _set(owner, name, _relative(paths.absolute(path), os.path.dirname(os.path.abspath(file))))


@persistent
def _after_save(file: str = "", *_: object) -> None:
    """A copy was saved, or nothing was: in the open file the paths stay as they were."""
    if file and _saving and os.path.abspath(file) != bpy.data.filepath:
        for (owner, name), path in zip(_holders(), _saving, strict=True):
            _set(owner, name, path)
    _saving.clear()


@persistent
def _after_load(*_: object) -> None:
    """What an older file names by its whole path, and is not there, is searched for beside the .blend."""
    if not bpy.data.filepath:
        return
    _read_backslashes()
    folder = Path(bpy.data.filepath).parent
    for owner, name in _holders():
        path = _get(owner, name)
        if not path or path.startswith("//") or _known(Path(paths.absolute(path)), name):
            continue
        words = re.split(r"[\\/]+", path)
        tails = [Path(*words[n:]) for n in range(1, len(words)) if words[n]]
        found = next(
            (base / tail for tail in tails for base in (folder, folder.parent) if _known(base / tail, name)), None
        )
        if found is not None:
            _set(owner, name, paths.blend_path(found))


def _read_backslashes() -> None:
    """Relative paths of a file that was saved on Windows get slashes elsewhere, as Blender reads its own."""
    if os.sep == "\\":
        return
    for owner, name in _holders():
        path = _get(owner, name)
        slashed = _slashed(path)
        if slashed != path and (name != _OUTPUT or _known(Path(paths.absolute(slashed)), name)):
            _set(owner, name, slashed)
    for image in bpy.data.images:
        if image.get(TAG) and not image.library and _slashed(image.filepath) != image.filepath:
            image.filepath = _slashed(image.filepath)


def _slashed(path: str) -> str:
    """A relative path with slashes. Other paths, and names of existing files, stay: a file name may hold
    backslashes."""
    if not path.startswith("//") or "\\" not in path or os.path.lexists(paths.absolute(path)):
        return path
    return path.replace("\\", "/")


def _known(path: Path, name: str) -> bool:
    """True if what the setting `name` is about is there; of a clip its shot is enough."""
    try:
        if name in ("clip", "cameras_path", "st_map", "lut", "ignore_path", "people_path"):
            return _there(path) or (name == "clip" and contract.ShotFolder(selection.beside(path)).info_path.is_file())
        shot = _rendered_of(path) if name == _OUTPUT else path
        return shot is not None and contract.ShotFolder(shot).info_path.is_file()
    except OSError:
        return False


_HANDLERS = (
    ("save_pre", _before_save),
    ("save_post", _after_save),
    ("save_post_fail", _after_save),
    ("load_post", _after_load),
)


def register() -> None:
    """Listens to saving and loading; before the job timer, which looks at the shots of a file once it is loaded."""
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).append(handler)


def unregister() -> None:
    """Undoes `register`."""
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).remove(handler)
