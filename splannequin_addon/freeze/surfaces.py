"""The frozen scene of a take as meshes in Blender's scene, under the shot's root: the room, and what moves in the clip.

Both are shadow catchers: a render shows only the shadows that other objects cast on them. They also hide objects behind
them. A vertex attribute holds the frozen colours, which reflections show.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ...torch_backend import contract
from ..access import holds, present
from ..process import job_timer
from ..scene.ownership import TAG
from ..shot import inventory, placement, scene_objects
from . import surface_shapes
from .surface_shapes import Shape

SHOWN_AS = "Splannequin Surface"
"""Name of the material."""
PARTS = ("room", "people")
"""The objects of a surface: its static part, and the part that moves in the clip."""


def add(scene: bpy.types.Scene, shot: Path, take: str) -> list[str]:
    """Adds the surface of a take to a scene and replaces an earlier one of the take. Returns the changes as sentences.

    Raises JobError if the take's current version has no surface, or the shot has no objects in the scene.
    """
    for _ in adding(scene.session_uid, shot, take):
        pass
    return [_done(take)]


def adding(scene_uid: int, shot: Path, take: str) -> Iterator[job_timer.Progress | None]:
    """`add` in steps for the timer: reading the file, then each mesh. Keeps no bpy data between steps."""
    _facts(scene_objects.needed_scene(scene_uid), shot, take)
    folder = contract.TakeFolder(contract.ShotFolder(shot).take(take))
    parts = yield from _reading(folder.surface)
    meshes: list[int] = []  # numbers, because a name may belong to a mesh of another file by then
    try:
        for part, shape in zip(PARTS, parts, strict=True):
            mesh = bpy.data.meshes.new(f"{scene_objects.name_of(shot)} {take} {part}")
            meshes.append(mesh.session_uid)
            del mesh
            for fill in (_fill_elements, _fill_faces, _fill_colors) if len(shape.corners) else ():
                yield None
                fill(scene_objects.needed_mesh(meshes[-1]), shape)
        scene = scene_objects.needed_scene(scene_uid)
        facts = _facts(scene, shot, take)
    except BaseException:
        scene_objects.remove_meshes(meshes)
        raise
    _show(scene, shot, take, [scene_objects.needed_mesh(uid) for uid in meshes], facts)


def added_in_turns(scene_uid: int, shot: Path, take: str) -> Iterator[job_timer.Progress | None]:
    """`adding` for a window: adds an undo step and a note on the panel."""
    yield from adding(scene_uid, shot, take)
    job_timer.watch_of(shot).notes["freeze"] = [_done(take)]
    job_timer.undo_step("freeze")
    job_timer.redraw()


def has_surface(shot: Path, take: str) -> bool:
    """True if the current version of the take has a surface."""
    return contract.surface_of_take(contract.TakeFolder(contract.ShotFolder(shot).take(take))) is not None


def _done(take: str) -> str:
    return f"The surface of take {take} is in the scene, under the shot's root."


def _facts(scene: bpy.types.Scene, shot: Path, take: str) -> dict[str, Any]:
    """take.json of a take whose surface can be added. Raises JobError, which names what is missing."""
    facts = inventory.read(shot).takes.get(take)
    if facts is None or not has_surface(shot, take):
        raise contract.JobError(f"Take {take} has no surface.", "Create it first.", contract.ExitCode.USAGE)
    scene_objects.check_root(scene, shot)
    return facts


# ------------------------------------------------------------------------------------------------- the file


def _reading(path: Path) -> Generator[job_timer.Progress, None, list[Shape]]:
    """The shapes of `PARTS`. Raises ValueError if the surface is damaged."""
    future = surface_shapes.begin(path)  # in a thread, because it takes a second
    while not future.done() and not bpy.app.background:
        yield job_timer.Progress("Reading the surface", 0, 1)
    return future.result()


def _fill_elements(mesh: bpy.types.Mesh, shape: Shape) -> None:
    """Adds vertices, edges and corners to a mesh and sets them as attributes."""
    vertices: Any = mesh.vertices
    edges: Any = mesh.edges
    loops: Any = mesh.loops
    vertices.add(len(shape.places))
    edges.add(len(shape.edges))
    loops.add(shape.corners.size)
    # Blender copies a whole attribute in a millisecond; the elements' properties take 0.1 s for 850,000 corners.
    _set(mesh, "position", "vector", shape.places)
    _set(mesh, ".edge_verts", "value", shape.edges)
    _set(mesh, ".corner_vert", "value", shape.corners)
    _set(mesh, ".corner_edge", "value", shape.sides)


def _fill_faces(mesh: bpy.types.Mesh, shape: Shape) -> None:
    """Adds the faces, which are smooth without the attribute `sharp_face`."""
    polygons: Any = mesh.polygons
    polygons.add(len(shape.corners))
    polygons.foreach_set("loop_start", np.arange(0, shape.corners.size, 3, dtype=np.int32))


def _fill_colors(mesh: bpy.types.Mesh, shape: Shape) -> None:
    mesh.attributes.new("Col", "BYTE_COLOR", "POINT")
    _set(mesh, "Col", "color_srgb", shape.colors)
    mesh.update()


def _set(mesh: bpy.types.Mesh, attribute: str, field: str, values: np.ndarray) -> None:
    target: Any = mesh.attributes[attribute]
    target.data.foreach_set(field, values.ravel())


# ------------------------------------------------------------------------------------------------- the scene


def _show(scene: bpy.types.Scene, shot: Path, take: str, meshes: list[bpy.types.Mesh], facts: dict[str, Any]) -> None:
    """Parents finished meshes to the shot's root as shadow catchers and replaces the previous ones."""
    remove(scene, shot, take)
    root, entry = present(scene_objects.part(scene, shot, "root")), scene_objects.new(scene, shot)
    transform = placement.in_solve(contract.placement_of(facts))
    for part, mesh in zip(PARTS, meshes, strict=True):
        if not len(mesh.polygons):
            bpy.data.meshes.remove(mesh)
            continue
        mesh.materials.append(_material())
        item = bpy.data.objects.new(mesh.name, mesh)
        scene_objects.own_collection(scene, shot).objects.link(item)
        item.parent, item.matrix_parent_inverse, item.matrix_basis = root, Matrix(), transform
        # A holdout would also hide objects behind people. But it would cast people's shadows, which the plate already
        # has, and it would not catch any shadows.
        item.is_shadow_catcher = True
        # The plate already has the room's shadows, and the room's walls would block the scene's lights.
        item.visible_shadow = part != "room"
        kept = entry.surfaces.add()
        kept.name, kept.object = take, item


def find(scene: bpy.types.Scene, shot: Path, take: str) -> list[bpy.types.Object]:
    """The objects of a take's surface that the scene still has."""
    entry = scene_objects.of(scene, shot)
    items = [one.object for one in entry.surfaces if one.name == take] if entry is not None else []
    return [item for item in items if item is not None and holds(scene.objects, item)]


def remove(scene: bpy.types.Scene, shot: Path, take: str | None = None) -> bool:
    """Removes the surface of a take, or of all takes of a shot, from the file. True if there was one."""
    entry = scene_objects.of(scene, shot)
    return entry is not None and scene_objects.remove_kept(scene, entry.surfaces, take)


def _material() -> bpy.types.Material:
    """The material of surfaces: diffuse in the surface's colours, and in reflections as bright as the plate. One per
    file."""
    kept = next((m for m in bpy.data.materials if m.get(TAG) == SHOWN_AS), None)
    if kept is not None:
        return kept
    material = bpy.data.materials.new(SHOWN_AS)
    material[TAG] = SHOWN_AS
    if material.node_tree is None:  # until 5.0
        material.use_nodes = True
    tree = present(material.node_tree)
    tree.nodes.clear()
    colour: Any = tree.nodes.new("ShaderNodeAttribute")
    colour.attribute_name = "Col"
    matt, shine, mix = (tree.nodes.new(f"ShaderNode{kind}") for kind in ("BsdfDiffuse", "Emission", "MixShader"))
    path, output = tree.nodes.new("ShaderNodeLightPath"), tree.nodes.new("ShaderNodeOutputMaterial")
    for place, node in enumerate((colour, matt, mix, output)):
        node.location = (200.0 * place, 0.0)
    shine.location, path.location = (200.0, -150.0), (200.0, 350.0)
    for shader in (matt, shine):
        tree.links.new(shader.inputs["Color"], colour.outputs["Color"])
    tree.links.new(mix.inputs[0], path.outputs["Is Glossy Ray"])
    tree.links.new(mix.inputs[1], matt.outputs[0])
    tree.links.new(mix.inputs[2], shine.outputs[0])
    tree.links.new(output.inputs["Surface"], mix.outputs[0])
    cycles: Any = getattr(material, "cycles", None)
    if cycles is not None:
        cycles.emission_sampling = "NONE"  # lights nothing, otherwise the scene's lights would count twice
    return material
