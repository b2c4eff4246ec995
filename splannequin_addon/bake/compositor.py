"""The node group "Splannequin Freeze" in the scene's compositor: inserted, updated, removed.

It stands in for the plate where a node of the artist's tree shows it, so that the grade goes on from there; else before
the output. Nothing else in the tree is touched: the links that leave the plate, or the one into the output, are led
through the group, and led back when the group is removed. The group reads the take's multilayer EXR files; scene frame
n shows n.exr. Where the take was frozen with detail the group can tell plate from splats, and freeze the stream that is
led into it by the take's warp, see `warp_nodes`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from .. import compat
from ..access import present
from ..scene import numbered, sequences
from ..scene.ownership import TAG
from . import fitting, freeze_group, group_inside, original_plate, placing, warp_nodes
from .node_names import GAP, GROUP_NAME
from .take_files import Take

_CG = "cg"
_LAYERS = tuple(layer.name for layer in contract.layers_of(""))
"""Of every frozen frame; what else is in the table is in some."""


def insert(
    scene: bpy.types.Scene,
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
    behind = placing.place_of(scene, footage, where)
    wanted = freeze_group.wants_warp(scene) if warp is None else warp
    frozen, flow, stream = _frozen_image(take), _warp_image(take) if wanted else None, None
    if plate is not None and freeze_group.shows_plate(scene):
        stream = original_plate.plate_of(take, _shot_of(take), plate)
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
    node = freeze_group.group_node(tree)
    if node is None:
        node = freeze_group.new_node(tree, before)
        placing.lead_through(tree, node, behind)
        place = "as the plate: what follows it goes on from there" if behind is not None else "before the output"
        changes.append(f'The node group "{GROUP_NAME}" was inserted {place}.')
    else:
        if where != "AUTO" and placing.stands_in(node) != (behind is not None):
            placing.lead_past(tree, node)
            placing.lead_through(tree, node, behind)
            changes.append(f'The node group "{GROUP_NAME}" was moved.')
        freeze_group.set_defaults(node, freeze_group.give_sockets(present(node.node_tree)))
        changes.append(f'The node group "{GROUP_NAME}" was updated.')
    changes += freeze_group.switch_warp(node, wanted, flow is not None)
    group_inside.fill(scene, node, take, frozen, flow)
    changes += freeze_group.lacking(node)
    if stream is not None:
        _show_plate(scene, tree, node, stream, take)
        changes += stream.said
    return changes


def _shot_of(take: Take) -> Path:
    return take.folder.parent.parent


def _frozen_image(take: Take) -> bpy.types.Image:
    """The take's frames as a data-block. ValueError if they lack a layer."""
    image = sequences.load_sequence(
        numbered.frame_path(take.folder, take.first), f"Frozen {take.folder.name}", take.light
    )
    return _with_layers(image, take, _LAYERS)


def _warp_image(take: Take) -> bpy.types.Image | None:
    """The take's warp as a data-block, None if it has none. ValueError if it lacks a layer."""
    return (
        _with_layers(sequences.load_sequence(*_warp_picture(take)), take, warp_nodes.LAYERS)
        if any(take.plate_size)
        else None
    )


def _with_layers(image: bpy.types.Image, take: Take, names: Sequence[str]) -> bpy.types.Image:
    """A sequence of the take, once it is known to have some layers. ValueError if not."""
    group = bpy.data.node_groups.new(GROUP_NAME, "CompositorNodeTree")
    try:
        node = group.nodes.new("CompositorNodeImage")
        sequences.show_sequence(node, image, take.first, take.last)
        missing = [n for n in names if n not in node.outputs]
    finally:
        bpy.data.node_groups.remove(group)
    if missing:
        raise ValueError(f"the frames in {take.folder} have no layer {missing[0]!r}: freeze the take again")
    return image


def may_combine_cg(scene: bpy.types.Scene) -> bpy.types.CompositorNodeGroup:
    """Our node, if the scene's render can be led into it. JobError if it is not there, or its CG is taken."""
    tree = compat.compositor_tree(scene)
    node = freeze_group.group_node(tree) if tree else None
    if node is None:
        raise contract.JobError("The freeze is not in this compositor.", "Bake first.", contract.ExitCode.BAKE)
    if node.inputs["CG"].is_linked:
        raise contract.JobError(
            f'Something is led into "CG" of {GROUP_NAME} already.',
            "Unlink it to have it done here.",
            contract.ExitCode.BAKE,
        )
    return node


def combine_cg(scene: bpy.types.Scene) -> list[str]:
    """Leads the scene's own render into the group, where it stands among the frozen by depth; says what was changed.

    The view layer must have its depth pass. JobError as `may_combine_cg`.
    """
    node, tree = may_combine_cg(scene), present(compat.compositor_tree(scene))
    layers: Any = tree.nodes.new("CompositorNodeRLayers")
    layers[TAG] = _CG
    layers.scene = scene
    layers.name = layers.label = "CG among the frozen"
    layers.location = (node.location.x - 2 * GAP, node.location.y - 300.0)
    tree.links.new(layers.outputs["Image"], node.inputs["CG"])
    tree.links.new(layers.outputs["Depth"], node.inputs["CG Depth"])
    return ["The scene's own render was led into the freeze: objects stand among the frozen people by depth."]


def remove(scene: bpy.types.Scene) -> bool:
    """Takes the group out, leads the link back, deletes what only we used. True if there was one."""
    tree = compat.compositor_tree(scene)
    node = freeze_group.group_node(tree) if tree else None
    if tree is None or node is None:
        return False
    group = present(node.node_tree)
    before = json.loads(group.get(freeze_group.BEFORE, "{}"))
    placing.lead_past(tree, node)
    images = [n.image for n in group.nodes if isinstance(n, bpy.types.CompositorNodeImage) and n.image]
    textures = [t for n in group.nodes if n.bl_idname == "CompositorNodeTexture" and (t := getattr(n, "texture", None))]
    tree.nodes.remove(node)
    if group.users == 0:  # another scene may show it
        bpy.data.node_groups.remove(group)
    for ours in [n for n in tree.nodes if n.get(TAG)]:
        images += original_plate.drop(ours)
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


def read_ahead(take: Take, plate: Path | None = None, warp: bool = False) -> Iterator[None]:
    """Has Blender read what `insert` needs, one picture a turn: it does so while its window stands still."""
    wanted: list[tuple[Path, str, sequences.Encoding]] = [
        (numbered.frame_path(take.folder, take.first), f"Frozen {take.folder.name}", take.light)
    ]
    if warp and any(take.plate_size):
        wanted.append(_warp_picture(take))
    for path, name, encoding in wanted:
        sequences.read(path, name, encoding, take.first, take.last)
        yield
    if plate is not None:
        yield from original_plate.read_ahead(take, _shot_of(take), plate)


def _warp_picture(take: Take) -> tuple[Path, str, sequences.Encoding]:
    """File, name and encoding of a take's warp."""
    warps = contract.TakeFolder(take.folder).warps
    return numbered.frame_path(warps, take.first), f"Warp {take.folder.name}", take.light


_OUTPUTS = ("CompositorNodeComposite", "NodeGroupOutput", "NodeGroupInput")


def _show_plate(
    scene: bpy.types.Scene,
    tree: bpy.types.NodeTree,
    node: bpy.types.CompositorNodeGroup,
    plate: original_plate.Plate,
    take: Take,
) -> None:
    """The undistorted plate as the minimal tree's own stream, so that Mix fades between plate and freeze."""
    shown = [plate.image, plate.map]
    for old in [n for n in tree.nodes if n.get(TAG) and n.get(TAG) != _CG]:
        for image in original_plate.drop(old):
            if image.users == 0 and image not in shown:
                bpy.data.images.remove(image)
    image_node = tree.nodes.new("CompositorNodeImage")
    image_node[TAG] = True
    image_node.name = image_node.label = "Plate"
    sequences.show_sequence(image_node, plate.image, take.first, take.last)
    stream = image_node.outputs["Image"]
    # The tree is ours: in a row, left to right.
    end = present(present(compat.output_socket(tree)).node)
    end.location = (node.location.x + node.width + 60.0, node.location.y)
    between = plate.map is not None or plate.has_shoulder
    image_node.location = (node.location.x - (3 if between else 2) * GAP, node.location.y)
    if plate.map is not None:
        stream = original_plate.undistorted(tree, stream, plate.map, (node.location.x - 2 * GAP, node.location.y))
    if plate.has_shoulder:
        stream = original_plate.lit(tree, stream, (node.location.x - 2 * GAP, node.location.y))
    fit = compat.new_fit_node(tree, fitting.how_it_fits(scene, plate.size))
    fit[TAG] = True
    fit.label = "Fit Plate"
    fit.location = (node.location.x - GAP, node.location.y)
    tree.links.new(stream, fit.inputs[0])
    tree.links.new(fit.outputs[0], node.inputs["Image"])
