"""The splats of a take in Blender's scene, under the shot's root: one object per take.

Uses Blender's USD importer if it supports splats. Otherwise the splats are a mesh of loose vertices, with colours,
opacities, sizes and rotations as attributes. A modifier shows the vertices as coloured points.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ...torch_backend import contract
from .. import compat
from ..access import holds, named, present
from ..process import job_timer
from ..scene.ownership import TAG
from ..shot import inventory, placement, scene_objects

SHOWN_AS = "Splannequin Splats"
"""Name of the node group and the material that show splats."""
SH_C0 = 0.28209479177387814
"""Value of the constant spherical harmonic. A colour is 0.5 + SH_C0 * f_dc, in display sRGB."""
CHUNK = 1 << 16
"""Splats read per timer step: at most 16 MB, 10 ms from a warm disk cache."""
_NEEDED = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
           "rot_0", "rot_1", "rot_2", "rot_3")  # fmt: skip


def add(scene: bpy.types.Scene, shot: Path, take: str) -> list[str]:
    """Adds the splats of a take to a scene and replaces earlier ones of the take. Returns the changes as sentences.

    Raises JobError if the take has no splats or the shot has no objects in the scene; the scene is then unchanged.
    """
    for _ in adding(scene.session_uid, shot, take):
        pass
    return [_done(take)]


def adding(scene_uid: int, shot: Path, take: str) -> Iterator[job_timer.Progress | None]:
    """`add` in steps for the timer: part of the file, or one attribute, per step. Keeps no bpy data between steps."""
    scene = scene_objects.needed_scene(scene_uid)
    facts = _facts(scene, shot, take)
    del scene
    folder = contract.TakeFolder(contract.ShotFolder(shot).take(take))
    option = compat.splat_import_option()
    if (
        option
        and folder.usd.is_file()
        and import_natively(scene_objects.needed_scene(scene_uid), shot, take, option, facts)
    ):
        return
    columns = yield from reading(folder.ply)
    name = f"{scene_objects.name_of(shot)} {take} splats"
    mesh = bpy.data.meshes.new(name)
    uid = mesh.session_uid  # a name may belong to a mesh of another file by then
    try:
        mesh.vertices.add(len(columns["x"]))
        for attribute in attributes(columns):
            # Until the next step an undo may free the data, and a kept reference would crash Blender.
            del mesh
            yield None
            mesh = scene_objects.needed_mesh(uid)
            _set(mesh, *attribute)
        scene = scene_objects.needed_scene(scene_uid)
        _facts(scene, shot, take)
    except BaseException:
        scene_objects.remove_meshes([uid])
        raise
    _show(scene, shot, take, mesh, facts)


def added_in_turns(scene_uid: int, shot: Path, take: str) -> Iterator[job_timer.Progress | None]:
    """`adding` for a window: adds an undo step and a note on the panel."""
    yield from adding(scene_uid, shot, take)
    job_timer.watch_of(shot).notes["freeze"] = [_done(take)]
    job_timer.undo_step("freeze")
    job_timer.redraw()


def _done(take: str) -> str:
    return f"The splats of take {take} are in the scene, under the shot's root."


def _facts(scene: bpy.types.Scene, shot: Path, take: str) -> dict[str, Any]:
    """take.json of a take whose splats can be added. Raises JobError, which names what is missing."""
    facts = inventory.read(shot).takes.get(take)
    if facts is None or not contract.TakeFolder(contract.ShotFolder(shot).take(take)).ply.is_file():
        raise contract.JobError(f"Take {take} has no splats.", "Freeze first.", contract.ExitCode.USAGE)
    scene_objects.check_root(scene, shot)
    return facts


# ------------------------------------------------------------------------------------------------- the file


def reading(path: Path) -> Generator[job_timer.Progress, None, dict[str, np.ndarray]]:
    """Reads a 3DGS PLY in chunks. Returns property -> float32 values of all vertices.

    Raises ValueError for another kind of file, or a truncated one.
    """
    with contract.open_regular(path, contract.LONGEST_CHECKPOINT) as handle:
        count, fields = contract.read_ply_header(handle, path)
        layout = np.dtype(fields)
        missing = [name for name in _NEEDED if name not in (layout.names or ())]
        if missing:
            raise contract.UserError(f"{path} is not a 3D Gaussian PLY: its vertices have no {', '.join(missing[:4])}")
        parts: list[dict[str, np.ndarray]] = []
        for first in range(0, max(count, 1), CHUNK):
            wanted = min(CHUNK, count - first)
            rows = np.frombuffer(handle.read(wanted * layout.itemsize), dtype=np.uint8)
            if len(rows) < wanted * layout.itemsize:
                raise contract.UserError(f"{path} is incomplete. Freeze again.")
            vertices = rows.view(layout)
            parts.append({name: vertices[name].astype(np.float32) for name in _NEEDED})
            done = first + wanted
            yield job_timer.Progress(f"Reading splats, {done} of {count}", done, max(count, 1))
    return {name: np.concatenate([part[name] for part in parts]) for name in _NEEDED}


def attributes(columns: dict[str, np.ndarray]) -> Iterator[tuple[str, str, np.ndarray]]:
    """(name, type, values) of each vertex attribute of the splats, the position first.

    Col: scene-linear view-independent colour, with the opacity as alpha. opacity: 0 to 1. scale: standard deviations
    along the splat's axes, in the object's units. rotation: unit quaternion wxyz. radius: radius of a ball of equal
    volume.
    """

    def stacked(*names: str) -> np.ndarray:
        return np.stack([columns[name] for name in names], axis=1)

    # Each attribute is computed only when it is requested. For a million splats, one takes 20 to 60 ms.
    yield "position", "FLOAT_VECTOR", stacked("x", "y", "z")
    opacity = 0.5 + 0.5 * np.tanh(0.5 * columns["opacity"])  # the logistic function, without overflow
    display = np.clip(0.5 + SH_C0 * stacked("f_dc_0", "f_dc_1", "f_dc_2"), 0.0, 1.0)
    light = np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    yield "Col", "FLOAT_COLOR", np.concatenate([light, opacity[:, None]], axis=1)
    yield "opacity", "FLOAT", opacity
    logs = stacked("scale_0", "scale_1", "scale_2")
    yield "scale", "FLOAT_VECTOR", np.exp(logs)
    yield "radius", "FLOAT", np.exp(logs.mean(axis=1))
    quats = stacked("rot_0", "rot_1", "rot_2", "rot_3")
    yield "rotation", "QUATERNION", quats / np.maximum(np.sqrt((quats**2).sum(axis=1, keepdims=True)), 1e-30)


def _set(mesh: bpy.types.Mesh, name: str, kind: str, values: np.ndarray) -> None:
    """Sets an attribute of a mesh's vertices."""
    attribute: Any = named(mesh.attributes, name) or mesh.attributes.new(name, kind, "POINT")  # pyright: ignore[reportArgumentType]
    field = {"FLOAT_VECTOR": "vector", "FLOAT_COLOR": "color"}.get(kind, "value")
    if len(values):
        attribute.data.foreach_set(field, np.ascontiguousarray(values, dtype=np.float32).ravel())


# ------------------------------------------------------------------------------------------------- the scene


def _show(scene: bpy.types.Scene, shot: Path, take: str, mesh: bpy.types.Mesh, facts: dict[str, Any]) -> None:
    """Adds a finished mesh to the scene and replaces the previous object."""
    mesh.update()
    mesh.materials.append(_material())
    item = bpy.data.objects.new(mesh.name, mesh)
    modifier: Any = item.modifiers.new(SHOWN_AS, "NODES")
    modifier.node_group = _node_group()
    item.hide_render = True  # otherwise a bake would render them over the plate
    _keep(scene, shot, take, [item], facts)


def _keep(scene: bpy.types.Scene, shot: Path, take: str, items: list[bpy.types.Object], facts: dict[str, Any]) -> None:
    """Parents objects, given in the take's placement, to the shot's root. Stores the first one as the take's splats."""
    remove(scene, shot, take)
    root, entry = present(scene_objects.part(scene, shot, "root")), scene_objects.new(scene, shot)
    transform = placement.in_solve(contract.placement_of(facts))
    for item in items:
        for collection in item.users_collection:
            collection.objects.unlink(item)
        scene_objects.own_collection(scene, shot).objects.link(item)
        item.parent, item.matrix_parent_inverse = root, Matrix()
        item.matrix_basis = transform @ item.matrix_basis
    kept = entry.splats.add()
    kept.name, kept.object = take, items[0]


def import_natively(
    scene: bpy.types.Scene, shot: Path, take: str, option: str, facts: dict[str, Any]
) -> bpy.types.Object | None:
    """Imports a take's USD stage with Blender's importer, without cameras. None if no object resulted.

    Args:
        scene: the context's scene.
        shot: shot folder.
        take: name of a take with a USD stage.
        option: name of the importer's option for splats.
        facts: content of its take.json.
    """
    known = {item.session_uid for item in bpy.data.objects}
    file = contract.TakeFolder(contract.ShotFolder(shot).take(take)).usd
    switches: dict[str, Any] = {option: True, "import_cameras": False, "set_frame_range": False}
    switches |= {name: False for name in ("apply_unit_conversion_scale",) if name in compat.usd_import_options()}
    bpy.ops.wm.usd_import(filepath=contract.regular_file(file, contract.LONGEST_CHECKPOINT), **switches)
    fresh = [item for item in bpy.data.objects if item.session_uid not in known]
    bpy.context.view_layer.update()  # computes `matrix_world` of new objects
    filled = [(item, item.matrix_world.copy()) for item in fresh if item.data is not None]
    for item, matrix in filled:  # the stage's hierarchy is not needed under the root
        item.parent = None
        item.matrix_basis = matrix
        item.hide_render = True
    bpy.data.batch_remove([item for item in fresh if item.data is None])
    if not filled:
        return None
    _keep(scene, shot, take, [item for item, _ in filled], facts)
    return filled[0][0]


def find(scene: bpy.types.Scene, shot: Path, take: str) -> bpy.types.Object | None:
    """The object of a take's splats, or None if the scene no longer has it."""
    entry = scene_objects.of(scene, shot)
    kept = next((one for one in entry.splats if one.name == take), None) if entry is not None else None
    item = kept.object if kept is not None else None
    return item if item is not None and holds(scene.objects, item) else None


def remove(scene: bpy.types.Scene, shot: Path, take: str | None = None) -> bool:
    """Removes the splats of a take, or of all takes of a shot, from the file. True if there were any."""
    entry = scene_objects.of(scene, shot)
    return entry is not None and scene_objects.remove_kept(scene, entry.splats, take)


def _material() -> bpy.types.Material:
    """The material of splats: emission in the splat's colour, mixed with transparency by the opacity. One per file."""
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
    shine, clear, mix = (tree.nodes.new(f"ShaderNode{kind}") for kind in ("Emission", "BsdfTransparent", "MixShader"))
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    for place, node in enumerate((colour, shine, clear, mix, output)):
        node.location = (200.0 * place, 0.0 if node != clear else -150.0)
    tree.links.new(shine.inputs["Color"], colour.outputs["Color"])
    tree.links.new(mix.inputs[0], colour.outputs["Alpha"])
    tree.links.new(mix.inputs[1], clear.outputs[0])
    tree.links.new(mix.inputs[2], shine.outputs[0])
    tree.links.new(output.inputs["Surface"], mix.outputs[0])
    return material


def _node_group() -> bpy.types.NodeTree:
    """The node group that turns vertices into points with the splats' radii. One per file."""
    kept = next((g for g in bpy.data.node_groups if g.get(TAG) == SHOWN_AS), None)
    if kept is not None:
        return kept
    tree = bpy.data.node_groups.new(SHOWN_AS, "GeometryNodeTree")  # pyright: ignore[reportArgumentType]
    tree[TAG] = SHOWN_AS
    interface: Any = tree.interface
    interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    kinds = ("NodeGroupInput", "GeometryNodeMeshToPoints", "GeometryNodeSetMaterial", "NodeGroupOutput")
    start, points, material, end = nodes = [tree.nodes.new(kind) for kind in kinds]
    for place, node in enumerate(nodes):
        node.location = (200.0 * place, 0.0)
    radius: Any = tree.nodes.new("GeometryNodeInputNamedAttribute")
    radius.location = (0.0, -150.0)
    radius.data_type = "FLOAT"
    radius.inputs["Name"].default_value = "radius"
    shown: Any = material.inputs["Material"]
    shown.default_value = _material()
    tree.links.new(points.inputs["Mesh"], start.outputs[0])
    tree.links.new(points.inputs["Radius"], radius.outputs["Attribute"])
    tree.links.new(material.inputs["Geometry"], points.outputs[0])
    tree.links.new(end.inputs[0], material.outputs[0])
    return tree
