"""The frozen scene of a take as meshes in Blender's scene, under the shot's root: the room, and what moves in the clip.

Both catch shadows, so that they are transparent in a render but for the shadows of things that stand among them, and
hide what is behind them. They carry the frozen colours as a vertex attribute, which reflections show.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ...torch_backend import contract
from ..access import named, present
from ..process import job_timer
from ..scene.ownership import TAG
from ..shot import inventory, placement, scene_objects
from . import surface_shapes
from .surface_shapes import Shape

SHOWN_AS = "Splannequin Surface"
"""Name of the material."""
PARTS = ("room", "people")
"""The objects of a surface: what stands still, and what moves in the clip."""


def add(scene: bpy.types.Scene, shot: Path, take: str) -> list[str]:
    """Brings the surface of a take into a scene; what was there of that take is replaced. Returns what was done.

    JobError if there is none of the take as it is now, or the shot does not stand in the scene.
    """
    for _ in adding(scene.session_uid, shot, take):
        pass
    return [_done(take)]


def adding(scene_uid: int, shot: Path, take: str) -> Iterator[job_timer.Progress | None]:
    """The same for the timer: reading the file, and each mesh, in turns. Keeps nothing of bpy between two turns."""
    _facts(scene_objects.needed_scene(scene_uid), shot, take)
    folder = contract.TakeFolder(contract.ShotFolder(shot).take(take))
    parts = yield from _reading(folder.surface)
    meshes: list[str] = []
    try:
        for part, shape in zip(PARTS, parts, strict=True):
            mesh = bpy.data.meshes.new(f"{scene_objects.name_of(shot)} {take} {part}")
            meshes.append(mesh.name)
            del mesh
            for fill in (_fill_elements, _fill_faces, _fill_colors) if len(shape.corners) else ():
                yield None
                fill(present(named(bpy.data.meshes, meshes[-1])), shape)  # an undo may have taken it
        scene = scene_objects.needed_scene(scene_uid)
        facts = _facts(scene, shot, take)
    except BaseException:
        for name in meshes:
            left = named(bpy.data.meshes, name)
            if left is not None:
                bpy.data.meshes.remove(left)
        raise
    _show(scene, shot, take, [present(named(bpy.data.meshes, name)) for name in meshes], facts)


def added_in_turns(scene_uid: int, shot: Path, take: str) -> Iterator[job_timer.Progress | None]:
    """`adding` in a window: an undo step of its own, and a note on the panel."""
    yield from adding(scene_uid, shot, take)
    job_timer.watch_of(shot).notes["freeze"] = [_done(take)]
    job_timer.undo_step("freeze")
    job_timer.redraw()


def is_made(shot: Path, take: str) -> bool:
    """True if the take as it is now has a surface."""
    return contract.surface_of_take(contract.TakeFolder(contract.ShotFolder(shot).take(take))) is not None


def _done(take: str) -> str:
    return f"The surface of take {take} is in the scene, under the shot's root."


def _facts(scene: bpy.types.Scene, shot: Path, take: str) -> dict[str, Any]:
    """take.json of a take whose surface can be added. JobError says what is missing."""
    facts = inventory.read(shot).takes.get(take)
    if facts is None or not is_made(shot, take):
        raise contract.JobError(f"Take {take} has no surface.", "Make it first.", contract.ExitCode.USAGE)
    scene_objects.check_root(scene, shot)
    return facts


# ------------------------------------------------------------------------------------------------- the file


def _reading(path: Path) -> Generator[job_timer.Progress, None, list[Shape]]:
    """The shapes of a surface, `PARTS`, read beside the window: it takes a second. ValueError if it is damaged."""
    made = surface_shapes.begin(path)
    while not made.done() and not bpy.app.background:
        yield job_timer.Progress("Reading the surface", 0, 1)
    return made.result()


def _fill_elements(mesh: bpy.types.Mesh, shape: Shape) -> None:
    """Vertices, edges and corners, set as attributes: Blender copies those whole, in a millisecond. By the elements'
    own properties it takes them one by one, 0.1 s for 850,000 corners."""
    vertices: Any = mesh.vertices
    edges: Any = mesh.edges
    loops: Any = mesh.loops
    vertices.add(len(shape.places))
    edges.add(len(shape.edges))
    loops.add(shape.corners.size)
    _set(mesh, "position", "vector", shape.places)
    _set(mesh, ".edge_verts", "value", shape.edges)
    _set(mesh, ".corner_vert", "value", shape.corners)
    _set(mesh, ".corner_edge", "value", shape.sides)


def _fill_faces(mesh: bpy.types.Mesh, shape: Shape) -> None:
    """Faces; smooth, as faces are without an attribute `sharp_face`."""
    polygons: Any = mesh.polygons
    polygons.add(len(shape.corners))
    polygons.foreach_set("loop_start", np.arange(0, shape.corners.size, 3, dtype=np.int32))


def _fill_colors(mesh: bpy.types.Mesh, shape: Shape) -> None:
    mesh.attributes.new("Col", "BYTE_COLOR", "POINT")
    _set(mesh, "Col", "color_srgb", shape.colors)
    mesh.update()


def _set(mesh: bpy.types.Mesh, attribute: str, field: str, values: np.ndarray) -> None:
    made: Any = mesh.attributes[attribute]
    made.data.foreach_set(field, values.ravel())


# ------------------------------------------------------------------------------------------------- the scene


def _show(scene: bpy.types.Scene, shot: Path, take: str, meshes: list[bpy.types.Mesh], facts: dict[str, Any]) -> None:
    """Hangs finished meshes on the shot's root as catchers of shadows, in place of the previous ones."""
    remove(scene, shot, take)
    root, entry = present(scene_objects.part(scene, shot, "root")), scene_objects.new(scene, shot)
    stands = placement.in_solve(contract.placement_of(facts))
    for part, mesh in zip(PARTS, meshes, strict=True):
        if not len(mesh.polygons):
            bpy.data.meshes.remove(mesh)
            continue
        mesh.materials.append(_material())
        item = bpy.data.objects.new(mesh.name, mesh)
        present(entry.collection).objects.link(item)
        item.parent, item.matrix_parent_inverse, item.matrix_basis = root, Matrix(), stands
        # A holdout would hide what is behind people, too, but throw the shadows of people into the render, which the
        # plate has already, and catch none.
        item.is_shadow_catcher = True
        # The room's own shadows are in the plate already, and its walls would keep the scene's lights out.
        item.visible_shadow = part != "room"
        kept = entry.surfaces.add()
        kept.name, kept.object = take, item


def find(scene: bpy.types.Scene, shot: Path, take: str) -> list[bpy.types.Object]:
    """The objects of a take's surface that the scene still has."""
    entry = scene_objects.of(scene, shot)
    items = [one.object for one in entry.surfaces if one.name == take] if entry is not None else []
    return [item for item in items if item is not None and named(scene.objects, item.name) == item]


def remove(scene: bpy.types.Scene, shot: Path, take: str | None = None) -> bool:
    """Takes the surface of a take, or of all takes of a shot, out of the file. True if there was one."""
    entry = scene_objects.of(scene, shot)
    return entry is not None and scene_objects.remove_kept(scene, entry.surfaces, take)


def _material() -> bpy.types.Material:
    """The material of surfaces: matt in their own colours, and in reflections as bright as they are in the plate. Made
    once a file."""
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
        cycles.emission_sampling = "NONE"  # it lights nothing, so that lights of the scene are not counted twice
    return material
