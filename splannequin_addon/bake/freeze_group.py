"""The freeze group's node in a scene's compositor: its sockets, their defaults, and the take it shows."""

from __future__ import annotations

import json
import os
from collections.abc import Set
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from .. import compat
from ..access import named, present, set_value, value_of
from ..scene.ownership import TAG
from .node_names import AS_WARP, DEPTH, FROZEN, GRAIN, GROUP_NAME, INVENTED, SOFTNESS

BEFORE = "splannequin_before"
_WARPS = "splannequin_warps"


def switch_warp(node: bpy.types.CompositorNodeGroup, wanted: bool, possible: bool) -> list[str]:
    """Adds the warp factor to our node, or removes it. Returns the changes. The inside of the group is unchanged."""
    group, name = present(node.node_tree), AS_WARP
    sockets = [i for i in compat.sockets_of(group) if i.in_out == "INPUT" and i.name == name]
    group[_WARPS] = wanted
    if wanted and possible and not sockets:
        text = "1: the input image, frozen by the take's warp; 0: the take's frames"
        _factor(compat.new_socket(group, name, "INPUT", "NodeSocketFloat", text), 1.0)
        set_value(node.inputs[name], 1.0)
        return ["The image that is linked to the group is frozen by the take's warp and keeps its pixel values."]
    if sockets and not (wanted and possible):
        present(group.interface).remove(sockets[0])
        why = "The take has no warp: its own frames are shown." if wanted else "The take's own frames are shown again."
        return [why]
    return []


def wants_warp(scene: bpy.types.Scene) -> bool:
    """True if the scene's freeze group is set to freeze its input stream by a warp, even if its take has none."""
    tree = compat.compositor_tree(scene)
    node = group_node(tree) if tree else None
    return node is not None and bool(present(node.node_tree).get(_WARPS))


def missing_layers(node: bpy.types.CompositorNodeGroup) -> list[str]:
    """A sentence for each setting of our node whose layers the take lacks."""
    inside, remarks = present(node.node_tree).nodes, list[str]()
    if value_of(node.inputs[GRAIN]) and GRAIN not in inside:
        remarks.append("The take has no grain to add. Freeze it again.")
    frozen = inside[FROZEN].outputs
    if (value_of(node.inputs["Splat"]) or value_of(node.inputs[INVENTED])) and "Plate" not in frozen:
        remarks.append("The take cannot separate plate from splats, because it was frozen without detail.")
    return remarks


def shows_plate(scene: bpy.types.Scene) -> bool:
    """True if our nodes show, or `insert` would make them show, the plate as the scene's stream."""
    tree = compat.compositor_tree(scene)
    if tree is None or not len(tree.nodes):
        return True
    node = group_node(tree)
    return node is not None and bool(json.loads(present(node.node_tree)[BEFORE])["made_tree"])


def group_node(tree: bpy.types.NodeTree) -> bpy.types.CompositorNodeGroup | None:
    """The freeze group's node in a compositor tree, or None."""
    groups = (n for n in tree.nodes if isinstance(n, bpy.types.CompositorNodeGroup))
    return next((n for n in groups if _is_ours(n.node_tree)), None)


def shown(scene: bpy.types.Scene) -> tuple[Path, float] | None:
    """(folder of the take that the freeze group shows, its depth factor); None without the group."""
    tree = compat.compositor_tree(scene)
    node = group_node(tree) if tree else None
    if node is None:
        return None
    inside = present(node.node_tree).nodes
    frozen, depth = named(inside, FROZEN), named(inside, DEPTH)
    if not isinstance(frozen, bpy.types.CompositorNodeImage) or frozen.image is None or depth is None:
        return None
    file = Path(os.path.abspath(bpy.path.abspath(frozen.image.filepath)))
    return file.parent, float(value_of(depth.inputs[1]))


def cg_softness(scene: bpy.types.Scene) -> bpy.types.NodeSocket | None:
    """The freeze group's input for the softness between CG and frozen depth. None if no CG is linked, or if this input
    itself has a link."""
    tree = compat.compositor_tree(scene)
    node = group_node(tree) if tree else None
    if node is None or not node.inputs["CG"].is_linked:
        return None
    socket = node.inputs.get(SOFTNESS)  # missing in a group of an earlier version until it is updated
    return None if socket is None or socket.is_linked else socket


def set_depth_scale(scene: bpy.types.Scene, scale: float) -> None:
    """Sets the depth factor of the freeze group. Call it only if `shown` returns a take."""
    node = present(group_node(single_user_tree(scene)))
    set_value(present(node.node_tree).nodes[DEPTH].inputs[1], scale)


def single_user_tree(scene: bpy.types.Scene) -> bpy.types.NodeTree:
    """The scene's compositor tree. Afterwards no other scene shares this tree or our group.

    Shared data is copied. The scene must have a tree.
    """
    # A copied scene shares our group, and since Blender 5.0 a linked copy shares the whole tree.
    tree = compat.single_user_compositor_tree(scene)
    nodes = [n for n in tree.nodes if isinstance(n, bpy.types.CompositorNodeGroup) and _is_ours(n.node_tree)]
    for group in {present(n.node_tree) for n in nodes}:
        instances = [n for n in nodes if n.node_tree == group]
        if group.users - int(group.use_fake_user) > len(instances):
            fresh = group.copy()
            for node in instances:
                node.node_tree = fresh
    return tree


def _is_ours(group: bpy.types.NodeTree | None) -> bool:
    return group is not None and bool(group.get(TAG))


_FACTORS = (
    ("Mix", 1.0, "0: the input image, 1: the frozen frame"),
    ("Wipe", 1.0, "The frozen frame is shown to the left of this position: 0 is the left edge, 1 the right edge"),
    ("Only Supported", 0.0, "1: the input image is shown where the frozen frame is guessed"),
    ("Only Moving", 0.0, "1: the input image is shown where nothing moves in the footage"),
)
# Factors that only takes with detail support.
_LOOKS = (
    ("Splat", 0.0, "1: only the splats, before pixels from the plates are added"),
    (INVENTED, 0.0, "1: areas from splats are tinted, areas from a plate are not"),
)
_SOFTNESS_TIP = (
    "Distance in scene units around a frozen surface over which objects fade from front to back, for "
    "hair, smoke and contacts. 0: a hard edge"
)
_OUT = tuple(layer for layer in contract.FRAME_LAYERS if layer.output and layer.part != "passes")
_PASSES = tuple(layer for layer in contract.layers_of("passes") if layer.output)


def _factor(socket: Any, value: float) -> None:
    """Sets up a new float socket of a group as a factor from 0 to 1."""
    socket.default_value, socket.min_value, socket.max_value, socket.subtype = value, 0.0, 1.0, "FACTOR"


def add_sockets(group: bpy.types.NodeTree) -> set[str]:
    """Adds the missing sockets to a group; sockets of an older version stay. Returns the names of new inputs."""
    existing = {(i.in_out, i.name) for i in compat.sockets_of(group)}
    added: set[str] = set()

    def new(name: str, side: str, kind: str, text: str) -> Any:
        if (side, name) in existing:
            return None
        if side == "INPUT":
            added.add(name)
        return compat.new_socket(group, name, side, kind, text)

    new("Image", "INPUT", "NodeSocketColor", "Input image")
    for name, value, text in (*_FACTORS, *_LOOKS):
        socket = new(name, "INPUT", "NodeSocketFloat", text)
        if socket is not None:
            _factor(socket, value)
    grain = new(GRAIN, "INPUT", "NodeSocketFloat", "0: the frozen frame is clean, 1: it has as much grain as the plate")
    if grain is not None:
        grain.default_value, grain.min_value, grain.max_value = 0.0, 0.0, 10.0
    cg = new(
        "CG", "INPUT", "NodeSocketColor", "Objects rendered on a transparent film, to place among the frozen people"
    )
    if cg is not None:
        cg.default_value = (0.0, 0.0, 0.0, 0.0)
    far = new("CG Depth", "INPUT", "NodeSocketFloat", "Depth pass of the rendered objects")
    if far is not None:
        far.default_value = contract.NO_DEPTH
    soft = new(SOFTNESS, "INPUT", "NodeSocketFloat", _SOFTNESS_TIP)
    if soft is not None:
        soft.default_value, soft.min_value, soft.subtype = 0.0, 0.0, "DISTANCE"
    for layer in _OUT:
        new(layer.output, "OUTPUT", layer.socket, layer.tip)
    return added


def update_passes(node: bpy.types.CompositorNodeGroup, layers: Set[str]) -> list[str]:
    """Adds the outputs of the take's passes to our node, and removes the outputs of missing passes.

    A linked output stays even if its pass is missing. Returns a sentence for each such output.
    """
    group, remarks = present(node.node_tree), list[str]()
    outputs = {i.name: i for i in compat.sockets_of(group) if i.in_out == "OUTPUT"}
    for layer in _PASSES:
        name = layer.output
        if layer.name in layers:
            if name not in outputs:
                compat.new_socket(group, name, "OUTPUT", layer.socket, layer.tip)
        elif name in outputs and node.outputs[name].is_linked:
            remarks.append(f"The take has no {name}, but your compositor uses it. Freeze again with Passes.")
        elif name in outputs:
            present(group.interface).remove(outputs[name])
    return remarks


def set_defaults(node: bpy.types.CompositorNodeGroup, names: set[str]) -> None:
    """Sets the named inputs of our node to their defaults."""
    # A node does not always inherit its group's defaults.
    for name, value, _ in (*_FACTORS, *_LOOKS):
        if name in names:
            set_value(node.inputs[name], value)
    if GRAIN in names:
        set_value(node.inputs[GRAIN], 0.0)
    if "CG" in names:
        set_value(node.inputs["CG"], (0.0, 0.0, 0.0, 0.0))
    if "CG Depth" in names:
        set_value(node.inputs["CG Depth"], contract.NO_DEPTH)
    if SOFTNESS in names:
        set_value(node.inputs[SOFTNESS], 0.0)


def new_node(tree: bpy.types.NodeTree, before: dict[str, bool]) -> bpy.types.CompositorNodeGroup:
    """A node of a new group with all sockets and an empty inside. `before` is the compositor's earlier state."""
    group = bpy.data.node_groups.new(GROUP_NAME, "CompositorNodeTree")
    assert isinstance(group, bpy.types.CompositorNodeTree)
    group[TAG] = True
    group[BEFORE] = json.dumps(before)
    add_sockets(group)
    node = tree.nodes.new("CompositorNodeGroup")
    assert isinstance(node, bpy.types.CompositorNodeGroup)
    node.node_tree = group
    node.name = node.label = GROUP_NAME
    node.width = 240.0  # wide enough to show "Show What Is Invented" and "CG Depth" with their values
    set_defaults(node, {s.name for s in node.inputs})
    return node
