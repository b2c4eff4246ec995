"""Changes to the scene after an import."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ...torch_backend import contract
from ..access import settings_of
from ..scene import scene_setup
from ..shot import inventory, selection
from ..shot.shot_state import ShotState
from . import plate

if TYPE_CHECKING:
    import bpy


def imported(scene: bpy.types.Scene, shot: Path) -> list[str]:
    """Sets up the scene after an import and adds the clip's camera. Returns the changes as sentences.

    The scene gets the clip's size, rate and range if it is new or if the artist allows it.
    """
    state = inventory.read(shot)
    props = settings_of(scene)
    selection.see(scene, state)
    first, last = state.frame_range
    if not first <= props.t_star <= last:
        props.t_star = min(max(scene.frame_current, first), last)
    changes, camera = fit(scene, state), plate.show(scene, shot)
    if camera is not None:
        changes.append(f"{camera.name} shows the clip until the camera is solved.")
    return changes


def fit(scene: bpy.types.Scene, state: ShotState, force_k: bool = False) -> list[str]:
    """Sets the scene's size, rate and range to the clip's, if the artist allows it. Returns the changes as sentences.

    With `force_k`, the size and intrinsics are those of the solved plates.
    """
    props = settings_of(scene)
    if not (props.set_up_scene or scene_setup.untouched(scene) or scene_setup.fitted(scene)):
        return ["The scene's resolution and frame range were not changed (Fit Scene to Clip is off)."]
    size, k = state.size, None
    if force_k:
        path = contract.CameraPath.load(contract.ShotFolder(state.folder).cameras)
        size = (path.width, path.height)
        k = (path.frames[0].K[0], path.frames[0].K[1], path.frames[0].K[2], path.frames[0].K[3])
    fps = float(state.info.get("fps", 0.0))
    return scene_setup.fit_clip(scene, size, fps, state.frame_range, k, props.set_up_scene)
