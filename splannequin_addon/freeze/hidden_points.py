"""Hides the shot's point cloud while the frozen instant is drawn over it. Saved files never contain the hidden state.

The scene stores which view layers were changed. Undo, a saved file, an autosave and a file left by a crash can
therefore all be repaired.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import bpy
from bpy.app.handlers import persistent

from ..access import holds, library_of, settings_of
from ..shot import scene_objects, selection

# Shot folder that is being scrubbed, or None.
_shot: Path | None = None


def begin(scene: bpy.types.Scene, shot: Path) -> None:
    """Hides the points of a shot in a scene until `end`."""
    global _shot
    _shot = shot
    _hide(scene, shot)


def end() -> None:
    """Shows the points that were hidden, in all scenes of the file. Points that the artist hid stay hidden."""
    global _shot
    _shot = None
    _restore()


def _hide(scene: bpy.types.Scene, shot: Path) -> None:
    """Hides the points of a shot in every view layer that shows them, and stores these layers."""
    entry, cloud = scene_objects.of(scene, shot), scene_objects.part(scene, shot, "points")
    if entry is None or cloud is None:
        return
    shown = [layer for layer in scene.view_layers if holds(layer.objects, cloud)]
    shown = [layer for layer in shown if not cloud.hide_get(view_layer=layer)]
    for layer in shown:
        cloud.hide_set(True, view_layer=layer)
    if shown:
        entry.points_hidden_in = json.dumps([layer.name for layer in shown])


@persistent
def _restore(*_: object) -> None:
    """Shows the points that `_hide` hid."""
    for scene in bpy.data.scenes:
        for entry in settings_of(scene).made if not library_of(scene) else ():
            cloud = entry.points
            if cloud is None or not entry.points_hidden_in:
                continue
            for layer in scene.view_layers:
                if layer.name in _names(entry.points_hidden_in) and holds(layer.objects, cloud):
                    cloud.hide_set(False, view_layer=layer)
            entry.points_hidden_in = ""


def _names(stored: str) -> list[str]:
    """View layers that `_hide` stored; empty if the file was edited by hand."""
    try:
        names: object = json.loads(stored)
    except ValueError:
        return []
    return [name for name in names if isinstance(name, str)] if isinstance(names, list) else []  # pyright: ignore[reportUnknownVariableType]


@persistent
def _update(*_: object) -> None:
    """Handler after a save, an undo or a file load: the points are hidden if and only if their shot is being
    scrubbed."""
    _restore()
    if _shot is not None:
        for scene in selection.scenes_of(_shot):
            _hide(scene, _shot)


def _handlers() -> list[tuple[Any, Any]]:
    """Pairs of (Blender's handler list, function) that are registered."""
    lists = bpy.app.handlers
    after = [lists.save_post, lists.save_post_fail, lists.undo_post, lists.redo_post, lists.load_post]
    # A file must never contain points that we hid, so they are shown before a save and hidden again after it.
    return [(lists.save_pre, _restore), *((one, _update) for one in after)]


def register() -> None:
    """Registers the handlers for save, undo and load."""
    for functions, function in _handlers():
        functions.append(function)


def unregister() -> None:
    """Shows the points and removes the handlers."""
    end()
    for functions, function in _handlers():
        functions.remove(function)
