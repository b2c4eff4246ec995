"""Locations of the clip, the shot folder and its results. A folder that is moved as a whole keeps working.

Settings store paths relative to the .blend once it is saved, as Blender does. Older files stored absolute paths. When
such a file is opened, missing paths are searched for near the .blend. A missing shot folder can be located. The panel
distinguishes it from a folder that has not been created yet.
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
from .. import compat
from ..access import library_of, settings_of
from ..scene import paths
from ..scene.ownership import MATTE_SHOT, TAG, rendered_of
from . import inventory, scene_objects, selection
from .shot_state import ShotState

# Settings of a shot that are paths.
_SETTINGS = ("clip", "shot_path", "cameras_path", "st_map", "lut", "ignore_path", "people_path", "depth", "shot_seen")
# Property of the scene's render settings: the output path, which may be ours.
_OUTPUT = "filepath"
# Paths of `_holders` from before the save, to be restored after it.
_saving: list[str] = []


def source_of(state: ShotState) -> str:
    """The current location of the footage that a shot was imported from: as stored, or next to the moved shot.

    Empty if the footage is in neither place.
    """
    named, relative_source = str(state.info.get("source", "")), state.relative_source
    candidates = [Path(named), state.folder.parent / re.split(r"[\\/]", named)[-1]]
    if relative_source:
        candidates.insert(1, state.folder / relative_source)
    return next((os.path.normpath(p) for p in candidates if named and _exists(p)), "")


def locate(scene: bpy.types.Scene, folder: Path) -> None:
    """Makes `folder` the scene's shot and replaces one that was moved or renamed. The shot's objects in the scene stay.

    Raises:
        contract.JobError: the folder contains no shot.
    """
    try:
        state = inventory.read(folder)
    except (OSError, ValueError, KeyError) as error:
        raise contract.JobError(f"{folder} cannot be read: {error}", "", contract.ExitCode.USAGE) from error
    if not state.info:
        hint = "Choose the folder that contains shot.json. Its name ends with .splannequin unless it was renamed."
        raise contract.JobError(f"{folder} is not a shot folder.", hint, contract.ExitCode.USAGE)
    props, before = settings_of(scene), selection.folder_of(settings_of(scene))
    entry = scene_objects.of(scene, before) if before is not None else None
    if entry is not None and scene_objects.of(scene, folder) in (None, entry):
        entry.name, entry.folder = scene_objects.name_of(folder), paths.blend_path(folder)
    for image in bpy.data.images:
        path = Path(paths.absolute(image.filepath))
        ours = image.get(TAG) and not image.library
        if before is not None and ours and before in path.parents and not path.exists():
            image.filepath = paths.blend_path(folder / path.relative_to(before))
    for owner, name in _outside():
        path = Path(paths.absolute(_get(owner, name)))
        if before is None or before.exists():
            continue
        if path == before:
            _set(owner, name, paths.blend_path(folder))
        elif before == rendered_of(Path(compat.unescaped(str(path)))):
            _set(owner, name, compat.literal(paths.blend_path(folder / path.relative_to(path.parents[2]))))
    props.shot_path = props.shot_seen = paths.blend_path(folder)
    source = source_of(state)
    if source and not (props.clip and _exists(Path(paths.absolute(props.clip)))):
        props.clip = paths.blend_path(Path(source))


def _exists(path: Path) -> bool:
    """True if footage exists: a file, a folder of images, or a pattern in an existing folder."""
    return path.exists() or (contract.is_pattern(path.name) and path.parent.is_dir())


def _holders() -> Iterator[tuple[Any, str]]:
    """(owner, property) of every path of ours in the file."""
    for scene in [s for s in bpy.data.scenes if not library_of(s)]:
        yield from _holders_in(scene)
    yield from _outside()


def _holders_in(scene: bpy.types.Scene) -> Iterator[tuple[Any, str]]:
    """`_holders` in the settings of a scene."""
    props = settings_of(scene)
    for one in [props, *props.shots]:
        yield from ((one, name) for name in _SETTINGS)
    yield from ((entry, "folder") for entry in props.made)


def _outside() -> Iterator[tuple[Any, str]]:
    """`_holders` outside our settings: output paths, including the artist's, and painted images."""
    yield from ((scene.render, _OUTPUT) for scene in bpy.data.scenes)
    yield from ((i, MATTE_SHOT) for i in bpy.data.images if not i.library and isinstance(i.get(MATTE_SHOT), str))


def _get(owner: bpy.types.bpy_struct, name: str) -> str:
    """The path in an owner's property."""
    return str(owner[name] if isinstance(owner, bpy.types.Image) else getattr(owner, name))


def _set(owner: bpy.types.bpy_struct, name: str, path: str) -> None:
    """Sets the path in an owner's property."""
    if isinstance(owner, bpy.types.Image):
        owner[name] = path
    else:
        setattr(owner, name, path)


def _relative(path: str, base: str) -> str:
    """`path` in the form stored in a .blend in the folder `base`."""
    return paths.relative(path, base) if path and base else path


@persistent
def _before_save(file: object = "", *_: object) -> None:
    """Handler: makes paths relative to the folder of the save.

    Without Blender's *Relative Paths*, changes only paths that were relative before.
    """
    _saving.clear()
    if not isinstance(file, str) or not file:  # the startup file
        return
    all_of_them = bpy.context.preferences.filepaths.use_relative_paths
    for owner, name in _holders():
        path = _get(owner, name)
        _saving.append(path)
        if name == _OUTPUT and not _known(Path(paths.absolute(path)), name):
            continue  # the artist's path
        if path and (all_of_them or path.startswith("//")):
            _set(owner, name, _relative(paths.absolute(path), os.path.dirname(os.path.abspath(file))))


@persistent
def _after_save(file: str = "", *_: object) -> None:
    """Handler: restores the paths of the open file after a copy was saved, or after a save failed."""
    if file and _saving and os.path.abspath(file) != bpy.data.filepath:
        for (owner, name), path in zip(_holders(), _saving, strict=True):
            _set(owner, name, path)
    _saving.clear()


@persistent
def _after_load(*_: object) -> None:
    """Handler: searches near the .blend for missing files that an older .blend stores with absolute paths."""
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


@persistent
def _after_import(context: bpy.types.BlendImportContext, *_: object) -> None:
    """Handler: relative paths of appended data started at the file that they come from."""
    for item in context.import_items:
        block = item.id
        if item.append_action not in ("MAKE_LOCAL", "COPY_LOCAL") or item.source_library is None:
            continue
        holders: list[tuple[Any, str]] = list(_holders_in(block)) if isinstance(block, bpy.types.Scene) else []
        if isinstance(block, bpy.types.Image) and isinstance(block.get(MATTE_SHOT), str):
            holders.append((block, MATTE_SHOT))
        origin = os.path.dirname(bpy.path.abspath(item.source_library.filepath))
        for owner, name in holders:
            path = _get(owner, name)
            if path.startswith("//"):
                _set(owner, name, paths.blend_path(Path(bpy.path.abspath(path, start=origin))))


def _read_backslashes() -> None:
    """Converts relative paths of a file saved on Windows to slashes on other systems, as Blender does with its
    paths."""
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
    """A relative path with slashes. Other paths and existing files stay unchanged: a file name may contain
    backslashes."""
    if not path.startswith("//") or "\\" not in path or os.path.lexists(paths.absolute(path)):
        return path
    return path.replace("\\", "/")


def _known(path: Path, name: str) -> bool:
    """True if the file or folder of the setting `name` exists. For a clip, its shot is sufficient."""
    try:
        if name in ("clip", "cameras_path", "st_map", "lut", "ignore_path", "people_path", "depth"):
            return _exists(path) or (
                name == "clip" and contract.ShotFolder(selection.folder_of_clip(path)).info_path.is_file()
            )
        shot = rendered_of(Path(compat.unescaped(str(path)))) if name == _OUTPUT else path
        return shot is not None and contract.ShotFolder(shot).info_path.is_file()
    except OSError:
        return False


_HANDLERS = (
    ("save_pre", _before_save),
    ("save_post", _after_save),
    ("save_post_fail", _after_save),
    ("load_post", _after_load),
    *((("blend_import_post", _after_import),) if hasattr(bpy.app.handlers, "blend_import_post") else ()),  # 4.3 on
)


def register() -> None:
    """Registers the handlers. Must run before the job timer's registration."""
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).append(handler)


def unregister() -> None:
    """Undoes `register`."""
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).remove(handler)
