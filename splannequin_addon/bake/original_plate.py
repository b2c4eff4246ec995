"""The original footage as the minimal tree's plate: the video or sequence as filmed, at its size and bit depth.

The take's ST map removes the lens distortion. Where Blender would read the files differently from the freeze, the
working frames replace the footage, and a sentence gives the reason.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from .. import compat
from ..access import present, size_of
from ..scene import sequences
from ..scene.ownership import TAG
from . import warp_nodes, working_light
from .node_names import GAP
from .take_files import Take

LENS = "Splannequin Undistort"
"""Name of the group that removes the lens distortion."""
LIGHT = "Splannequin Working Light"
"""Name of the group that restores the highlights of working frames."""
_LENS_TAG = "splannequin_lens"
# Name of the node that shows the ST map, in the group `LENS`.
_MAP = "ST Map"


@dataclass(frozen=True)
class Footage:
    """Facts stored in a take about the footage that it was frozen from."""

    file: Path
    """The video, or one image of the sequence."""
    size: tuple[int, int]
    """Width and height of its images in pixels."""
    probe: tuple[float, ...]
    """Linear Rec.709 light that the file value `contract.PROBE` encodes."""
    space: str
    """Name of the footage's colour space."""
    map: Path | None
    """ST map that removes the footage's lens distortion; None without distortion."""
    shift: int = 0
    """Frame number in the shot minus frame number in the footage."""


@dataclass
class Plate:
    """The plate of a take as data-blocks."""

    image: bpy.types.Image
    """Video or image sequence."""
    map: bpy.types.Image | None
    """ST map that undistorts the image, or None."""
    remarks: list[str]
    """Sentences that describe the plate."""
    size: tuple[int, int]
    """Width and height of the plate in pixels."""
    shift: int = 0
    """Frame number in the shot minus frame number of the image's files."""
    has_shoulder: bool = False
    """True if the image is read as sRGB and has a shoulder, see `working_light`."""


def footage_of(take: Take, shot: Path) -> tuple[Footage | None, str]:
    """(the footage that a take was frozen from, ""), or (None, the reason why it cannot be shown).

    The reason is empty if the take does not record its footage.
    """
    try:
        footage: dict[str, Any] = dict(contract.read_json(contract.TakeFolder(take.folder).facts).get("footage") or {})
        if not footage:
            return None, ""
        name = Path(str(footage["file"])).name
        if footage["unlike"]:
            return None, f"{name}: {footage['unlike']}"
        if footage.get("orientation", 1) != 1 and not compat.TURNS_VIDEOS:
            return None, f"{name}: its header rotates the image"
        places = [Path(str(footage["file"])), *([shot / str(footage["beside"])] if footage["beside"] else [])]
        file = next((place for place in places if place.is_file()), None)
        if file is None:
            return None, f"{name} no longer exists"
        st = take.folder / str(footage["map"]) if footage["map"] else None
        if st is not None and not st.is_file():
            return None, "the take's ST map no longer exists"
        width, height = (int(side) for side in footage["size"])
        probe = tuple(float(value) for value in footage["probe"])
        return Footage(file, (width, height), probe, str(footage["space"]), st, int(footage.get("shift") or 0)), ""
    except (OSError, ValueError, TypeError, KeyError, contract.JobError):
        return None, ""  # the facts are damaged or of an earlier version


def plate_of(take: Take, shot: Path, stand_in: Path) -> Plate:
    """The plate that the tree shows: the footage, else the working frames. Raises ValueError if neither can be
    shown."""
    footage, why = footage_of(take, shot)
    image = None
    if footage is not None:
        image, why = _image(footage, (take.first, take.last))
    if footage is None or image is None:
        remarks = [f"The compositor shows working frames as the plate, not the footage: {why}."] if why else []
        image = sequences.load_sequence(stand_in, working_name(stand_in), "srgb")
        size = sequences.shown_size(image, take.first, take.last)
        return Plate(image, None, remarks, size, has_shoulder=working_light.has_shoulder(contract.ShotFolder(shot)))
    st = None
    if footage.map is not None:
        st = sequences.load_numbers(footage.map, _map_name(take))
    width, height = footage.size
    without = ", undistorted by the take's ST map" if st is not None else ""
    remarks = [f"The footage {footage.file.name} is used as the plate, {width} x {height}{without}."]
    return Plate(image, st, remarks, footage.size, footage.shift)


def prefetch(take: Take, shot: Path, stand_in: Path) -> Iterator[None]:
    """Loads the images that `plate_of` will need, one per iteration."""
    footage, _ = footage_of(take, shot)
    if footage is None or not compat.knows_colour(footage.probe):
        sequences.read(stand_in, working_name(stand_in), "srgb", take.first, take.last)
        yield
        return
    sequences.read(footage.file, _name(footage), footage.probe, take.first, take.last, True, footage.shift)
    yield
    if footage.map is not None:
        sequences.read_numbers(footage.map, _map_name(take))
        yield


def working_name(plate: Path) -> str:
    """Name of the image data-block of a shot's working frames."""
    return f"Plate {plate.parent.parent.stem}"


def _name(footage: Footage) -> str:
    return f"Plate {footage.file.stem}"


def _map_name(take: Take) -> str:
    return f"Undistort {take.folder.name}"


def _image(footage: Footage, frames: tuple[int, int]) -> tuple[bpy.types.Image | None, str]:
    """(the footage as an image, ""), or (None, the reason why Blender does not show it as filmed)."""
    try:
        image = sequences.load_sequence(footage.file, _name(footage), footage.probe, opaque=True)
    except ValueError:
        return None, f"Blender's colour configuration has no colour space that matches {footage.space}"
    except RuntimeError:
        return None, f"Blender cannot read {footage.file.name}"
    size = sequences.shown_size(image, *frames, footage.shift)
    if size == footage.size:
        return image, ""
    is_layered = image.type == "MULTILAYER"
    if image.users == 0:
        bpy.data.images.remove(image)
    if not any(size) and not is_layered:
        return None, f"Blender cannot read {footage.file.name}"
    shown = f"at {size[0]} x {size[1]}" if any(size) else "as several layers"
    return None, f"Blender reads {footage.file.name} {shown}"


def between(plate: Plate) -> str:
    """Name of the group needed between a plate's image and its Scale node: LENS, LIGHT or empty."""
    return LENS if plate.map is not None else LIGHT if plate.has_shoulder else ""


def kind(node: bpy.types.Node) -> str:
    """LENS or LIGHT for a group node that `through` made, else empty."""
    group = node.node_tree if isinstance(node, bpy.types.CompositorNodeGroup) else None
    if group is None or not group.get(_LENS_TAG):
        return ""
    return LENS if _MAP in group.nodes else LIGHT


def through(
    tree: bpy.types.NodeTree, picture: bpy.types.NodeSocket, plate: Plate, location: tuple[float, float]
) -> bpy.types.NodeSocket:
    """Socket of a plate's image after a new group node of ours, which removes the lens distortion or restores
    highlights.

    Returns `picture` itself if the plate needs neither.
    """
    wanted = between(plate)
    if not wanted:
        return picture
    group = bpy.data.node_groups.new(wanted, "CompositorNodeTree")
    group[_LENS_TAG] = True
    compat.new_socket(group, "Image", "INPUT", "NodeSocketColor")
    compat.new_socket(group, "Image", "OUTPUT", "NodeSocketColor")
    _fill(group, plate)
    node: Any = tree.nodes.new("CompositorNodeGroup")
    node.node_tree = group
    node[TAG] = True
    node.name = node.label = "Undistort Plate" if wanted == LENS else "Light of Plate"
    node.location = location
    tree.links.new(picture, node.inputs[0])
    return node.outputs[0]


def refill(node: bpy.types.Node, plate: Plate) -> None:
    """Rebuilds the inside of a group node of ours for another plate of the same kind. The links to the node stay."""
    assert isinstance(node, bpy.types.CompositorNodeGroup)
    group = present(node.node_tree)
    group.nodes.clear()
    _fill(group, plate)


def _fill(group: bpy.types.NodeTree, plate: Plate) -> None:
    """Builds the inside of a group, from its input image to its output image."""
    enter, leave = group.nodes.new("NodeGroupInput"), group.nodes.new("NodeGroupOutput")
    enter.location, leave.location = (-3 * GAP, 0.0), (4 * GAP, 0.0)
    if plate.map is not None:
        reader: Any = group.nodes.new("CompositorNodeImage")
        reader.image = plate.map
        reader.name = reader.label = _MAP
        shown = warp_nodes.looked_up(group, enter.outputs[0], reader.outputs["Image"], size_of(plate.map))
        reader.location = (-3 * GAP, -300.0)
    else:
        shown = working_light.lit(group, enter.outputs[0])
    group.links.new(shown, leave.inputs[0])


def images_of(node: bpy.types.Node) -> list[bpy.types.Image]:
    """The images that a node of ours shows, directly or inside its group."""
    group = node.node_tree if isinstance(node, bpy.types.CompositorNodeGroup) else None
    nodes = group.nodes if group is not None and group.get(_LENS_TAG) else [node]
    return [n.image for n in nodes if isinstance(n, bpy.types.CompositorNodeImage) and n.image]


def drop(node: bpy.types.Node) -> list[bpy.types.Image]:
    """Removes a node of ours from its tree, and its group if unused. Returns the images that the node showed."""
    images = images_of(node)
    group = node.node_tree if isinstance(node, bpy.types.CompositorNodeGroup) else None
    present(node.id_data).nodes.remove(node)  # pyright: ignore
    if group is not None and group.get(_LENS_TAG) and group.users == 0:
        bpy.data.node_groups.remove(group)
    return images
