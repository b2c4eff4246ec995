"""Where the freeze stands in a compositor: as the plate where a node shows it, else before the output.

Only links are moved, and led back.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from .. import compat
from ..scene import scene_setup
from ..scene.mark import TAG

_STANDS_IN = "splannequin_stands_in"
_PICTURES = ("CompositorNodeImage", "CompositorNodeMovieClip")


def lead_through(tree: Any, node: Any, behind: Any | None) -> None:
    """Leads a picture through our node: all that leaves a socket, or with None what goes to the output."""
    if behind is not None:
        source, targets, beside = behind, [link.to_socket for link in behind.links], behind.node
        node.location = (beside.location.x + beside.width + 30.0, beside.location.y - 320.0)
    else:
        end = compat.output_socket(tree) or compat.new_output_node(tree)
        source, targets = end.links[0].from_socket if end.is_linked else None, [end]
        node.location = (end.node.location.x - node.width - 30.0, end.node.location.y - 160.0)
    for target in targets:
        tree.links.new(node.outputs["Image"], target)
    if source is not None:
        tree.links.new(source, node.inputs["Image"])
    node.node_tree[_STANDS_IN] = behind is not None


def lead_past(tree: Any, node: Any) -> None:
    """Leads what goes through our node past it again."""
    sources = [link.from_socket for link in node.inputs["Image"].links]
    for target in [link.to_socket for link in node.outputs["Image"].links]:
        if sources:
            tree.links.new(sources[0], target)
    for link in list(node.inputs["Image"].links):
        tree.links.remove(link)


def stands_in(node: Any) -> bool:
    """True if our node stands behind the plate, not before the output."""
    return bool(node.node_tree.get(_STANDS_IN))


def place_of(scene: Any, footage: Sequence[Path], where: str) -> Any | None:
    """Socket that the group goes behind: the plate's, in the artist's tree; None for before the output.

    A plate that is undistorted or brought to the render's size first is taken after that, as the frozen frames are.
    """
    tree = compat.compositor_tree(scene)
    if where == "OUTPUT" or tree is None:
        return None
    led = [n for n in _upstream(tree) if n.bl_idname in _PICTURES and not n.get(TAG) and not n.mute]
    nodes = [n for n in tree.nodes if n in led and _picture(n).is_linked]
    found = [n for n in nodes if _shows(n, footage)]
    if where == "PLATE" and not found:  # by another name, then: the chosen one, or the only one
        found = [n for n in nodes if n == tree.nodes.active] or (nodes if len(nodes) == 1 else [])
    if not found:
        if where == "PLATE":
            raise contract.JobError(
                "No node of this compositor shows the plate.",
                "Select the Image or Movie Clip node that does, or insert before the output.",
                contract.ExitCode.BAKE,
            )
        return None
    socket = _picture(found[0])
    while len(socket.links) == 1 and _conforms(scene, socket.links[0].to_node, found[0]):
        following = socket.links[0].to_node.outputs[0]
        if not following.is_linked:
            break
        socket = following
    return socket


def _picture(node: Any) -> Any:
    """Output of an Image or Movie Clip node that the picture leaves through."""
    return next(s for s in node.outputs if s.enabled and s.type == "RGBA")


def _upstream(tree: Any) -> list[Any]:
    """Nodes whose picture gets to the tree's output."""
    end = compat.output_socket(tree)
    waiting, found = [end.node] if end is not None else [], []
    while waiting:
        node = waiting.pop()
        if node not in found:
            found.append(node)
            waiting += [link.from_node for socket in node.inputs for link in socket.links]
    return found


def _shows(node: Any, footage: Sequence[Path]) -> bool:
    """True if an Image or Movie Clip node shows one of these files, or another of the sequence that it belongs to."""
    data = node.image if node.bl_idname == _PICTURES[0] else node.clip
    if data is None or not data.filepath:
        return False
    numbered = data.source == "SEQUENCE"
    path = _footage_key(Path(bpy.path.abspath(data.filepath)), numbered)
    return any(path == _footage_key(known, numbered) for known in footage)


def _footage_key(path: Path, numbered: bool) -> tuple[str, str]:
    """Folder and name of a file; of one of a sequence without its number, which may stand there as ####."""
    folder, name = os.path.split(os.path.realpath(path))
    return os.path.normcase(folder), re.sub(r"\d+|#+", "#", name) if numbered else os.path.normcase(name)


def _conforms(scene: Any, node: Any, plate: Any) -> bool:
    """True if a node only undistorts the plate, or brings one of another size to the render's."""
    if node.mute or node.bl_idname == "CompositorNodeMovieDistortion":
        return not node.mute
    data = plate.image if plate.bl_idname == _PICTURES[0] else plate.clip
    return node.bl_idname == "CompositorNodeScale" and tuple(data.size) != scene_setup.render_size(scene)
