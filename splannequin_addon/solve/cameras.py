"""The solve in Blender: an animated camera with the plate in the background, and points.

An Empty, the root, is the parent of both and carries the solve-to-scene transform. Moving it moves camera and points
together, and its scale converts depth to scene units.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix, Quaternion

from ...torch_backend import contract
from .. import compat_animation
from ..access import camera_of, library_of, mesh_of, present
from ..scene import axes, rollback, sequences
from ..scene.ownership import TAG
from ..shot import inventory, scene_objects
from . import alignment, guesses

# Properties of camera data that get keyframes if the lens changes.
_LENS = ("lens", "shift_x", "shift_y")
# Initial clip distances of a new camera: an empty range, which `_reach` extends.
_NO_REACH = (1e6, 1e-6)
# Type of our objects -> attribute of the shot's entry, see `scene_objects.PARTS`.
_PARTS = {"EMPTY": "root", "CAMERA": "camera", "MESH": "points"}


def scene_from_solve(
    path: contract.CameraPath, points: np.ndarray, floor: tuple[Sequence[float], float] | None = None
) -> np.ndarray:
    """Initial solve-to-scene transform: floor at z = 0, cameras upright, shot around the origin.

    Without a floor, the mean of the cameras' up directions is up, and the lowest points are the floor.

    Args:
        path: the solved cameras, solve units.
        points: sparse points, [P, 3], solve units.
        floor: (normal, height) of the floor, with normal . x = height for its points x; None if unknown.

    Returns:
        [4, 4] float64, rotation and translation, no scale.
    """
    matrices = axes.poses(path)
    up = matrices[:, :3, 1].mean(axis=0)
    forward = -matrices[:, :3, 2].mean(axis=0)
    up = up / max(float(np.linalg.norm(up)), 1e-9)
    up = up if floor is None else np.array(floor[0], dtype=np.float64)
    heading = forward - up * float(forward @ up)
    if np.linalg.norm(heading) < 1e-6:  # looking straight up or down
        heading = np.cross(up, np.roll(up, 1))
    heading = heading / np.linalg.norm(heading)
    rotation = np.stack([np.cross(heading, up), heading, up])  # scene x, y, z in solve coordinates
    seen = (points if len(points) else matrices[:, :3, 3]) @ rotation.T
    centre = alignment.middle(seen)
    centre[2] = np.sort(seen[:, 2])[len(seen) // 50] if floor is None else floor[1]
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = rotation, -centre
    return result


def build(scene: bpy.types.Scene, shot: Path) -> bpy.types.Object:
    """Loads the solve of a shot into the scene: collection, root Empty, animated camera with plate, point cloud.

    Objects from an earlier call for the same shot are updated to the new solve. They keep their children, links and
    settings. The root keeps its transform, unless the solve's coordinates changed between the scene's world and an
    arbitrary world.

    Args:
        scene: the scene. Of its settings, only the active camera is changed.
        shot: shot folder with a finished solve.

    Returns:
        The camera object.

    Raises:
        FileNotFoundError: there is no solve.
        ValueError: a file of the solve is damaged, or Blender cannot show the plate. The scene is then unchanged.
    """
    path = contract.CameraPath.load(contract.ShotFolder(shot).cameras)
    xyz, rgb = points_of(shot)
    floor, unsolved = inventory.floor(shot), guesses.ranges(path, guesses.solved(shot, path))
    name = scene_objects.name_of(shot)
    with rollback.scene_of(scene):
        # Everything that can fail comes before changes to existing objects.
        world, size, plate = inventory.solve_world(shot), _extent(path), _plate(shot)
        pose = np.eye(4) if world else scene_from_solve(path, xyz, floor)
        mesh = _point_mesh(f"{name} points", xyz, rgb)
        kept = {n: item for n in ("camera", "points") if (item := _editable(scene, shot, n)) is not None}
        _clear(scene, shot, exclude=("root", *kept))  # the root stays, with its children and transform
        root = _root(scene, shot, pose, size)
        if present(scene_objects.of(scene, shot)).world != world:
            present(scene_objects.of(scene, shot)).world = world
            root.matrix_world = Matrix(pose.tolist())
        camera = kept.get("camera") or _new_camera(name, size)
        cloud = kept.get("points") or _new_points(name, mesh)
        _place(scene, shot, root, [item for item in (camera, cloud) if item not in kept.values()])
        present(scene_objects.of(scene, shot)).camera = camera
        present(scene_objects.of(scene, shot)).points = cloud
        _animate(camera, path)
        _show_plate(camera_of(camera), plate)
        _reach(camera_of(camera), *(v * scene_objects.depth_scale(scene, shot) for v in _clip(path, xyz)))
        _exchange_mesh(cloud, mesh)
        guesses.mark(scene, shot, unsolved)
        scene_objects.keep_camera(scene)
        scene.camera = camera
    return camera


def _editable(scene: bpy.types.Scene, shot: Path, name: str) -> bpy.types.Object | None:
    """The camera or the points of a shot; None if missing or linked from another file."""
    item = scene_objects.part(scene, shot, name)
    return item if item is not None and not library_of(item) and not library_of(present(item.data)) else None


def _root(scene: bpy.types.Scene, shot: Path, pose: np.ndarray, size: float) -> bpy.types.Object:
    """The root of a shot in its collection. Both are created if missing.

    Args:
        shot: shot folder.
        pose: transform of a new root, [4, 4].
        size: display size of a new root.
    """
    name, entry = scene_objects.name_of(shot), scene_objects.new(scene, shot)
    collection = scene_objects.own_collection(scene, shot)
    root = scene_objects.part(scene, shot, "root")
    if root is None:
        root = entry.root = bpy.data.objects.new(f"{name} root", None)
        root.empty_display_type = "ARROWS"
        root.matrix_world = Matrix(pose.tolist())
        root.empty_display_size = size
        collection.objects.link(root)
    for item in (scene_objects.part(scene, shot, "camera"), scene_objects.part(scene, shot, "points")):
        if item is not None and item.parent is None:  # its previous root was deleted
            item.parent, item.matrix_parent_inverse = root, Matrix()
    return root


def _place(scene: bpy.types.Scene, shot: Path, root: bpy.types.Object, items: Sequence[bpy.types.Object]) -> None:
    """Adds new objects of a shot to the scene, under its root."""
    collection = present(present(scene_objects.of(scene, shot)).collection)
    for item in items:
        collection.objects.link(item)
        item.parent = root


def _new_camera(name: str, size: float) -> bpy.types.Object:
    """A camera without keyframes or plate, not yet in a scene."""
    data = bpy.data.cameras.new(f"{name} camera")
    data.display_size = max(size * 0.5, 0.05)
    data.clip_start, data.clip_end = _NO_REACH
    return bpy.data.objects.new(f"{name} camera", data)


def _new_points(name: str, mesh: bpy.types.Mesh) -> bpy.types.Object:
    """The sparse points as an object, not yet in a scene."""
    cloud = bpy.data.objects.new(f"{name} points", mesh)
    mesh.name = cloud.name
    cloud.hide_render = cloud.hide_select = True
    cloud.display_type = "BOUNDS"  # Blender draws loose points in black, so solve/points.py draws them in colour
    return cloud


def _exchange_mesh(cloud: bpy.types.Object, mesh: bpy.types.Mesh) -> None:
    """Replaces an object's mesh and keeps the materials. An artist's copy of the object keeps the old mesh."""
    old = mesh_of(cloud)
    if old == mesh:
        return
    for material in old.materials:
        mesh.materials.append(material)
    cloud.data = mesh
    name = old.name
    if old.users <= int(old.use_fake_user):
        bpy.data.meshes.remove(old)
        mesh.name = name


def find(scene: bpy.types.Scene, shot: Path, kind: str) -> bpy.types.Object | None:
    """An object of a shot in a scene: kind is "EMPTY" (the root), "CAMERA" or "MESH" (the points). Never an artist's
    copy."""
    return scene_objects.part(scene, shot, _PARTS[kind])


def remove(scene: bpy.types.Scene, shot: Path) -> bool:
    """Removes everything that `build` made from the file. True if there was something.

    Objects that the artist parented to the root or put into the collection keep their location in the scene.
    """
    if scene_objects.of(scene, shot) is None:
        return False
    was, ours = scene.camera is not None, scene.camera == scene_objects.part(scene, shot, "camera")
    _clear(scene, shot)
    scene_objects.drop(scene, shot)
    if was and ours:
        scene_objects.restore_camera(scene)
    return True


def _clear(scene: bpy.types.Scene, shot: Path, exclude: tuple[str, ...] = ()) -> None:
    """Removes the objects of a shot, except for the named parts. With any named part, the collection also stays."""
    entry = scene_objects.of(scene, shot)
    if entry is None:
        return
    guesses.unmark(scene, shot)
    for item in [getattr(entry, name) for name in scene_objects.PARTS if name not in exclude]:
        if item is None or (item.users_scene and scene not in item.users_scene):
            continue
        for child in [c for c in item.children if c not in [getattr(entry, name) for name in scene_objects.PARTS]]:
            matrix = child.matrix_world.copy()
            child.parent = None
            child.matrix_world = matrix
        data, images = item.data, []
        actions = [b.animation_data.action for b in (item, data) if b is not None and b.animation_data]
        if item.type == "CAMERA":
            images = [b.image for b in data.background_images if b.image is not None and b.image.get(TAG)]
        bpy.data.objects.remove(item)
        unused = [b for b in (data, *actions) if b is not None and b.users <= int(b.use_fake_user)]
        bpy.data.batch_remove(unused)
        bpy.data.batch_remove([i for i in images if i.users == 0])
    collection = entry.collection
    if exclude or collection is None:
        return
    for item in [o for o in collection.objects if o.users_collection == (collection,)]:
        scene.collection.objects.link(item)
    for child in collection.children:
        scene.collection.children.link(child)
    bpy.data.collections.remove(collection)


def _animate(camera: bpy.types.Object, path: contract.CameraPath) -> None:
    """Sets keyframes of the camera at the clip's frame numbers, with linear interpolation."""
    frames, lenses = [frame.frame for frame in path.frames], lenses_of(path)
    key_path(camera, frames, axes.poses(path), lenses, (path.width, path.height), guesses.key_types(path))


def lenses_of(path: contract.CameraPath) -> np.ndarray:
    """Focal length in mm, shift_x and shift_y of every frame of a path, [F, 3] float64, from `axes.lens_from_k`."""
    found = [axes.lens_from_k((f.K[0], f.K[1], f.K[2], f.K[3]), path.width, path.height) for f in path.frames]
    return np.array(found, dtype=np.float64).reshape(-1, 3)


def key_path(
    camera: bpy.types.Object,
    frames: Sequence[int],
    poses: np.ndarray,
    lenses: np.ndarray,
    size: tuple[int, int],
    types: Sequence[str] = (),
) -> None:
    """Sets keyframes of a camera's pose and, if it changes, its lens, with linear interpolation.

    Args:
        camera: a camera object. Its existing keyframes of pose and lens are replaced.
        frames: [F] ascending frame numbers.
        poses: camera-to-world, [F, 4, 4], Blender's camera axes, in the world of the camera's parent.
        lenses: [F, 3], see `lenses_of`.
        size: width and height of the images in pixels.
        types: [F] types of the keys, see `compat_animation.set_keys`.
    """
    data, (width, height) = camera_of(camera), size
    ends = lenses.min(axis=0), lenses.max(axis=0)
    varies = lenses.max() > 0 and bool((ends[1] - ends[0] > 1e-6 * np.maximum(np.abs(ends[1]), 1.0)).any())
    before: Quaternion | None = None
    places: list[tuple[float, ...]] = []
    turns: list[tuple[float, ...]] = []
    for matrix in poses.tolist():
        location, rotation, _ = Matrix(matrix).decompose()
        if before is not None and before.dot(rotation) < 0:  # q and -q are equal, but keyframes would take the long way
            rotation.negate()
        before = rotation
        places.append(location[:])
        turns.append(rotation[:])
    data.sensor_fit, data.sensor_width = "HORIZONTAL", axes.SENSOR_MM
    data.sensor_height = axes.SENSOR_MM * height / width
    camera.rotation_mode = "QUATERNION"
    camera.location, camera.rotation_quaternion = places[-1], turns[-1]
    data.lens, data.shift_x, data.shift_y = lenses[-1].tolist()
    keyed = {"location": np.array(places), "rotation_quaternion": np.array(turns)}
    compat_animation.set_keys(camera, frames, keyed, types)
    if varies:
        compat_animation.set_keys(data, frames, {n: lenses[:, i : i + 1] for i, n in enumerate(_LENS)})
    else:
        compat_animation.remove_keys(data, _LENS)


def _plate(shot: Path) -> tuple[bpy.types.Image, int, int] | None:
    """(undistorted plate as an image, its first frame, its last frame); None without a plate."""
    span = inventory.plate_range(shot)
    path = contract.ShotFolder(shot).plate(span[0]) if span is not None else None
    if span is None or path is None or not path.is_file():
        return None
    return sequences.load_sequence(path, f"Plate {scene_objects.name_of(shot)}", "srgb"), *span


def _show_plate(data: bpy.types.Camera, plate: tuple[bpy.types.Image, int, int] | None) -> None:
    """Shows the undistorted plate as the camera's background, fitted to the sensor. Scene frame n shows file n.

    The artist's other background images, and the display settings of an existing plate, stay.
    """
    background = next((b for b in data.background_images if b.image is not None and b.image.get(TAG)), None)
    old = background.image if background is not None else None
    if plate is not None:
        if background is None:
            background = data.background_images.new()
            background.frame_method = "FIT"
            background.display_depth = "BACK"
            background.alpha = 1.0
            data.show_background_images = True
        background.image = plate[0]
        sequences.show_sequence(background.image_user, *plate)
    elif background is not None:
        data.background_images.remove(background)
    if old is not None and old.users == 0:
        bpy.data.images.remove(old)


def points_of(shot: Path) -> tuple[np.ndarray, np.ndarray]:
    """Sparse points of the solve: xyz [P, 3] float32 in solve units, rgb [P, 3] uint8; empty without points.

    Raises ValueError if the points cannot be read.
    """
    file = contract.ShotFolder(shot).points
    if not file.is_file():
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    try:
        with contract.open_arrays(file) as source, np.load(source, allow_pickle=False) as stored:
            xyz, rgb = stored["xyz"].astype(np.float32), stored["rgb"].astype(np.uint8)
    except contract.UnreadableFile:
        raise
    except ValueError as error:
        raise contract.UserError(f"{file} is damaged. Solve again.") from error
    if xyz.shape != rgb.shape or xyz.shape[1:] != (3,) or not np.isfinite(xyz).all():
        raise contract.UserError(f"{file} is damaged. Solve again.")
    return xyz, rgb


def _point_mesh(name: str, xyz: np.ndarray, rgb: np.ndarray) -> bpy.types.Mesh:
    """A mesh of loose vertices with their colours in the point attribute "Col"."""
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(xyz))
    vertices: Any = mesh.vertices
    vertices.foreach_set("co", np.ascontiguousarray(xyz, dtype=np.float32).ravel())
    colour: Any = mesh.color_attributes.new("Col", "BYTE_COLOR", "POINT")
    rgba = np.ones((len(rgb), 4), dtype=np.float32)
    rgba[:, :3] = rgb / 255.0
    if len(rgb):
        colour.data.foreach_set("color_srgb", rgba.ravel())
    mesh.update()
    return mesh


def _extent(path: contract.CameraPath) -> float:
    """Length of the diagonal of the box around the camera's path, solve units; at least 0.1."""
    centres = axes.poses(path)[:, :3, 3]
    return max(float(np.linalg.norm(centres.max(axis=0) - centres.min(axis=0))), 0.1)


def _reach(data: bpy.types.Camera, start: float, end: float) -> None:
    """Extends a camera's clip range to include these distances."""
    data.clip_start, data.clip_end = min(start, data.clip_start), max(end, data.clip_end)


def _clip(path: contract.CameraPath, xyz: np.ndarray) -> tuple[float, float]:
    """Clip distances that include every point from everywhere on the path."""
    if not len(xyz):
        return 0.01, 1000.0
    reach = float(np.linalg.norm(xyz - alignment.middle(xyz), axis=1).max()) + _extent(path)
    return max(reach * 1e-4, 1e-3), max(reach * 4.0, 100.0) if math.isfinite(reach) else 1000.0
