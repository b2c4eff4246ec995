"""The node of the freeze in a scene's compositor: its sockets, their defaults, and what it shows."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from .. import compat
from ..scene.mark import TAG
from .node_names import AS_WARP, DEPTH, FROZEN, GRAIN, GROUP_NAME, INVENTED

BEFORE = "splannequin_before"
_WARPS = "splannequin_warps"


def switch_warp(node: Any, wanted: bool, possible: bool) -> list[str]:
    """Gives our node the factor of the warp, or takes it away; says what was changed. The inside is not touched."""
    group, face, name = node.node_tree, node.node_tree.interface, AS_WARP
    there = [i for i in face.items_tree if i.item_type == "SOCKET" and i.in_out == "INPUT" and i.name == name]
    group[_WARPS] = wanted
    if wanted and possible and not there:
        text = "1: the plate that you lead in, frozen by the take's warp; 0: the take's own frames"
        _factor(face.new_socket(name, in_out="INPUT", socket_type="NodeSocketFloat", description=text), 1.0)
        node.inputs[name].default_value = 1.0
        return ["What is led into the group is frozen by the take's warp, with its own values."]
    if there and not (wanted and possible):
        face.remove(there[0])
        why = "The take has no warp: its own frames are shown." if wanted else "The take's own frames are shown again."
        return [why]
    return []


def wants_warp(scene: Any) -> bool:
    """True if the scene's freeze group freezes the stream that is led into it, or would if its take had a warp."""
    tree = compat.compositor_tree(scene)
    node = group_node(tree) if tree else None
    return node is not None and bool(node.node_tree.get(_WARPS))


def lacking(node: Any) -> list[str]:
    """What our node is asked for that the take does not have, in words."""
    inside, asked = node.node_tree.nodes, []
    if node.inputs[GRAIN].default_value and GRAIN not in inside:
        asked.append("The take has no grain to add: freeze it again.")
    frozen = inside[FROZEN].outputs
    if (node.inputs["Splat"].default_value or node.inputs[INVENTED].default_value) and "Plate" not in frozen:
        asked.append("The take does not tell plate from splats: it was frozen without detail.")
    return asked


def shows_plate(scene: Any) -> bool:
    """True if the plate is the stream of the scene's tree: one that was made here, or that `insert` would make."""
    tree = compat.compositor_tree(scene)
    if tree is None or not len(tree.nodes):
        return True
    node = group_node(tree)
    return node is not None and bool(json.loads(node.node_tree[BEFORE])["made_tree"])


def group_node(tree: Any) -> Any | None:
    """Our group's node in a compositor tree, or None."""
    return next((n for n in tree.nodes if n.bl_idname == "CompositorNodeGroup" and _is_ours(n.node_tree)), None)


def shown(scene: Any) -> tuple[Path, float] | None:
    """(folder of the take that the freeze group shows, what its depth is multiplied by); None without the group."""
    tree = compat.compositor_tree(scene)
    node = group_node(tree) if tree else None
    if node is None:
        return None
    frozen, depth = node.node_tree.nodes.get(FROZEN), node.node_tree.nodes.get(DEPTH)
    if frozen is None or frozen.image is None or depth is None:
        return None
    file = Path(os.path.abspath(bpy.path.abspath(frozen.image.filepath)))
    return file.parent, float(depth.inputs[1].default_value)


def set_depth_scale(scene: Any, scale: float) -> None:
    """Has the freeze group multiply depth by another scale. Only where `shown` says that there is one."""
    node = group_node(compat.compositor_tree(scene))
    node.node_tree.nodes[DEPTH].inputs[1].default_value = scale


def _is_ours(group: Any) -> bool:
    return group is not None and bool(group.get(TAG))


_FACTORS = (
    ("Mix", 1.0, "0: your stream, 1: the frozen frame"),
    ("Wipe", 1.0, "The frozen frame shows left of here: 0 is the left edge, 1 the right"),
    ("Only Supported", 0.0, "1: your stream shows through where the frozen frame is a guess"),
    ("Only Moving", 0.0, "1: your stream shows through where nothing moves in the footage"),
)
_LOOKS = (
    ("Splat", 0.0, "1: the splats alone, as they were before the plates' pixels came in"),
    (INVENTED, 0.0, "1: what splats made up is tinted, what comes from a plate is not"),
)
"""Factors of what only takes with detail can show."""
_OUT = tuple((layer.output, layer.socket, layer.tip) for layer in contract.FRAME_LAYERS if layer.output)


def _factor(socket: Any, value: float) -> None:
    """Makes a new socket of a group a factor from 0 to 1."""
    socket.default_value, socket.min_value, socket.max_value, socket.subtype = value, 0.0, 1.0, "FACTOR"


def give_sockets(group: Any) -> set[str]:
    """Gives a group the sockets that it lacks, those of an older version stay; returns the names of new inputs."""
    face = group.interface
    there = {(i.in_out, i.name) for i in face.items_tree if i.item_type == "SOCKET"}
    given: set[str] = set()

    def new(name: str, side: str, kind: str, text: str) -> Any:
        if (side, name) in there:
            return None
        if side == "INPUT":
            given.add(name)
        return face.new_socket(name, in_out=side, socket_type=kind, description=text)

    new("Image", "INPUT", "NodeSocketColor", "Your stream, up to here")
    for name, value, text in (*_FACTORS, *_LOOKS):
        socket = new(name, "INPUT", "NodeSocketFloat", text)
        if socket is not None:
            _factor(socket, value)
    grain = new(GRAIN, "INPUT", "NodeSocketFloat", "0: the frozen frame is clean, 1: it has as much grain as the plate")
    if grain is not None:
        grain.default_value, grain.min_value, grain.max_value = 0.0, 0.0, 10.0
    cg = new("CG", "INPUT", "NodeSocketColor", "Rendered objects on a transparent film, to stand among the frozen")
    if cg is not None:
        cg.default_value = (0.0, 0.0, 0.0, 0.0)
    far = new("CG Depth", "INPUT", "NodeSocketFloat", "Depth pass of the rendered objects")
    if far is not None:
        far.default_value = contract.NO_DEPTH
    for name, kind, text in _OUT:
        new(name, "OUTPUT", kind, text)
    return given


def set_defaults(node: Any, names: set[str]) -> None:
    """Gives the named inputs of our node their values: a node does not always take its group's."""
    for name, value, _ in (*_FACTORS, *_LOOKS):
        if name in names:
            node.inputs[name].default_value = value
    if GRAIN in names:
        node.inputs[GRAIN].default_value = 0.0
    if "CG" in names:
        node.inputs["CG"].default_value = (0.0, 0.0, 0.0, 0.0)
    if "CG Depth" in names:
        node.inputs["CG Depth"].default_value = contract.NO_DEPTH


def new_node(tree: Any, before: dict[str, bool]) -> Any:
    """A node of a new group, with all its sockets and nothing inside; `before` says how the compositor was."""
    group = bpy.data.node_groups.new(GROUP_NAME, "CompositorNodeTree")
    group[TAG] = True
    group[BEFORE] = json.dumps(before)
    give_sockets(group)
    node = tree.nodes.new("CompositorNodeGroup")
    node.node_tree = group
    node.name = node.label = GROUP_NAME
    node.width = 180.0
    set_defaults(node, {s.name for s in node.inputs})
    return node
