"""Several shots in one scene. The scene's settings are those of the selected shot; the other shots are in a list.

With a single shot the list is empty. The list item of the selected shot is outdated. Its current values are in the
scene's settings, and are copied back when another shot is selected. The same applies to the scene's size, rate and
range, if a shot has set them.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from .. import compat_animation
from ..access import OneShot, library_of, settings_of
from ..scene import paths, scene_setup
from . import scene_objects, source
from .shot_state import ShotState

# Data path of the only setting that can have keyframes.
_T_STAR = "splannequin.t_star"
# Properties of a list item that are not settings of a shot.
_NOT_SETTINGS = ("rna_type", "name", "scene_settings")
_LOOK_SECONDS = 1.0
_switching = False
# Clip -> (time of the lookup in monotonic seconds, shot folder).
_clip_folders: dict[Path, tuple[float, Path]] = {}


def names() -> list[str]:
    """Names of the settings that belong to a shot."""
    untyped: Any = bpy.types.Scene.bl_rna.properties["splannequin"]
    rna = untyped.fixed_type.properties["shots"].fixed_type
    return [one.identifier for one in rna.properties if one.identifier not in _NOT_SETTINGS]


def folder_of(one: OneShot) -> Path | None:
    """Shot folder of the settings; None if neither a folder nor a clip is selected."""
    if one.shot_path:
        return Path(os.path.abspath(bpy.path.abspath(one.shot_path)))
    if not one.clip:
        return None
    return folder_of_clip(Path(os.path.abspath(bpy.path.abspath(one.clip))))


def folder_of_clip(clip: Path) -> Path:
    """Cached `contract.default_shot_folder`, looked up once a second."""
    # Every redraw of the panel calls this.
    found = _clip_folders.get(clip)
    if found is None or time.monotonic() - found[0] > _LOOK_SECONDS:
        found = _clip_folders[clip] = (time.monotonic(), contract.default_shot_folder(clip, source.is_of))
    return found[1]


def clear_cache() -> None:
    """Clears the cache of `folder_of_clip`, because a shot may have been imported."""
    _clip_folders.clear()


def settings(scene: bpy.types.Scene) -> list[OneShot]:
    """Settings of all shots of a scene in list order. The scene holds the settings of the selected shot."""
    props = settings_of(scene)
    return [props if i == props.loaded_shot else item for i, item in enumerate(props.shots)] or [props]


def folders(scene: bpy.types.Scene) -> list[Path | None]:
    """Shot folders in order, None for a shot without a clip."""
    return [folder_of(one) for one in settings(scene)]


def labels(scene: bpy.types.Scene) -> list[str]:
    """Display names of a scene's shots: the folder names, with the parent folder where two names are equal."""
    found = folders(scene)
    called = [scene_objects.name_of(folder) if folder is not None else "New shot" for folder in found]
    return [
        f"{name} ({_parent_suffix(folder, [f for f, label in zip(found, called, strict=True) if f and label == name])})"
        if folder is not None and called.count(name) > 1
        else name
        for folder, name in zip(found, called, strict=True)
    ]


def _parent_suffix(folder: Path, candidates: list[Path | None]) -> str:
    """The shortest end of a folder's parent path that differs from all others in `candidates`; the whole path if there
    is none."""
    parents = [path.parent.parts for path in candidates if path is not None and path != folder]
    parts = folder.parent.parts
    for count in range(1, len(parts)):
        if all(parent[-count:] != parts[-count:] for parent in parents):
            return "/".join(parts[-count:])
    return str(folder.parent)


def add(scene: bpy.types.Scene) -> None:
    """Appends a shot with default settings and selects it."""
    props = settings_of(scene)
    if not len(props.shots):
        _copy(props, props.shots.add())
        props.loaded_shot = 0
    props.shots.add()
    props.active_shot = len(props.shots) - 1  # the update callback calls `choose`
    choose(scene, props.active_shot)


def choose(scene: bpy.types.Scene, index: int) -> None:
    """Selects a shot: its settings replace the scene's, and its camera, if loaded, becomes the active camera."""
    props = settings_of(scene)
    if not len(props.shots):
        return
    index, before = min(max(index, 0), len(props.shots) - 1), props.loaded_shot
    if index != before:
        _copy(props, props.shots[before])
        props.shots[before].scene_settings = scene_setup.kept(scene)
        _copy(props.shots[index], props)
        props.loaded_shot = index
        scene_setup.put_back(scene, props.shots[index].scene_settings)
        _rename(scene, {_T_STAR: _path(before), _path(index): _T_STAR})
        folder = folder_of(props)
        camera = scene_objects.part(scene, folder, "camera") if folder is not None else None
        if camera is not None:
            scene.camera = camera
    if props.active_shot != index:
        props.active_shot = index


def remove(scene: bpy.types.Scene, index: int) -> None:
    """Removes a shot and its t* keyframes from the list and selects a neighbour. Requires two or more shots."""
    props = settings_of(scene)
    if index == props.loaded_shot:
        choose(scene, index + 1 if index + 1 < len(props.shots) else index - 1)
    chosen = props.loaded_shot
    compat_animation.remove_fcurves(scene, _path(index))
    _rename(scene, {_path(i): _path(i - 1) for i in range(index + 1, len(props.shots))})
    props.shots.remove(index)
    props.loaded_shot = props.active_shot = chosen - 1 if chosen > index else chosen
    if len(props.shots) == 1:
        props.shots.clear()
        props.loaded_shot = props.active_shot = 0


def _path(index: int) -> str:
    return f"splannequin.shots[{index}].t_star"


def is_switching() -> bool:
    """True while the settings of the selected shot are being replaced."""
    return _switching


def _copy(origin: OneShot, target: OneShot) -> None:
    """Copies the settings of a shot. Unset properties stay unset."""
    global _switching
    # Assignments call the settings' update functions, which must not react as to the artist's edits.
    _switching = True
    try:
        for name in names():
            if origin.is_property_set(name):
                setattr(target, name, getattr(origin, name))
            else:
                target.property_unset(name)
    finally:
        _switching = False


def _rename(scene: bpy.types.Scene, paths: Mapping[str, str]) -> None:
    """Changes data paths of the scene's F-curves and drivers, all at once."""
    drivers = scene.animation_data.drivers if scene.animation_data is not None else ()
    for curve in [*compat_animation.fcurves(scene), *drivers]:
        if curve.data_path in paths:
            curve.data_path = paths[curve.data_path]


def shot_folder(scene: bpy.types.Scene) -> Path | None:
    """Folder of the scene's selected shot; None if neither a folder nor a clip is selected."""
    return folder_of(settings_of(scene))


def scenes_of(shot: Path) -> list[bpy.types.Scene]:
    """Scenes of the file with this shot selected. Excludes scenes linked from another file."""
    return [s for s in bpy.data.scenes if not library_of(s) and shot_folder(s) == shot]


def scenes_with(shot: Path) -> list[bpy.types.Scene]:
    """Scenes of the file with this shot, selected or not. Excludes scenes linked from another file."""
    return [s for s in bpy.data.scenes if not library_of(s) and shot in folders(s)]


def missing(scene: bpy.types.Scene, state: ShotState | None) -> bool:
    """True if the scene's shot existed before and its folder is missing now."""
    folder = folder_of(settings_of(scene))
    if folder is None or (state is not None and state.info):
        return False
    return paths.absolute(settings_of(scene).shot_seen) == str(folder) or scene_objects.of(scene, folder) is not None


def see(scene: bpy.types.Scene, state: ShotState | None) -> None:
    """Records that the scene's shot exists, so that `missing` can detect its loss."""
    folder, props = folder_of(settings_of(scene)), settings_of(scene)
    is_shot = folder is not None and state is not None and state.frames and state.folder == folder
    if folder is not None and is_shot and paths.absolute(props.shot_seen) != str(folder):
        props.shot_seen = paths.blend_path(folder)
