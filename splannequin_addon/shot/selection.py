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

_T_STAR = "splannequin.t_star"
"""Data path of the only setting that can have keyframes."""
_ITEMS_OWN = ("rna_type", "name", "scene_settings")
"""Properties of a list item that are not settings of a shot."""
_LOOK_SECONDS = 1.0
_switching = False
_beside: dict[Path, tuple[float, Path]] = {}
"""Clip -> (time of the lookup in monotonic seconds, shot folder)."""


def names() -> list[str]:
    """Names of the settings that belong to a shot."""
    held: Any = bpy.types.Scene.bl_rna.properties["splannequin"]
    rna = held.fixed_type.properties["shots"].fixed_type
    return [one.identifier for one in rna.properties if one.identifier not in _ITEMS_OWN]


def folder_of(one: OneShot) -> Path | None:
    """Shot folder of the settings; None if neither a folder nor a clip is selected."""
    if one.shot_path:
        return Path(os.path.abspath(bpy.path.abspath(one.shot_path)))
    if not one.clip:
        return None
    return beside(Path(os.path.abspath(bpy.path.abspath(one.clip))))


def beside(clip: Path) -> Path:
    """Cached `contract.default_shot_folder`, looked up once a second, because it is called at every redraw."""
    found = _beside.get(clip)
    if found is None or time.monotonic() - found[0] > _LOOK_SECONDS:
        found = _beside[clip] = (time.monotonic(), contract.default_shot_folder(clip, source.is_of))
    return found[1]


def look_again() -> None:
    """Clears the cache of `beside`, because a shot may have been imported."""
    _beside.clear()


def settings(scene: bpy.types.Scene) -> list[OneShot]:
    """Settings of all shots of a scene in list order. The scene holds the settings of the selected shot."""
    held = settings_of(scene)
    return [held if i == held.loaded_shot else item for i, item in enumerate(held.shots)] or [held]


def folders(scene: bpy.types.Scene) -> list[Path | None]:
    """Shot folders in order, None for a shot without a clip."""
    return [folder_of(one) for one in settings(scene)]


def labels(scene: bpy.types.Scene) -> list[str]:
    """Display names of a scene's shots: the folder names, with the parent folder where two names are equal."""
    found = folders(scene)
    called = [scene_objects.name_of(folder) if folder is not None else "New shot" for folder in found]
    return [
        f"{name} ({_apart(folder, [o for o, other in zip(found, called, strict=True) if other == name and o])})"
        if folder is not None and called.count(name) > 1
        else name
        for folder, name in zip(found, called, strict=True)
    ]


def _apart(folder: Path, among: list[Path | None]) -> str:
    """The shortest end of a folder's parent path that differs from all others in `among`; the whole path if there is
    none."""
    others = [other.parent.parts for other in among if other is not None and other != folder]
    parts = folder.parent.parts
    for count in range(1, len(parts)):
        if all(other[-count:] != parts[-count:] for other in others):
            return "/".join(parts[-count:])
    return str(folder.parent)


def add(scene: bpy.types.Scene) -> None:
    """Appends a shot with default settings and selects it."""
    held = settings_of(scene)
    if not len(held.shots):
        _copy(held, held.shots.add())
        held.loaded_shot = 0
    held.shots.add()
    held.active_shot = len(held.shots) - 1  # the update callback calls `choose`
    choose(scene, held.active_shot)


def choose(scene: bpy.types.Scene, index: int) -> None:
    """Selects a shot: its settings replace the scene's, and its camera, if loaded, becomes the active camera."""
    held = settings_of(scene)
    if not len(held.shots):
        return
    index, before = min(max(index, 0), len(held.shots) - 1), held.loaded_shot
    if index != before:
        _copy(held, held.shots[before])
        held.shots[before].scene_settings = scene_setup.kept(scene)
        _copy(held.shots[index], held)
        held.loaded_shot = index
        scene_setup.put_back(scene, held.shots[index].scene_settings)
        _rename(scene, {_T_STAR: _path(before), _path(index): _T_STAR})
        folder = folder_of(held)
        camera = scene_objects.part(scene, folder, "camera") if folder is not None else None
        if camera is not None:
            scene.camera = camera
    if held.active_shot != index:
        held.active_shot = index


def remove(scene: bpy.types.Scene, index: int) -> None:
    """Removes a shot and its t* keyframes from the list and selects a neighbour. Requires two or more shots."""
    held = settings_of(scene)
    if index == held.loaded_shot:
        choose(scene, index + 1 if index + 1 < len(held.shots) else index - 1)
    chosen = held.loaded_shot
    compat_animation.remove_fcurves(scene, _path(index))
    _rename(scene, {_path(i): _path(i - 1) for i in range(index + 1, len(held.shots))})
    held.shots.remove(index)
    held.loaded_shot = held.active_shot = chosen - 1 if chosen > index else chosen
    if len(held.shots) == 1:
        held.shots.clear()
        held.loaded_shot = held.active_shot = 0


def _path(index: int) -> str:
    return f"splannequin.shots[{index}].t_star"


def is_switching() -> bool:
    """True while the settings of the selected shot are being replaced."""
    return _switching


def _copy(one: OneShot, other: OneShot) -> None:
    """Copies the settings of a shot. Unset properties stay unset."""
    global _switching
    _switching = True
    try:
        for name in names():
            if one.is_property_set(name):
                setattr(other, name, getattr(one, name))
            else:
                other.property_unset(name)
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
    folder, held = folder_of(settings_of(scene)), settings_of(scene)
    is_shot = folder is not None and state is not None and state.frames and state.folder == folder
    if folder is not None and is_shot and paths.absolute(held.shot_seen) != str(folder):
        held.shot_seen = paths.blend_path(folder)
