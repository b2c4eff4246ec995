"""The take that a scene's compositor shows, and whether its depth matches the scene's scale."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ...torch_backend import contract
from ..shot import scene_objects
from . import freeze_group

if TYPE_CHECKING:
    import bpy


def shown(scene: bpy.types.Scene, shot: Path) -> str:
    """Name of this shot's take that the scene's compositor shows; empty without one, or for another shot's take."""
    found = freeze_group.shown(scene)
    return found[0].name if found is not None and found[0].parent == contract.ShotFolder(shot).takes else ""


def stale_scale(scene: bpy.types.Scene, shot: Path) -> bool:
    """True if the shot was scaled since its take was inserted, so that the compositor's depth does not match the
    scene."""
    found = freeze_group.shown(scene)
    if found is None or not shown(scene, shot):
        return False
    scale = scene_objects.depth_scale(scene, shot)
    return abs(found[1] - scale) > 1e-4 * scale


def follow_scale(scene: bpy.types.Scene, shot: Path) -> list[str]:
    """Sets the depth factor in the compositor to the shot's scale. Returns the changes as sentences."""
    if not stale_scale(scene, shot):
        return []
    freeze_group.set_depth_scale(scene, scene_objects.depth_scale(scene, shot))
    return ["Depth in the compositor follows the new scale."]
