"""Objects that were added to a scene for a shot, stored as pointers in the scene."""

from __future__ import annotations

import os
from collections.abc import Collection
from pathlib import Path

import bpy

from ...torch_backend import contract
from ..access import holds, named, settings_of
from ..properties import BoolProperty, CollectionProperty, FloatProperty, Items, PointerProperty, StringProperty
from ..scene import paths, session

PARTS = ("root", "camera", "points")
"""Names of a shot's objects."""


class SPLANNEQUIN_PG_splats(bpy.types.PropertyGroup):
    """Splats of one take in the scene; its name is the take's."""

    object = PointerProperty(name="Object", description="The splats of the take", type=bpy.types.Object)


class SPLANNEQUIN_PG_surface(bpy.types.PropertyGroup):
    """A mesh of the surface of one take in the scene; its name is the take's."""

    object = PointerProperty(name="Object", description="A part of the take's surface", type=bpy.types.Object)


# A tag on an object would be copied with it: an artist's duplicate would count as ours and be removed. A pointer
# follows one object through renaming, undo, saving and a full copy of the scene.
class SPLANNEQUIN_PG_made(bpy.types.PropertyGroup):
    """What there is of one shot; its name is the shot's."""

    folder = StringProperty(name="Folder", description="Shot folder that the data comes from", options=set())
    root = PointerProperty(name="Root", description="Object that places the solve in the scene", type=bpy.types.Object)
    camera = PointerProperty(name="Camera", description="The solved camera", type=bpy.types.Object)
    points = PointerProperty(name="Points", description="The sparse points", type=bpy.types.Object)
    plate = PointerProperty(
        name="Plate", description="The camera that shows the clip until it is solved", type=bpy.types.Object
    )
    world = StringProperty(
        name="World",
        description="Coordinate system of the loaded solve: scene, or empty for a separate one",
        options={"HIDDEN"},
    )
    scaled = BoolProperty(
        name="Scaled", description="The scale of the shot was set from a known distance", options=set()
    )
    guessed_scale = FloatProperty(
        name="Estimated Scale",
        description="Scene units per solve unit, estimated from the camera's height; 0: no estimate",
        options={"HIDDEN"},
    )
    splats = CollectionProperty(name="Splats", description="Splats of takes", type=SPLANNEQUIN_PG_splats, options=set())
    surfaces = CollectionProperty(
        name="Surfaces", description="Surfaces of takes", type=SPLANNEQUIN_PG_surface, options=set()
    )
    light = PointerProperty(name="Light", description="World that lights the scene like the shot", type=bpy.types.World)
    collection = PointerProperty(
        name="Collection", description="Collection that contains these objects", type=bpy.types.Collection
    )
    points_hidden_in = StringProperty(
        name="Points Hidden In",
        description="View layers in which scrubbing hid the points, as JSON",
        options={"HIDDEN"},
    )
    marks = StringProperty(name="Marks", description="Markers that were added to the timeline, as JSON", options=set())


def name_of(shot: Path) -> str:
    """Name of a shot, from its folder."""
    return shot.name.removesuffix(contract.SHOT_SUFFIX)


def of(scene: bpy.types.Scene, shot: Path) -> SPLANNEQUIN_PG_made | None:
    """The entry of a shot's objects, or None."""
    # Panels call this while drawing, when Blender forbids writes.
    alike = [entry for entry in settings_of(scene).made if entry.name == name_of(shot)]
    folders = [os.path.abspath(paths.absolute(entry.folder)) for entry in alike]
    for entry, folder in zip(alike, folders, strict=True):
        if paths.same(folder, os.path.abspath(shot)):
            return entry
    # A different path is another shot of the same name, unless the shot was moved here since.
    for entry, folder in zip(alike, folders, strict=True):
        if not os.path.isdir(folder) and not _is_of_another(scene, folder):
            return entry
    return None


def _is_of_another(scene: bpy.types.Scene, folder: str) -> bool:
    """True if a missing folder is that of a shot in the scene's list that is not selected. Its disk may be away."""
    props = settings_of(scene)
    others = [one for index, one in enumerate(props.shots) if index != props.loaded_shot]
    return any(paths.same(paths.absolute(one.shot_seen), folder) for one in others)


def new(scene: bpy.types.Scene, shot: Path) -> SPLANNEQUIN_PG_made:
    """The entry of a shot's objects, created if missing."""
    entry = of(scene, shot) or settings_of(scene).made.add()
    entry.name, entry.folder = name_of(shot), paths.blend_path(shot)
    return entry


def own_collection(scene: bpy.types.Scene, shot: Path) -> bpy.types.Collection:
    """The collection of the shot's objects, created if the scene no longer has it."""
    entry = new(scene, shot)
    if entry.collection is None or entry.collection not in scene.collection.children_recursive:
        entry.collection = bpy.data.collections.new(f"Splannequin {name_of(shot)}")
        scene.collection.children.link(entry.collection)
    return entry.collection


def drop(scene: bpy.types.Scene, shot: Path) -> None:
    """Removes the entry of a shot. Its objects stay."""
    entry = of(scene, shot)
    if entry is not None:
        settings_of(scene).made.remove(list(settings_of(scene).made).index(entry))


def part(scene: bpy.types.Scene, shot: Path, name: str) -> bpy.types.Object | None:
    """The shot's object called `name` (one of `PARTS`, or "plate"); None if the scene no longer has it."""
    entry = of(scene, shot)
    item = getattr(entry, name) if entry is not None else None
    return item if item is not None and holds(scene.objects, item) else None


def keep_camera(scene: bpy.types.Scene) -> None:
    """Stores the scene's camera before a shot's camera replaces it."""
    camera = scene.camera
    if camera is not None and camera not in [entry.camera for entry in settings_of(scene).made]:
        settings_of(scene).camera_before = camera


def restore_camera(scene: bpy.types.Scene) -> None:
    """Sets the camera of a scene whose camera was removed with a shot: another shot's, or the one from before all
    shots."""
    props = settings_of(scene)
    if scene.camera is None:
        candidates = [entry.camera for entry in props.made] + [props.camera_before]
        scene.camera = next((c for c in candidates if c is not None and holds(scene.objects, c)), None)
    if not len(props.made):
        props.camera_before = None


def tidy(scene: bpy.types.Scene) -> None:
    """Clears pointers to objects that the artist deleted."""
    # The pointers would keep deleted objects invisibly in the file.
    before = settings_of(scene).camera_before
    if before is not None and not _is_in_scene(before, [scene.objects]):
        settings_of(scene).camera_before = None
    for entry in settings_of(scene).made:
        if entry.collection is not None and entry.collection not in scene.collection.children_recursive:
            entry.collection = None
        # A short list with most of our objects.
        entry_objects = [entry.collection.objects] if entry.collection is not None else []
        for name in (*PARTS, "plate"):
            item = getattr(entry, name)
            if item is not None and not _is_in_scene(item, [*entry_objects, scene.objects]):
                setattr(entry, name, None)
        for kept in (entry.splats, entry.surfaces):
            for index in reversed(range(len(kept))):
                item = kept[index].object
                if item is None or not _is_in_scene(item, [*entry_objects, scene.objects]):
                    kept.remove(index)


def _is_in_scene(item: bpy.types.Object, collections: list[bpy.types.bpy_prop_collection[bpy.types.Object]]) -> bool:
    """True if any scene has an object. Searches by name in the collections `collections` first."""
    # Called at every tick: `users_scene` copies the object list of every scene, which may be tens of thousands long.
    return any(named(objects, item.name) == item for objects in collections) or bool(item.users_scene)


def remove_kept(
    scene: bpy.types.Scene, kept: Items[SPLANNEQUIN_PG_splats | SPLANNEQUIN_PG_surface], take: str | None
) -> bool:
    """Removes the objects of a take, or of all takes, from a list and from the file. True if there were any.

    Objects that are only in other scenes stay in the file.
    """
    is_found = False
    for index in reversed(range(len(kept))):
        if take is not None and kept[index].name != take:
            continue
        item = kept[index].object
        kept.remove(index)
        if item is None or (item.users_scene and scene not in item.users_scene):
            continue
        is_found = True
        data = item.data
        bpy.data.objects.remove(item)
        if data is not None and data.users <= int(data.use_fake_user):
            bpy.data.batch_remove([data])
    return is_found


def placed_root(
    scene: bpy.types.Scene, shot: Path, graph: bpy.types.Depsgraph | None = None
) -> bpy.types.Object | None:
    """The shot's root if the scene has it, evaluated by `graph`. Without `graph` it has the state last shown in a
    window."""
    root = part(scene, shot, "root")
    return root if root is None or graph is None else root.evaluated_get(graph)


def depth_scale(scene: bpy.types.Scene, shot: Path, graph: bpy.types.Depsgraph | None = None) -> float:
    """Scene units per solve unit: the mean scale of the shot's root, or 1 without a root."""
    root = placed_root(scene, shot, graph)
    return float(sum(root.matrix_world.to_scale()[:]) / 3.0) if root else 1.0


def is_plate(camera: bpy.types.Object) -> bool:
    """True for a camera of any shot that shows its clip until the solve."""
    return any(entry.plate == camera for scene in bpy.data.scenes for entry in settings_of(scene).made)


def needed_scene(scene_uid: int) -> bpy.types.Scene:
    """The scene with this number. Raises JobError if it no longer exists."""
    scene = session.scene_of(scene_uid)
    if scene is None:
        raise contract.JobError("The scene no longer exists.", "", contract.ExitCode.USAGE)
    return scene


def needed_mesh(uid: int) -> bpy.types.Mesh:
    """The mesh with this number, which a step fills in slices. Raises JobError if an undo has removed it."""
    mesh = session.of(bpy.data.meshes, uid)
    if mesh is None:
        message = "The mesh was undone before it was complete."
        raise contract.JobError(message, "Add it again.", contract.ExitCode.USAGE)
    return mesh


def remove_meshes(uids: Collection[int]) -> None:
    """Removes the meshes with these numbers that still exist."""
    bpy.data.batch_remove([mesh for mesh in bpy.data.meshes if mesh.session_uid in uids])


def check_root(scene: bpy.types.Scene, shot: Path) -> None:
    """Raises JobError if the scene lacks the shot's root."""
    if part(scene, shot, "root") is None:
        raise contract.JobError("The solve is not in this scene.", "Load the camera first.", contract.ExitCode.USAGE)
