"""Compares the scene's render camera with the camera of the frozen take.

CG that is combined with a take by depth must be rendered from the take's camera in every frame. That camera is the
clip's solved camera or the artist's camera of the freeze. With any other camera the CG slides over the frozen picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...torch_backend import contract
from .. import compat
from ..scene import scene_setup
from ..shot import inventory, scene_objects, seen_camera
from . import freeze_group, placing

TOLERANCE_PX = 0.5
"""Largest allowed distance, in pixels of the render, between the projections of a scene point by the two cameras."""


def is_cg_linked(scene: bpy.types.Scene) -> bool:
    """True if a render of the scene is linked to the freeze group's CG input."""
    return bool(_layers(scene))


def check(scene: bpy.types.Scene, frames: Sequence[int]) -> bool:
    """True if CG is linked to the freeze. Raises JobError if the CG camera differs from the take's camera in any
    frame."""
    layers = _layers(scene)
    shown = freeze_group.shown(scene)
    if not layers or shown is None:
        return False
    for node in layers:
        rendered = node.scene or scene
        layer = next((one for one in rendered.view_layers if one.name == node.layer), None)
        if layer is None or not layer.use:
            raise contract.JobError(
                f"The view layer {node.layer} is linked into the freeze as CG but is not used for rendering.",
                "Enable it in the view layer's properties, or remove it from the compositor.",
                contract.ExitCode.BAKE,
            )
        why = difference(rendered, shown[0], frames)
        if why:
            right = matching_camera(rendered, shown[0], frames)
            hint = "Freeze a take from this camera, or unlink CG from the freeze."
            if right is not None:
                hint = f"Make {right.name} the scene's camera, or unlink CG from the freeze."
            raise contract.JobError(why, hint, contract.ExitCode.BAKE)
    return True


def difference(scene: bpy.types.Scene, take: Path, frames: Sequence[int], camera: str = "") -> str:
    """The difference between the scene's camera and the take's camera, as a sentence; empty if they agree.

    Args:
        scene: the scene. Its current frame is restored.
        take: folder of the take.
        frames: frames to compare. Frames that the take's camera lacks are skipped.
        camera: `name_full` of a camera of the scene; empty: the active camera, as markers switch it.

    Raises:
        contract.JobError: the camera of the take is unknown.
    """
    shot, before = take.parent.parent, scene.frame_current
    path = seen_from(shot, take.name)
    known = {frame.frame: frame for frame in path.frames}
    size, depth = scene_setup.render_size(scene), _typical_depth(shot, path)
    try:
        for number in (n for n in frames if n in known):
            try:
                seen = seen_camera.sampled(scene, camera, shot, number, size)
            except contract.JobError as error:
                return error.message
            away = _pixel_distance(seen, known[number], size, (path.width, path.height), depth)
            if not away <= TOLERANCE_PX:
                name = camera or (scene.camera.name if scene.camera is not None else "")
                pixels = min(away, 9999.0)  # infinite if the camera looks away
                return (
                    f"CG would slide: at frame {number} the camera {name} of {scene.name} differs by "
                    f"{pixels:.1f} px from "
                    f"the camera of take {take.name}."
                )
    finally:
        if scene.frame_current != before:
            scene.frame_set(before)
    return ""


def matching_camera(scene: bpy.types.Scene, take: Path, frames: Sequence[int]) -> bpy.types.Object | None:
    """The scene's camera that matches the take's camera. None without a match, or if markers switch cameras."""
    if any(marker.camera is not None for marker in scene.timeline_markers):
        return None
    some = [frames[0], frames[len(frames) // 2], frames[-1]]
    first = scene_objects.part(scene, take.parent.parent, "camera")
    every = sorted((o for o in scene.objects if o.type == "CAMERA"), key=lambda o: o != first)
    return next((camera for camera in every if not difference(scene, take, some, camera.name_full)), None)


def use_matching_camera(scene: bpy.types.Scene, take: Path, frames: Sequence[int]) -> list[str]:
    """Makes the matching camera the scene's active camera if the two differ. Returns a sentence for each change.

    Raises JobError if no camera matches.
    """
    why = difference(scene, take, frames)
    if not why:
        return []
    right = matching_camera(scene, take, frames)
    if right is None:
        raise contract.JobError(
            why,
            "No camera of this scene matches it. Restore the camera of the take, or freeze a take from the "
            "current camera.",
            contract.ExitCode.BAKE,
        )
    scene.camera = right
    return [f"{right.name} is now the scene's camera, because take {take.name} was frozen from it."]


def seen_from(shot: Path, take: str) -> contract.CameraPath:
    """The camera path of a take: the clip's or the artist's. Raises JobError if it is no longer known."""
    facts = inventory.read(shot).takes.get(take, {})
    file = seen_camera.path_of(shot, facts)
    try:
        path = contract.CameraPath.load(file or contract.ShotFolder(shot).cameras)
        if path.frames:
            return path
    except (OSError, ValueError):
        pass
    raise contract.JobError(
        f"The camera that take {take} was frozen from is no longer known.",
        "Freeze the take again, or solve the shot.",
        contract.ExitCode.BAKE,
    )


def _layers(scene: bpy.types.Scene) -> list[Any]:
    """The Render Layers nodes upstream of the freeze group's CG input."""
    tree = compat.compositor_tree(scene)
    node = freeze_group.group_node(tree) if tree is not None else None
    found: list[Any] = []
    for link in placing.links_of(node.inputs["CG"]) if node is not None and "CG" in node.inputs else ():
        found += [n for n in placing.upstream(link.from_node) if n.bl_idname == "CompositorNodeRLayers" and not n.mute]
    return found


def _pixel_distance(
    seen: contract.CameraFrame,
    wanted: contract.CameraFrame,
    size: tuple[int, int],
    taken: tuple[int, int],
    depth: float,
) -> float:
    """Largest distance in pixels between the projections of the same point by two cameras.

    The points project to the middle and the corners of `wanted`'s image.

    Args:
        seen: first camera, K in pixels of the render.
        wanted: second camera, K in pixels of the take.
        size: width and height of the render in pixels.
        taken: width and height of the take in pixels. The take is scaled to the render's width.
        depth: depth of the points, solve units.
    """
    (width, height), larger = size, size[0] / taken[0]
    fx, fy, cx, cy = wanted.K
    fx, fy, cx, cy = larger * fx, larger * fy, larger * cx, 0.5 * height + larger * (cy - 0.5 * taken[1])
    us, vs = (np.array([0.5, 0.0, 1.0, 0.0, 1.0]) * width, np.array([0.5, 0.0, 0.0, 1.0, 1.0]) * height)
    points = depth * np.stack([(us - cx) / fx, (vs - cy) / fy, np.ones(5)])
    seen_viewmat, wanted_viewmat = (np.array(frame.viewmat, dtype=np.float64).reshape(4, 4) for frame in (seen, wanted))
    world = wanted_viewmat[:3, :3].T @ (points - wanted_viewmat[:3, 3:])
    x, y, z = seen_viewmat[:3, :3] @ world + seen_viewmat[:3, 3:]
    if z.min() <= 0.0:
        return float("inf")  # behind the camera
    u, v = seen.K[0] * x / z + seen.K[2], seen.K[1] * y / z + seen.K[3]
    return float(np.hypot(u - us, v - vs).max())


def _typical_depth(shot: Path, path: contract.CameraPath) -> float:
    """Median depth of the solve's points from the first pose, solve units; 1 if they cannot be read."""
    try:
        with contract.open_arrays(contract.ShotFolder(shot).points) as source, np.load(source) as data:
            xyz = np.asarray(data["xyz"], dtype=np.float64)
        view = np.array(path.frames[0].viewmat, dtype=np.float64).reshape(4, 4)
        depth = float(np.median(xyz @ view[2, :3] + view[2, 3]))
        return depth if np.isfinite(depth) and depth > 1e-6 else 1.0
    except (OSError, ValueError, IndexError):
        return 1.0
