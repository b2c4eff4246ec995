"""The node group "Splannequin Freeze" in the scene's compositor: inserted, updated, removed.

It stands in for the plate where a node of the artist's tree shows it, so that the grade goes on from there; else before
the output. Nothing else in the tree is touched: the links that leave the plate, or the one into the output, are led
through the group, and led back when the group is removed. The group reads the take's multilayer EXR files; scene frame
n shows n.exr. Where the take was frozen with detail the group can tell plate from splats, and freeze the stream that is
led into it by the take's warp, see `warp_nodes`.
"""

from __future__ import annotations

import json
import os
import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...torch_backend import contract
from .. import compat
from . import warp_nodes

GROUP_NAME = "Splannequin Freeze"
_TAG = "splannequin"
_STANDS_IN = "splannequin_stands_in"
_PICTURES = ("CompositorNodeImage", "CompositorNodeMovieClip")
_BEFORE = "splannequin_before"
_WARPS = "splannequin_warps"
_CG = "cg"
_LAYERS = tuple(layer.name for layer in contract.layers_of(""))
"""Of every frozen frame; what else is in the table is in some."""
_FROZEN, _DEPTH = "Frozen", "Depth in scene units"
"""Nodes inside the group."""
_GAP = 200.0
_NOTHING = 0.1 * contract.NO_DEPTH
"""A depth of CG from here on is no surface's."""
_SOFT = 0.01
"""Share of the frozen depth within which CG goes from in front to behind. What is as far as the frozen is in front:
frozen depth is a little uneven, and would come through what stands on it."""


@dataclass
class Take:
    """Frozen frames on disk, as the compositor reads them."""

    folder: Path
    """Folder of NNNNNN.exr."""
    first: int
    """First frame number there is."""
    last: int
    """Last frame number there is, inclusive."""
    depth_scale: float = 1.0
    """Scene units per solve unit: what the depth layer is multiplied by."""
    size: tuple[int, int] = (0, 0)
    """Width and height of the frames in pixels, without overscan."""
    margin: tuple[int, int] = (0, 0)
    """Pixels beyond the frame on the left and right, and above and below: overscan."""
    plate_size: tuple[int, int] = (0, 0)
    """Width and height in pixels of the plate that the take's warp is for; (0, 0): it has none."""


def insert(
    scene: Any,
    take: Take,
    plate: Path | None = None,
    footage: Sequence[Path] = (),
    where: str = "AUTO",
    warp: bool | None = None,
) -> list[str]:
    """Puts the freeze group into the scene's compositor, or updates the one that is there.

    Args:
        scene: the scene; given a minimal tree (plate, group, output) if it has none.
        take: the frozen frames.
        plate: first file of the undistorted plate, for the minimal tree.
        footage: files by which a node that shows the plate is known: the plate's, the clip's.
        where: "PLATE" behind the node that shows the plate, "OUTPUT" before the output, "AUTO" the first of these
            that there is. A group that is there already stays where it is with "AUTO".
        warp: the group freezes the stream that is led into it, by the take's warp, instead of showing the take's own
            frames; None: as it does, or not.

    Returns:
        What was changed, one sentence each.

    Raises:
        contract.JobError: "PLATE", and no node shows it.
        ValueError: the frames lack a layer, or Blender cannot show them or the plate. The tree is as it was.
    """
    changes: list[str] = []
    behind = _place_of(scene, footage, where)
    wanted = wants_warp(scene) if warp is None else warp
    frozen, flow, stream = _frozen_image(take), _warp_image(take) if wanted else None, None
    if plate is not None and shows_plate(scene):
        stream = load_sequence(plate, _plate_name(plate), "srgb")
    enabled = compat.compositor_enabled(scene)
    before = {**compat.compositor_switches(scene), "made_tree": False}
    tree = compat.compositor_tree(scene)
    if tree is None or not len(tree.nodes):
        tree = compat.new_compositor_tree(scene, "Splannequin Compositing")
        before["made_tree"] = True
        changes.append("The scene had no compositor tree: a minimal one was made.")
    if not enabled:
        compat.enable_compositor(scene)
        if not before["made_tree"]:
            changes.append("The compositor was switched on.")
    node = group_node(tree)
    if node is None:
        node = _insert_node(tree, before)
        _lead_through(tree, node, behind)
        place = "as the plate: what follows it goes on from there" if behind is not None else "before the output"
        changes.append(f'The node group "{GROUP_NAME}" was inserted {place}.')
    else:
        if where != "AUTO" and _stands_in(node) != (behind is not None):
            _lead_past(tree, node)
            _lead_through(tree, node, behind)
            changes.append(f'The node group "{GROUP_NAME}" was moved.')
        _set_defaults(node, _give_sockets(node.node_tree))
        changes.append(f'The node group "{GROUP_NAME}" was updated.')
    changes += _switch_warp(node, wanted, flow is not None)
    _fill_group(scene, node, take, frozen, flow)
    changes += _lacking(node)
    if stream is not None:
        _show_plate(scene, tree, node, stream, take)
    return changes


def _frozen_image(take: Take) -> Any:
    """The take's frames as a data-block. ValueError if they lack a layer."""
    image = load_sequence(frame_path(take.folder, take.first), f"Frozen {take.folder.name}", "linear")
    return _with_layers(image, take, _LAYERS)


def _warp_image(take: Take) -> Any | None:
    """The take's warp as a data-block, None if it has none. ValueError if it lacks a layer."""
    return _with_layers(load_sequence(*_warp_picture(take)), take, warp_nodes.LAYERS) if any(take.plate_size) else None


def _with_layers(image: Any, take: Take, names: Sequence[str]) -> Any:
    """A sequence of the take, once it is known to have some layers. ValueError if not."""
    group = bpy.data.node_groups.new(GROUP_NAME, "CompositorNodeTree")
    try:
        node = group.nodes.new("CompositorNodeImage")
        show_sequence(node, image, take.first, take.last)
        missing = [n for n in names if n not in node.outputs]
    finally:
        bpy.data.node_groups.remove(group)
    if missing:
        raise ValueError(f"the frames in {take.folder} have no layer {missing[0]!r}: freeze the take again")
    return image


def _switch_warp(node: Any, wanted: bool, possible: bool) -> list[str]:
    """Gives our node the factor of the warp, or takes it away; says what was changed. The inside is not touched."""
    group, face, name = node.node_tree, node.node_tree.interface, warp_nodes.FACTOR
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


def _lacking(node: Any) -> list[str]:
    """What our node is asked for that the take does not have, in words."""
    inside, asked = node.node_tree.nodes, []
    if node.inputs[_GRAIN].default_value and _GRAIN not in inside:
        asked.append("The take has no grain to add: freeze it again.")
    frozen = inside[_FROZEN].outputs
    if (node.inputs["Splat"].default_value or node.inputs[_INVENTED].default_value) and "Plate" not in frozen:
        asked.append("The take does not tell plate from splats: it was frozen without detail.")
    return asked


def shows_plate(scene: Any) -> bool:
    """True if the plate is the stream of the scene's tree: one that was made here, or that `insert` would make."""
    tree = compat.compositor_tree(scene)
    if tree is None or not len(tree.nodes):
        return True
    node = group_node(tree)
    return node is not None and bool(json.loads(node.node_tree[_BEFORE])["made_tree"])


def may_combine_cg(scene: Any) -> Any:
    """Our node, if the scene's render can be led into it. JobError if it is not there, or its CG is taken."""
    tree = compat.compositor_tree(scene)
    node = group_node(tree) if tree else None
    if node is None:
        raise contract.JobError("The freeze is not in this compositor.", "Bake first.", contract.ExitCode.BAKE)
    if node.inputs["CG"].is_linked:
        raise contract.JobError(
            f'Something is led into "CG" of {GROUP_NAME} already.',
            "Unlink it to have it done here.",
            contract.ExitCode.BAKE,
        )
    return node


def combine_cg(scene: Any) -> list[str]:
    """Leads the scene's own render into the group, where it stands among the frozen by depth; says what was changed.

    The view layer must have its depth pass. JobError as `may_combine_cg`.
    """
    node, tree = may_combine_cg(scene), compat.compositor_tree(scene)
    layers = tree.nodes.new("CompositorNodeRLayers")
    layers[_TAG] = _CG
    layers.scene = scene
    layers.name = layers.label = "CG among the frozen"
    layers.location = (node.location.x - 2 * _GAP, node.location.y - 300.0)
    tree.links.new(layers.outputs["Image"], node.inputs["CG"])
    tree.links.new(layers.outputs["Depth"], node.inputs["CG Depth"])
    return ["The scene's own render was led into the freeze: objects stand among the frozen people by depth."]


def group_node(tree: Any) -> Any | None:
    """Our group's node in a compositor tree, or None."""
    return next((n for n in tree.nodes if n.bl_idname == "CompositorNodeGroup" and _is_ours(n.node_tree)), None)


def shown(scene: Any) -> tuple[Path, float] | None:
    """(folder of the take that the freeze group shows, what its depth is multiplied by); None without the group."""
    tree = compat.compositor_tree(scene)
    node = group_node(tree) if tree else None
    if node is None:
        return None
    frozen, depth = node.node_tree.nodes.get(_FROZEN), node.node_tree.nodes.get(_DEPTH)
    if frozen is None or frozen.image is None or depth is None:
        return None
    file = Path(os.path.abspath(bpy.path.abspath(frozen.image.filepath)))
    return file.parent, float(depth.inputs[1].default_value)


def set_depth_scale(scene: Any, scale: float) -> None:
    """Has the freeze group multiply depth by another scale. Only where `shown` says that there is one."""
    node = group_node(compat.compositor_tree(scene))
    node.node_tree.nodes[_DEPTH].inputs[1].default_value = scale


def remove(scene: Any) -> bool:
    """Takes the group out, leads the link back, deletes what only we used. True if there was one."""
    tree = compat.compositor_tree(scene)
    node = group_node(tree) if tree else None
    if tree is None or node is None:
        return False
    group = node.node_tree
    before = json.loads(group.get(_BEFORE, "{}"))
    _lead_past(tree, node)
    images = [n.image for n in group.nodes if n.bl_idname == "CompositorNodeImage" and n.image]
    textures = [n.texture for n in group.nodes if n.bl_idname == "CompositorNodeTexture" and n.texture]
    tree.nodes.remove(node)
    if group.users == 0:  # another scene may show it
        bpy.data.node_groups.remove(group)
    for ours in [n for n in tree.nodes if n.get(_TAG)]:
        images += [ours.image] if getattr(ours, "image", None) else []
        tree.nodes.remove(ours)
    if before.get("made_tree") and not [n for n in tree.nodes if n.bl_idname not in _OUTPUTS]:
        compat.drop_compositor_tree(scene)
    compat.restore_compositor_switches(scene, before)
    for image in {i.name: i for i in images}.values():
        if image.users == 0:
            bpy.data.images.remove(image)
    for texture in textures:
        if texture.users == 0:
            bpy.data.textures.remove(texture)
    return True


def take_of(folder: Path, depth_scale: float = 1.0) -> Take:
    """The take in a folder. FileNotFoundError if it holds no frozen frame."""
    numbers = frame_numbers(folder)
    if not numbers:
        raise FileNotFoundError(f"{folder} holds no frozen frames (NNNNNN.exr)")
    windows = exr_windows(frame_path(folder, numbers[0]))
    return Take(folder, numbers[0], numbers[-1], depth_scale, *windows, _plate_size(folder, numbers))


def _plate_size(take: Path, numbers: Sequence[int]) -> tuple[int, int]:
    """Width and height of the plate that a take's warp is for; (0, 0) if a frame lacks its warp."""
    folder = take / warp_nodes.FOLDER
    if set(numbers) - set(frame_numbers(folder)):
        return 0, 0
    header = _exr_header(frame_path(folder, numbers[0]))
    found = [_exr_value(header, f"splannequin:{name}", "int", "<i") for name in ("plateWidth", "plateHeight")]
    return (found[0][0], found[1][0]) if found[0] and found[1] else (0, 0)


def exr_size(path: Path) -> tuple[int, int]:
    """Width and height of an EXR's frame, as `exr_windows`."""
    return exr_windows(path)[0]


def exr_windows(path: Path) -> tuple[tuple[int, int], tuple[int, int]]:
    """An EXR's width and height, and the pixels it has beyond them left and right, and above and below.

    From its header: Blender says 0 x 0 of a multilayer file. ValueError without one, or for margins that are not the
    same on opposite sides: Blender centres the pixels, wherever the frame lies in them.
    """
    header = _exr_header(path)
    frame, data = (_exr_value(header, name, "box2i", "<4i") for name in ("displayWindow", "dataWindow"))
    if frame is None or data is None:
        raise ValueError(f"{path} is no OpenEXR file: render the take again")
    (left, top, right, bottom), (data_left, data_top, data_right, data_bottom) = frame, data
    margin = (left - data_left, top - data_top)
    if margin != (data_right - right, data_bottom - bottom) or min(margin) < 0:
        raise ValueError(f"{path} does not reach equally far beyond its frame on all sides: render the take again")
    return (right - left + 1, bottom - top + 1), margin


def _exr_header(path: Path) -> bytes:
    """What a file begins with, attributes first; empty if it is no OpenEXR file."""
    with contract.open_regular(path) as source:
        header = source.read(16384)
    return header if header[:4] == b"\x76\x2f\x31\x01" else b""


def _exr_value(header: bytes, name: str, kind: str, form: str) -> tuple[Any, ...] | None:
    """Value of an attribute, as `struct` unpacks it; None if the header lacks it."""
    key = f"{name}\0{kind}\0".encode()
    at = header.find(key)
    return None if at < 0 else struct.unpack_from(form, header, at + len(key) + 4)


def frame_numbers(folder: Path, suffix: str = ".exr") -> list[int]:
    """Numbers of the frames in a folder, ascending; empty if there is no such folder."""
    if not folder.is_dir():
        return []
    found = (contract.frame_number(p.stem) for p in folder.iterdir() if p.suffix == suffix)
    return sorted(number for number in found if number is not None)


def frame_path(folder: Path, frame: int, suffix: str = ".exr") -> Path:
    """Path of a frame in a folder of frames."""
    return folder / contract.frame_file(frame, suffix)


_ahead: set[str] = set()
"""Files that `read_ahead` has just had read: the next `load_sequence` takes them as they are."""


def read_ahead(take: Take, plate: Path | None = None, warp: bool = False) -> Iterator[None]:
    """Has Blender read what `insert` needs, one picture a turn: it does so while its window stands still."""
    wanted = [(frame_path(take.folder, take.first), f"Frozen {take.folder.name}", "linear")]
    if warp and any(take.plate_size):
        wanted.append(_warp_picture(take))
    if plate is not None:
        wanted.append((plate, _plate_name(plate), "srgb"))
    for path, name, encoding in wanted:
        _read(path, name, encoding, take)
        yield


def _warp_picture(take: Take) -> tuple[Path, str, str]:
    """File, name and encoding of a take's warp."""
    return frame_path(take.folder / warp_nodes.FOLDER, take.first), f"Warp {take.folder.name}", "linear"


def forget_ahead() -> None:
    """Drops what is known of pictures read ahead: another file has others."""
    _ahead.clear()


def _read(path: Path, name: str, encoding: str, take: Take) -> None:
    """Has a picture of a sequence read: a node does it for the frame that it shows."""
    _ahead.discard(os.path.abspath(path))
    image = load_sequence(path, name, encoding)
    reader = bpy.data.node_groups.new(GROUP_NAME, "CompositorNodeTree")
    try:
        show_sequence(reader.nodes.new("CompositorNodeImage"), image, take.first, take.last)
    finally:
        bpy.data.node_groups.remove(reader)
    _ahead.add(os.path.abspath(path))


def _plate_name(plate: Path) -> str:
    return f"Plate {plate.parent.parent.stem}"


def load_sequence(path: Path, name: str, encoding: str) -> Any:
    """An image sequence as a data-block, reused by path; `encoding` is "linear" or "srgb"."""
    wanted = os.path.abspath(path)
    for image in bpy.data.images:
        if image.get(_TAG) and os.path.abspath(bpy.path.abspath(image.filepath)) == wanted:
            if wanted not in _ahead:
                image.reload()
            _ahead.discard(wanted)
            return image
    compat.colour_space(encoding)  # before anything is made: a configuration may have none
    image = bpy.data.images.load(wanted)
    image.name = name
    image.source = "SEQUENCE"
    image[_TAG] = True
    compat.set_image_colour(image, encoding)
    image.filepath = blend_path(path)
    return image


def blend_path(path: Path) -> str:
    """`path` as a .blend should hold it: relative to the file if it is saved and on the same drive."""
    absolute = os.path.abspath(path)
    if not bpy.data.filepath:
        return absolute
    try:
        return bpy.path.relpath(absolute)
    except ValueError:  # another drive on Windows
        return absolute


def relative_images() -> None:
    """Makes the paths of our images relative to the .blend, once it has a place."""
    for image in bpy.data.images:
        if image.get(_TAG) and image.filepath:
            image.filepath = blend_path(Path(bpy.path.abspath(image.filepath)))


_OUTPUTS = ("CompositorNodeComposite", "NodeGroupOutput", "NodeGroupInput")


def _is_ours(group: Any) -> bool:
    return group is not None and bool(group.get(_TAG))


_FACTORS = (
    ("Mix", 1.0, "0: your stream, 1: the frozen frame"),
    ("Wipe", 1.0, "The frozen frame shows left of here: 0 is the left edge, 1 the right"),
    ("Only Supported", 0.0, "1: your stream shows through where the frozen frame is a guess"),
    ("Only Moving", 0.0, "1: your stream shows through where nothing moves in the footage"),
)
_GRAIN = "Grain"
_INVENTED = "Show What Is Invented"
_LOOKS = (
    ("Splat", 0.0, "1: the splats alone, as they were before the plates' pixels came in"),
    (_INVENTED, 0.0, "1: what splats made up is tinted, what comes from a plate is not"),
)
"""Factors of what only takes with detail can show."""
_OUT = tuple((layer.output, layer.socket, layer.tip) for layer in contract.FRAME_LAYERS if layer.output)


def _factor(socket: Any, value: float) -> None:
    """Makes a new socket of a group a factor from 0 to 1."""
    socket.default_value, socket.min_value, socket.max_value, socket.subtype = value, 0.0, 1.0, "FACTOR"


def _give_sockets(group: Any) -> set[str]:
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
    grain = new(
        _GRAIN, "INPUT", "NodeSocketFloat", "0: the frozen frame is clean, 1: it has as much grain as the plate"
    )
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


def _set_defaults(node: Any, names: set[str]) -> None:
    """Gives the named inputs of our node their values: a node does not always take its group's."""
    for name, value, _ in (*_FACTORS, *_LOOKS):
        if name in names:
            node.inputs[name].default_value = value
    if _GRAIN in names:
        node.inputs[_GRAIN].default_value = 0.0
    if "CG" in names:
        node.inputs["CG"].default_value = (0.0, 0.0, 0.0, 0.0)
    if "CG Depth" in names:
        node.inputs["CG Depth"].default_value = contract.NO_DEPTH


def _insert_node(tree: Any, before: dict[str, bool]) -> Any:
    group = bpy.data.node_groups.new(GROUP_NAME, "CompositorNodeTree")
    group[_TAG] = True
    group[_BEFORE] = json.dumps(before)
    _give_sockets(group)
    node = tree.nodes.new("CompositorNodeGroup")
    node.node_tree = group
    node.name = node.label = GROUP_NAME
    node.width = 180.0
    _set_defaults(node, {s.name for s in node.inputs})
    return node


def _lead_through(tree: Any, node: Any, behind: Any | None) -> None:
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


def _lead_past(tree: Any, node: Any) -> None:
    """Leads what goes through our node past it again."""
    sources = [link.from_socket for link in node.inputs["Image"].links]
    for target in [link.to_socket for link in node.outputs["Image"].links]:
        if sources:
            tree.links.new(sources[0], target)
    for link in list(node.inputs["Image"].links):
        tree.links.remove(link)


def _stands_in(node: Any) -> bool:
    """True if our node stands behind the plate, not before the output."""
    return bool(node.node_tree.get(_STANDS_IN))


def _place_of(scene: Any, footage: Sequence[Path], where: str) -> Any | None:
    """Socket that the group goes behind: the plate's, in the artist's tree; None for before the output.

    A plate that is undistorted or brought to the render's size first is taken after that, as the frozen frames are.
    """
    tree = compat.compositor_tree(scene)
    if where == "OUTPUT" or tree is None:
        return None
    led = [n for n in _upstream(tree) if n.bl_idname in _PICTURES and not n.get(_TAG) and not n.mute]
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
    return node.bl_idname == "CompositorNodeScale" and tuple(data.size) != render_size(scene)


def _fill_group(scene: Any, node: Any, take: Take, image: Any, warp: Any | None) -> None:
    """(Re)builds the inside of our node's group; its sockets, and so the links around it, stay."""
    group, shown = node.node_tree, {i.name for i in (image, warp) if i is not None}
    old = {n.image.name for n in group.nodes if n.bl_idname == "CompositorNodeImage" and n.image} - {_RAMP}
    group.nodes.clear()
    enter = group.nodes.new("NodeGroupInput")
    leave = group.nodes.new("NodeGroupOutput")
    frozen = group.nodes.new("CompositorNodeImage")
    frozen.name = frozen.label = _FROZEN
    show_sequence(frozen, image, take.first, take.last)
    mix, factor, first, second, mixed = compat.new_mix_node(group)
    depth = compat.new_math_node(group)
    depth.name = depth.label = _DEPTH
    depth.inputs[1].default_value = take.depth_scale
    enter.location, frozen.location = (-2 * _GAP, 150.0), (-3 * _GAP, -100.0)
    mix.location, depth.location, leave.location = (3 * _GAP, 150.0), (_GAP, -100.0), (4 * _GAP, 0.0)

    layers = {n: frozen.outputs[n] for n in (layer.name for layer in contract.FRAME_LAYERS) if n in frozen.outputs}
    if warp is not None:
        layers["Combined"] = _warped(group, enter, layers["Combined"], warp, take)
    if "Plate" in layers:
        layers["Combined"] = _looked_at(group, enter, layers)
    layers.pop("Splat", None)
    fitted = _fitted(scene, group, take, layers)
    share = _share(group, enter, fitted)
    nearer = _nearer(group, _cg_depth(group, enter), depth.outputs[0])
    group.links.new(share, factor)
    # CG stands in both: Mix, Wipe and mattes choose between stream and frozen frame, not whether an object is there.
    group.links.new(_among(group, enter, enter.outputs["Image"], nearer, "CG in your stream"), first)
    group.links.new(_among(group, enter, _grainy(group, enter, fitted), nearer, "CG among the frozen"), second)
    group.links.new(mixed, leave.inputs["Image"])
    group.links.new(fitted["Depth"], depth.inputs[0])
    group.links.new(depth.outputs[0], leave.inputs["Depth"])
    if "Source" in fitted:  # numbers, whatever scaling made of them
        whole = compat.new_math_node(group, "ROUND")
        group.links.new(fitted["Source"], whole.inputs[0])
        fitted["Source"] = whole.outputs[0]
    for layer in contract.FRAME_LAYERS:
        if layer.output and layer.name in fitted and layer.name not in ("Combined", "Depth"):
            group.links.new(fitted[layer.name], leave.inputs[layer.output])
    for name in old - shown:
        stale = bpy.data.images.get(name)
        if stale is not None and stale.users == 0:
            bpy.data.images.remove(stale)


def _warped(group: Any, enter: Any, own: Any, image: Any, take: Take) -> Any:
    """Socket of the frozen picture: the take's own, or what is led into the group, frozen by the take's warp."""
    reader = group.nodes.new("CompositorNodeImage")
    reader.name = reader.label = "Warp"
    reader.location = (-3 * _GAP, -1500.0)
    show_sequence(reader, image, take.first, take.last)
    frozen = warp_nodes.frozen(group, enter.outputs["Image"], reader.outputs, take.plate_size)
    node, factor, first, second, mixed = compat.new_mix_node(group)
    node.label, node.location = warp_nodes.FACTOR, (-2 * _GAP, 330.0)
    group.links.new(enter.outputs[warp_nodes.FACTOR], factor)
    group.links.new(own, first)
    group.links.new(frozen, second)
    return mixed


_TINT, _TINTED = (1.0, 0.0, 0.4, 1.0), 0.6
"""Colour that shows what is invented, and how much of it there is where nothing is plate."""


def _looked_at(group: Any, enter: Any, layers: dict[str, Any]) -> Any:
    """Socket of the frozen picture, or of the splats alone, with what is invented tinted as much as is asked for."""
    node, factor, first, second, chosen = compat.new_mix_node(group)
    node.label, node.location = "Splat", (-2 * _GAP, 500.0)
    group.links.new(enter.outputs["Splat"], factor)
    group.links.new(layers["Combined"], first)
    group.links.new(layers["Splat"], second)
    # tinted * (1 - plate), by as much as is asked for
    invented = compat.new_math_node(group, "MULTIPLY_ADD")
    invented.inputs[1].default_value, invented.inputs[2].default_value = -_TINTED, _TINTED
    group.links.new(layers["Plate"], invented.inputs[0])
    amount = _product(group, enter.outputs[_INVENTED], invented.outputs[0])
    tint, factor, first, second, tinted = compat.new_mix_node(group)
    tint.label, second.default_value = _INVENTED, _TINT
    group.links.new(amount, factor)
    group.links.new(chosen, first)
    invented.location, tint.location = (-2 * _GAP, 670.0), (-_GAP, 500.0)
    return tinted


def _grainy(group: Any, enter: Any, layers: dict[str, Any]) -> Any:
    """Socket of the frozen picture with as much of its grain as is asked for; takes of before have none."""
    if _GRAIN not in layers:
        return layers["Combined"]
    node, factor, first, second, summed = compat.new_mix_node(group, "ADD")
    node.name = node.label = _GRAIN
    node.location = (0.0, -900.0)
    group.links.new(enter.outputs[_GRAIN], factor)
    group.links.new(layers["Combined"], first)
    group.links.new(layers[_GRAIN], second)
    return summed


def _among(group: Any, enter: Any, picture: Any, nearer: Any, label: str) -> Any:
    """Socket of a picture with CG in front of it, as far as it is nearer, else behind, by as much as both cover."""
    front, under, over = compat.new_over_node(group)
    group.links.new(picture, under)
    group.links.new(enter.outputs["CG"], over)
    back, below, above = compat.new_over_node(group)
    group.links.new(enter.outputs["CG"], below)
    group.links.new(picture, above)
    choose, factor, first, second, chosen = compat.new_mix_node(group)
    choose.label = label
    group.links.new(nearer, factor)
    group.links.new(back.outputs[0], first)
    group.links.new(front.outputs[0], second)
    for row, node in enumerate((front, back)):
        node.location = (_GAP, -350.0 - 170.0 * row)
    choose.location = (2 * _GAP, -350.0)
    return chosen


def _cg_depth(group: Any, enter: Any) -> Any:
    """Socket of the depth of CG; where a pixel has none, the nearest of its neighbours': it may be that one's edge.

    A pixel that CG covers in part often tells the depth of what is behind: nothing.
    """
    around = compat.new_nearest_node(group)
    group.links.new(enter.outputs["CG Depth"], around.inputs[0])
    # Where there is a depth, the other is made so large that the lesser of the two is the pixel's own.
    there = compat.new_math_node(group, "LESS_THAN")
    there.inputs[1].default_value = _NOTHING
    group.links.new(enter.outputs["CG Depth"], there.inputs[0])
    far = compat.new_math_node(group, "MULTIPLY_ADD")
    far.inputs[1].default_value = contract.NO_DEPTH
    group.links.new(there.outputs[0], far.inputs[0])
    group.links.new(around.outputs[0], far.inputs[2])
    depth = compat.new_math_node(group, "MINIMUM")
    depth.label = "Depth of CG, edges too"
    group.links.new(enter.outputs["CG Depth"], depth.inputs[0])
    group.links.new(far.outputs[0], depth.inputs[1])
    for column, node in enumerate((around, there, far, depth)):
        node.location = (_GAP * (column - 3), -1100.0)
    return depth.outputs[0]


def _nearer(group: Any, cg: Any, frozen: Any) -> Any:
    """Socket of how much CG is in front: 1 up to the frozen depth, 0 from `_SOFT` of it behind, smooth between."""
    ratio = compat.new_math_node(group, "DIVIDE")
    group.links.new(cg, ratio.inputs[0])
    group.links.new(frozen, ratio.inputs[1])
    rise = compat.new_math_node(group, "MULTIPLY_ADD")
    rise.inputs[1].default_value, rise.inputs[2].default_value = -1.0 / _SOFT, 1.0 + 1.0 / _SOFT
    rise.use_clamp = True
    group.links.new(ratio.outputs[0], rise.inputs[0])
    # t * t * (3 - 2 * t)
    square, slope, smooth = (compat.new_math_node(group, o) for o in ("MULTIPLY", "MULTIPLY_ADD", "MULTIPLY"))
    slope.inputs[1].default_value, slope.inputs[2].default_value = -2.0, 3.0
    smooth.label = "CG is nearer"
    for source, target in (
        (rise, square.inputs[0]), (rise, square.inputs[1]), (rise, slope.inputs[0]),
        (square, smooth.inputs[0]), (slope, smooth.inputs[1]),
    ):  # fmt: skip
        group.links.new(source.outputs[0], target)
    for column, node in enumerate((ratio, rise, square, slope, smooth)):
        node.location = (_GAP * (column - 3), -1300.0)
    return smooth.outputs[0]


def _share(group: Any, enter: Any, layers: dict[str, Any]) -> Any:
    """Socket of how much of the frozen frame shows: Mix, left of Wipe, and where the mattes let it."""
    left = compat.new_math_node(group, "LESS_THAN")
    left.label = "Left of the wipe"
    group.links.new(_across(group), left.inputs[0])
    group.links.new(enter.outputs["Wipe"], left.inputs[1])
    total = _product(group, enter.outputs["Mix"], left.outputs[0])
    for row, (name, layer) in enumerate((("Only Supported", "Support"), ("Only Moving", "Motion"))):
        # 1 - amount * (1 - matte)
        lacking = compat.new_math_node(group, "SUBTRACT")
        lacking.inputs[0].default_value = 1.0
        group.links.new(layers[layer], lacking.inputs[1])
        taken = _product(group, enter.outputs[name], lacking.outputs[0])
        kept = compat.new_math_node(group, "SUBTRACT")
        kept.inputs[0].default_value = 1.0
        group.links.new(taken, kept.inputs[1])
        total = _product(group, total, kept.outputs[0])
        lacking.location, kept.location = (-2 * _GAP, 500.0 + 170.0 * row), (-_GAP, 500.0 + 170.0 * row)
    left.location = (-_GAP, 330.0)
    return total


def _across(group: Any) -> Any:
    """Socket of a value that rises from 0 at the frame's left to 1 at its right."""
    if compat.HAS_TEXTURE_NODE:
        node = group.nodes.new("CompositorNodeTexture")
        node.texture = _blend()
        node.label = "From left to right"
        node.location = (-2 * _GAP, 330.0)
        return node.outputs["Value"]
    ramp = group.nodes.new("CompositorNodeImage")
    ramp.image = _ramp()
    ramp.label = "From left to right"
    wide = compat.new_fit_node(group, "Stretch")
    group.links.new(ramp.outputs["Image"], wide.inputs[0])
    # A scaled picture fades out over its last pixels: those of the ramp lie outside of the frame.
    larger = group.nodes.new("CompositorNodeScale")
    larger.inputs["X"].default_value = larger.inputs["Y"].default_value = _BEYOND
    group.links.new(wide.outputs[0], larger.inputs[0])
    ramp.location, wide.location = (-3 * _GAP, 330.0), (-2 * _GAP, 330.0)
    return larger.outputs[0]


def _product(group: Any, one: Any, other: Any) -> Any:
    node = compat.new_math_node(group)
    node.location = (0.0, 330.0)
    group.links.new(one, node.inputs[0])
    group.links.new(other, node.inputs[1])
    return node.outputs[0]


_RAMP = "Splannequin Ramp"
_STEPS, _ROWS = 1024, 32
_BEYOND = 1.1
"""How much larger than the frame the ramp is shown."""


def _blend() -> Any:
    """A texture that rises from left to right. A scaled picture would do, but 4.3 leaves its lowest row unset."""
    texture = next((t for t in bpy.data.textures if t.get(_TAG) and t.type == "BLEND"), None)
    if texture is None:
        texture = bpy.data.textures.new(_RAMP, "BLEND")
        texture[_TAG] = True
    return texture


def _ramp() -> Any:
    """A picture that rises from 0 at the frame's left to 1 at its right: 5.0 has no node that does."""
    image = next((i for i in bpy.data.images if i.get(_TAG) and i.name.startswith(_RAMP)), None)
    if image is not None:
        return image
    image = bpy.data.images.new(_RAMP, _STEPS, _ROWS, alpha=False, float_buffer=True, is_data=True)
    image[_TAG] = True
    across = 0.5 + _BEYOND * ((np.arange(_STEPS, dtype=np.float32) + 0.5) / _STEPS - 0.5)
    row = np.repeat(across[:, None], 4, axis=1)
    row[:, 3] = 1.0
    image.pixels.foreach_set(np.tile(row, (_ROWS, 1)).ravel())
    image.update()
    image.pack()
    return image


def show_sequence(user: Any, image: Any, first: int, last: int) -> None:
    """Makes an Image node (or an image user) show file n at scene frame n."""
    if hasattr(user, "image"):
        user.image = image
    user.frame_duration = last - first + 1
    user.frame_start = first
    user.frame_offset = first - 1
    user.use_auto_refresh = True


def _fitted(scene: Any, group: Any, take: Take, layers: dict[str, Any]) -> dict[str, Any]:
    """The layers' sockets, by name: without overscan, and scaled to the render's size, whatever it is when it renders.

    Frames wider than the scene's picture are cut, as the camera sees it; flatter ones leave bars.
    """
    names, sockets = tuple(layers), dict(layers)
    for row, name in enumerate(names if any(take.margin) else ()):
        node = compat.new_crop_node(group, take.margin, take.size)
        node.label = f"{name} without overscan"
        node.location = (-2 * _GAP, -50.0 - 170.0 * row)
        group.links.new(sockets[name], node.inputs[0])
        sockets[name] = node.outputs[0]
    how, shown = _how(scene, take.size), _whole(group, sockets["Depth"])
    coverage = None
    for row, name in enumerate(("", *names) if shown is not None else names):
        node = compat.new_fit_node(group, how)
        node.label = f"Fit {name}" if name else "Fit what there is"
        node.location = (-_GAP, 150.0 - 170.0 * row)
        group.links.new(sockets[name] if name else shown, node.inputs[0])
        if not name:
            coverage = node.outputs[0]
        else:
            sockets[name] = _unfaded(group, node.outputs[0], coverage, name in ("Combined", _GRAIN))
    return sockets


def _how(scene: Any, size: tuple[int, int]) -> str:
    """How a picture of a size is brought to the scene's: its width fits, as the solved camera's does."""
    tall = scene.render.resolution_x * size[1] / (scene.render.resolution_y * size[0])
    # Of one shape but for rounding: both do; where cropping leaves a line unset, not that.
    alike = abs(tall - 1.0) < 0.01 and not compat.CROPS_WHOLE
    return "Crop" if tall > 0.99 and not alike else "Fit"


def _whole(group: Any, layer: Any) -> Any | None:
    """Socket of 1 wherever a layer has pixels; None where a scaled picture does not fade out at its border."""
    if compat.HAS_COMPOSITING_GROUP:
        return None
    node = compat.new_math_node(group, "GREATER_THAN")
    node.inputs[1].default_value = -1.0
    node.label = "Everywhere"
    group.links.new(layer, node.inputs[0])
    return node.outputs[0]


def _unfaded(group: Any, layer: Any, coverage: Any | None, picture: bool) -> Any:
    """Socket of a scaled layer whose outermost pixels are as strong as the others."""
    if coverage is None:
        return layer
    if picture:
        return compat.new_quotient(group, layer, coverage)
    node = compat.new_math_node(group, "DIVIDE")
    group.links.new(layer, node.inputs[0])
    group.links.new(coverage, node.inputs[1])
    return node.outputs[0]


def render_size(scene: Any) -> tuple[int, int]:
    """Pixels that a render of the scene has."""
    render = scene.render
    share = render.resolution_percentage
    return render.resolution_x * share // 100, render.resolution_y * share // 100


def _show_plate(scene: Any, tree: Any, node: Any, image: Any, take: Take) -> None:
    """The undistorted plate as the minimal tree's own stream, so that Mix fades between plate and freeze."""
    for old in [n for n in tree.nodes if n.get(_TAG) and n.get(_TAG) != _CG]:
        tree.nodes.remove(old)
    image_node = tree.nodes.new("CompositorNodeImage")
    image_node[_TAG] = True
    image_node.name = image_node.label = "Plate"
    show_sequence(image_node, image, take.first, take.last)
    stream = image_node.outputs["Image"]
    # The tree is ours: in a row, left to right.
    compat.output_socket(tree).node.location = (node.location.x + node.width + 60.0, node.location.y)
    image_node.location = (node.location.x - 2 * _GAP, node.location.y)
    fit = compat.new_fit_node(tree, _how(scene, tuple(image.size)))
    fit[_TAG] = True
    fit.label = "Fit Plate"
    fit.location = (node.location.x - _GAP, node.location.y)
    tree.links.new(stream, fit.inputs[0])
    tree.links.new(fit.outputs[0], node.inputs["Image"])
