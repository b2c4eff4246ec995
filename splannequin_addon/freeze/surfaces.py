"""The frozen scene of a take as meshes in Blender's scene, under the shot's root: the room, and what moves in the clip.

Both catch shadows, so that they are transparent in a render but for the shadows of things that stand among them, and
hide what is behind them. They carry the frozen colours as a vertex attribute, which reflections show.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ...torch_backend import contract
from ..access import mesh_of, named, present
from ..process import job_timer
from ..scene import session
from ..scene.ownership import TAG
from ..shot import inventory, placement, scene_objects

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
    _facts(_scene(scene_uid), shot, take)
    folder = contract.TakeFolder(contract.ShotFolder(shot).take(take))
    parts = yield from _in_thread(lambda: [_part(*read(folder.surface), part == "people") for part in PARTS])
    meshes: list[str] = []
    try:
        for part, shape in zip(PARTS, parts, strict=True):
            mesh = bpy.data.meshes.new(f"{scene_objects.name_of(shot)} {take} {part}")
            meshes.append(mesh.name)
            del mesh
            for fill in (_fill_points, _fill_edges, _fill_corners, _fill_faces, _fill_colors):
                yield None
                fill(present(named(bpy.data.meshes, meshes[-1])), shape)  # an undo may have taken it
        scene = _scene(scene_uid)
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


def _scene(scene_uid: int) -> bpy.types.Scene:
    scene = session.scene_of(scene_uid)
    if scene is None:
        raise contract.JobError("The scene is not there any more.", "", contract.ExitCode.USAGE)
    return scene


def _facts(scene: bpy.types.Scene, shot: Path, take: str) -> dict[str, Any]:
    """take.json of a take whose surface can be added. JobError says what is missing."""
    facts = inventory.read(shot).takes.get(take)
    if facts is None or not is_made(shot, take):
        raise contract.JobError(f"Take {take} has no surface.", "Make it first.", contract.ExitCode.USAGE)
    check_root(scene, shot)
    return facts


def check_root(scene: bpy.types.Scene, shot: Path) -> None:
    """JobError if the shot does not stand in the scene."""
    if scene_objects.part(scene, shot, "root") is None:
        raise contract.JobError("The solve is not in this scene.", "Load the camera first.", contract.ExitCode.USAGE)


# ------------------------------------------------------------------------------------------------- the file


@dataclass(frozen=True, eq=False)
class Shape:
    """What a mesh is filled with. Blender would take a second to find the edges of a large one."""

    places: np.ndarray
    """[V, 3] float32."""
    colors: np.ndarray
    """[V, 4] float32 in 0..1, as displayed."""
    edges: np.ndarray
    """[E, 2] int32, vertices of each edge."""
    corners: np.ndarray
    """[T, 3] int32, vertices of each triangle."""
    sides: np.ndarray
    """[T, 3] int32, edge of each triangle from each of its corners to the next."""


def _in_thread(make: Callable[[], list[Shape]]) -> Generator[job_timer.Progress, None, list[Shape]]:
    """What `make` returns or raises, made beside the window: it takes a second and needs no bpy."""
    with ThreadPoolExecutor(1) as pool:
        made = pool.submit(make)
        while not made.done():
            yield job_timer.Progress("Reading the surface", 0, 1)
            if bpy.app.background:
                break
        return made.result()


def read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a take's surface, as the contract's fields say.

    ValueError if it is no such file, is cut short, or has triangles without vertices.
    """
    with contract.open_regular(path, contract.LONGEST_CHECKPOINT) as handle:
        header = contract.read_surface_header(handle, path)
        of_vertices, of_triangles = (np.dtype(list(f)) for f in (contract.VERTEX_FIELDS, contract.TRIANGLE_FIELDS))
        vertices = np.frombuffer(handle.read(header.vertices * of_vertices.itemsize), of_vertices)
        triangles = np.frombuffer(handle.read(header.triangles * of_triangles.itemsize), of_triangles)
    corners = _corners(triangles)
    is_right = np.isin(triangles["corners"], 3).all() and (corners >= 0).all() and (corners < header.vertices).all()
    if not is_right or not all(np.isfinite(vertices[axis]).all() for axis in "xyz"):
        raise contract.UserError(f"{path} is damaged: make it again.")
    return vertices, triangles


def _corners(triangles: np.ndarray) -> np.ndarray:
    """[T, 3] int32."""
    return np.stack([triangles[name] for name in "abc"], axis=1)


def _part(vertices: np.ndarray, triangles: np.ndarray, people: bool) -> Shape:
    """One part of a surface."""
    kept, flat = np.unique(_corners(triangles[(triangles["people"] > 0) == people]), return_inverse=True)
    corners = flat.reshape(-1, 3).astype(np.int32)
    chosen = vertices[kept]
    colors = np.stack([chosen[name] for name in ("red", "green", "blue")], axis=1).astype(np.float32) / 255.0
    places = np.stack([chosen[axis] for axis in "xyz"], axis=1)
    ends = np.sort(np.stack([corners, np.roll(corners, -1, axis=1)], axis=-1).reshape(-1, 2).astype(np.int64), axis=1)
    count = max(len(kept), 1)
    found, sides = np.unique(ends[:, 0] * count + ends[:, 1], return_inverse=True)
    return Shape(
        places,
        np.concatenate([colors, np.ones((len(kept), 1), np.float32)], axis=1),
        np.stack([found // count, found % count], axis=1).astype(np.int32),
        corners,
        sides.reshape(-1, 3).astype(np.int32),
    )


def _fill_points(mesh: bpy.types.Mesh, shape: Shape) -> None:
    vertices: Any = mesh.vertices
    vertices.add(len(shape.places))
    vertices.foreach_set("co", shape.places.ravel())


def _fill_edges(mesh: bpy.types.Mesh, shape: Shape) -> None:
    edges: Any = mesh.edges
    edges.add(len(shape.edges))
    edges.foreach_set("vertices", shape.edges.ravel())


def _fill_corners(mesh: bpy.types.Mesh, shape: Shape) -> None:
    loops: Any = mesh.loops
    loops.add(shape.corners.size)
    loops.foreach_set("vertex_index", shape.corners.ravel())
    loops.foreach_set("edge_index", shape.sides.ravel())


def _fill_faces(mesh: bpy.types.Mesh, shape: Shape) -> None:
    polygons: Any = mesh.polygons
    polygons.add(len(shape.corners))
    polygons.foreach_set("loop_start", np.arange(0, shape.corners.size, 3, dtype=np.int32))
    polygons.foreach_set("use_smooth", np.ones(len(shape.corners), dtype=bool))


def _fill_colors(mesh: bpy.types.Mesh, shape: Shape) -> None:
    attribute: Any = mesh.attributes.new("Col", "BYTE_COLOR", "POINT")
    attribute.data.foreach_set("color_srgb", shape.colors.ravel())
    mesh.update()


# ------------------------------------------------------------------------------------------------- the scene


def _show(scene: bpy.types.Scene, shot: Path, take: str, meshes: list[bpy.types.Mesh], facts: dict[str, Any]) -> None:
    """Hangs finished meshes on the shot's root as catchers of shadows, in the place of those of before."""
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
    entry, is_found = scene_objects.of(scene, shot), False
    for index in reversed(range(len(entry.surfaces) if entry is not None else 0)):
        kept = present(entry).surfaces[index]
        if take is not None and kept.name != take:
            continue
        item = kept.object
        present(entry).surfaces.remove(index)
        if item is None or (item.users_scene and scene not in item.users_scene):
            continue
        is_found = True
        data = mesh_of(item)
        bpy.data.objects.remove(item)
        if data.users <= int(data.use_fake_user):
            bpy.data.meshes.remove(data)
    return is_found


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
