"""The position of the freeze in a compositor: behind the node that shows the plate, else before the output.

Inserting and removing the group only reroutes links.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import bpy

from ...torch_backend import contract
from .. import compat
from ..access import present, size_of
from ..scene import same_footage, scene_setup
from ..scene.ownership import TAG

_BEHIND_PLATE = "splannequin_stands_in"
_PICTURES = ("CompositorNodeImage", "CompositorNodeMovieClip")


def route_through(
    tree: bpy.types.NodeTree, node: bpy.types.CompositorNodeGroup, behind: bpy.types.NodeSocket | None
) -> None:
    """Routes links through our node: all links from the socket `behind`, or, with None, the link to the output."""
    if behind is not None:
        source, targets, anchor = behind, [present(link.to_socket) for link in links_of(behind)], present(behind.node)
        node.location = (anchor.location.x + anchor.width + 30.0, anchor.location.y - 320.0)
    else:
        end = present(compat.output_socket(tree) or compat.new_output_node(tree))
        source, targets, last = links_of(end)[0].from_socket if end.is_linked else None, [end], present(end.node)
        node.location = (last.location.x - node.width - 30.0, last.location.y - 160.0)
    for target in targets:
        tree.links.new(node.outputs["Image"], target)
    if source is not None:
        tree.links.new(source, node.inputs["Image"])
    present(node.node_tree)[_BEHIND_PLATE] = behind is not None


def bypass(tree: bpy.types.NodeTree, node: bpy.types.CompositorNodeGroup) -> None:
    """Undoes `route_through`: reconnects the group's input directly to the targets of its output."""
    sources = [present(link.from_socket) for link in links_of(node.inputs["Image"])]
    for target in [present(link.to_socket) for link in links_of(node.outputs["Image"])]:
        if sources:
            tree.links.new(sources[0], target)
    for link in links_of(node.inputs["Image"]):
        tree.links.remove(link)


def is_behind_plate(node: bpy.types.CompositorNodeGroup) -> bool:
    """True if our node lies behind the plate, False if it lies before the output."""
    return bool(present(node.node_tree).get(_BEHIND_PLATE))


def place_of(scene: bpy.types.Scene, footage: Sequence[Path], where: str) -> bpy.types.NodeSocket | None:
    """Socket to insert the group behind: the plate's in the artist's tree; None to insert it before the output.

    Nodes that only undistort the plate or scale it to the render size come before the group, because frozen frames
    already have both.
    Raises JobError if `where` is "PLATE" and no node shows the plate.
    """
    tree = compat.compositor_tree(scene)
    if where == "OUTPUT" or tree is None:
        return None
    end = compat.output_socket(tree)
    readers = upstream(end.node if end is not None else None)
    readers = [n for n in readers if n.bl_idname in _PICTURES and not n.get(TAG) and not n.mute]
    nodes = [n for n in tree.nodes if n in readers and any(s.is_linked for s in _pictures(n))]
    found = [n for n in nodes if same_footage.shows(_shown(n), footage)]
    if where == "PLATE" and not found:  # shown under another name: take the active node, or the only one
        found = [n for n in nodes if n == tree.nodes.active] or (nodes if len(nodes) == 1 else [])
    if not found:
        if where == "PLATE":
            raise contract.JobError(
                "No node of this compositor shows the plate.",
                "Select the Image or Movie Clip node that shows it, or insert before the output.",
                contract.ExitCode.BAKE,
            )
        return None
    socket = _pictures(found[0])[0]
    while True:
        links = links_of(socket)
        behind = links[0].to_node if len(links) == 1 else None
        if behind is None or not _conforms(scene, behind, found[0]):
            break
        following = behind.outputs[0]
        if not following.is_linked:
            break
        socket = following
    return socket


def links_of(socket: bpy.types.NodeSocket) -> list[bpy.types.NodeLink]:
    """The links that begin or end at a socket, as a list: rerouting a link changes `socket.links`."""
    return list(present(socket.links))


def _pictures(node: bpy.types.Node) -> list[bpy.types.NodeSocket]:
    """The image output of an Image or Movie Clip node in a list, which is empty for a file with data passes only."""
    return [s for s in node.outputs if s.enabled and s.type == "RGBA"][:1]


def upstream(end: bpy.types.Node | None) -> list[bpy.types.Node]:
    """`end` and all nodes that it depends on."""
    waiting: list[bpy.types.Node | None] = [end]
    found: list[bpy.types.Node] = []
    while waiting:
        node = waiting.pop()
        if node is not None and node not in found:
            found.append(node)
            waiting += [link.from_node for socket in node.inputs for link in links_of(socket)]
    return found


def _shown(node: bpy.types.Node) -> bpy.types.Image | bpy.types.MovieClip | None:
    """The footage of an Image or Movie Clip node."""
    if isinstance(node, bpy.types.CompositorNodeImage):
        return node.image
    return node.clip if isinstance(node, bpy.types.CompositorNodeMovieClip) else None


def _conforms(scene: bpy.types.Scene, node: bpy.types.Node, plate: bpy.types.Node) -> bool:
    """True if a node only undistorts the plate, or scales a plate of another size to the render size."""
    if node.mute or node.bl_idname == "CompositorNodeMovieDistortion":
        return not node.mute
    return node.bl_idname == "CompositorNodeScale" and size_of(present(_shown(plate))) != scene_setup.render_size(scene)
