"""The node group "Splannequin Freeze" in the scene's compositor: inserts, updates and removes it.

The group replaces the plate behind the node that shows the plate, so that the artist's grade applies to the freeze.
Without such a node, the group goes before the output. Only the links from the plate, or the link to the output, are
rerouted through the group. Removing the group restores them. The group reads the take's multilayer EXR files; scene
frame n shows n.exr. For a take that was frozen with detail, the group can also separate plate pixels from splats. It
can also freeze its input stream by the take's warp, see `warp_nodes`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from .. import compat
from ..access import library_of, present
from ..scene import numbered, sequences
from ..scene.ownership import TAG
from . import fitting, freeze_group, group_inside, original_plate, placing, warp_nodes
from .node_names import GAP, GROUP_NAME
from .take_files import Take

# Tag value of our Render Layers node, which is not part of the plate's stream.
_CG = "cg"
# Property of the plate's Scale node: the fit that we set last. A fit set by the artist stays until the plate or the
# scene changes shape.
_FIT_MODE = "splannequin_how"
# Layers of every frozen frame. Other layers of the table exist only in some takes.
_LAYERS = tuple(layer.name for layer in contract.layers_of(""))


def insert(
    scene: bpy.types.Scene,
    take: Take,
    plate: Path | None = None,
    footage: Sequence[Path] = (),
    where: str = "AUTO",
    warp: bool | None = None,
) -> list[str]:
    """Puts the freeze group into the scene's compositor, or updates the existing group.

    Args:
        scene: the scene. A minimal tree (plate, group, output) is created if it has none.
        take: the frozen frames.
        plate: first file of the undistorted plate, for the minimal tree.
        footage: files of the plate and of the clip, by which a node that shows the plate is recognised.
        where: "PLATE": behind the node that shows the plate. "OUTPUT": before the output. "AUTO": behind the plate if a
            node shows it, else before the output; an existing group stays in place.
        warp: True: the group freezes its input stream by the take's warp. False: the group shows the take's frames.
            None: unchanged.

    Returns:
        One sentence for each change.

    Raises:
        contract.JobError: `where` is "PLATE" and no node shows the plate, or the compositor is linked from another
            file.
        ValueError: the frames lack a layer, or Blender cannot show them or the plate. The tree is unchanged.
    """
    changes: list[str] = []
    _require_local(compat.compositor_tree(scene))
    behind = placing.place_of(scene, footage, where)
    wanted = freeze_group.wants_warp(scene) if warp is None else warp
    frozen, flow, stream = _frozen_image(take), _warp_image(take) if wanted else None, None
    if plate is not None and freeze_group.shows_plate(scene):
        stream = original_plate.plate_of(take, _shot_of(take), plate)
    if compat.compositor_tree(scene) is not None:  # all checks have passed
        freeze_group.single_user_tree(scene)
        behind = placing.place_of(scene, footage, where)
    enabled = compat.compositor_enabled(scene)
    before = {**compat.compositor_switches(scene), "made_tree": False}
    tree = compat.compositor_tree(scene)
    if tree is None or not len(tree.nodes):
        tree = compat.new_compositor_tree(scene, "Splannequin Compositing")
        before["made_tree"] = True
        changes.append("The scene had no compositor node tree, so a minimal one was created.")
    if not enabled:
        compat.enable_compositor(scene)
        if not before["made_tree"]:
            changes.append("The compositor was switched on.")
    node, done = _placed(tree, before, behind, where)
    changes += done
    changes += freeze_group.switch_warp(node, wanted, flow is not None)
    changes += freeze_group.update_passes(node, _layers_of(frozen, take))
    group_inside.fill(scene, node, take, frozen, flow)
    changes += freeze_group.missing_layers(node)
    if stream is not None:
        changes += stream.remarks if _show_plate(scene, tree, node, stream, take) else []
    return changes


def _placed(
    tree: bpy.types.NodeTree, before: dict[str, bool], behind: bpy.types.NodeSocket | None, where: str
) -> tuple[bpy.types.CompositorNodeGroup, list[str]]:
    """(the group's node, a sentence for each change). The node is new, or the existing one.

    `behind` is the socket to insert the node behind, or None to insert it before the output.
    """
    node = freeze_group.group_node(tree)
    if node is None:
        node = freeze_group.new_node(tree, before)
        placing.route_through(tree, node, behind)
        place = "in place of the plate" if behind is not None else "before the output"
        return node, [f'The node group "{GROUP_NAME}" was inserted {place}.']
    changes: list[str] = []
    if where != "AUTO" and placing.is_behind_plate(node) != (behind is not None):
        placing.bypass(tree, node)
        placing.route_through(tree, node, behind)
        changes.append(f'The node group "{GROUP_NAME}" was moved.')
    freeze_group.set_defaults(node, freeze_group.add_sockets(present(node.node_tree)))
    return node, [*changes, f'The node group "{GROUP_NAME}" was updated.']


def _require_local(tree: bpy.types.NodeTree | None) -> None:
    """Raises JobError if the compositor is linked from another file."""
    library = library_of(tree) if tree is not None else None
    if library is not None:  # changes would be lost when this file is reopened
        raise contract.JobError(
            f"This compositor is linked from {Path(bpy.path.abspath(library.filepath)).name}.",
            "Make it local first.",
            contract.ExitCode.BAKE,
        )


def _shot_of(take: Take) -> Path:
    return take.folder.parent.parent


def _frozen_image(take: Take) -> bpy.types.Image:
    """The take's frames as an image data-block. Raises ValueError if a layer is missing."""
    image = sequences.load_sequence(
        numbered.frame_path(take.folder, take.first), f"Frozen {take.folder.name}", take.light
    )
    return _with_layers(image, take, _LAYERS)


def _warp_image(take: Take) -> bpy.types.Image | None:
    """The take's warp as an image data-block, or None without a warp. Raises ValueError if a layer is missing."""
    return (
        _with_layers(sequences.load_sequence(*_warp_picture(take)), take, warp_nodes.LAYERS)
        if any(take.plate_size)
        else None
    )


def _with_layers(image: bpy.types.Image, take: Take, names: Sequence[str]) -> bpy.types.Image:
    """The image sequence of a take, after a check that it has the named layers. Raises ValueError if one is missing."""
    layers = _layers_of(image, take)
    missing = [n for n in names if n not in layers]
    if missing:
        raise contract.UserError(f"The frames in {take.folder} have no layer {missing[0]!r}. Freeze the take again.")
    return image


def _layers_of(image: bpy.types.Image, take: Take) -> set[str]:
    """Names of the layers that an Image node shows of one of the take's image sequences."""
    group = bpy.data.node_groups.new(GROUP_NAME, "CompositorNodeTree")
    try:
        node = group.nodes.new("CompositorNodeImage")
        sequences.show_sequence(node, image, take.first, take.last)
        return set(present(node.outputs).keys())
    finally:
        bpy.data.node_groups.remove(group)


def may_combine_cg(scene: bpy.types.Scene) -> bpy.types.CompositorNodeGroup:
    """The freeze group's node, if the scene's render can be linked to it.

    Raises JobError without the group, or if its CG input is already linked.
    """
    tree = compat.compositor_tree(scene)
    _require_local(tree)
    node = freeze_group.group_node(tree) if tree else None
    if node is None:
        raise contract.JobError("The freeze is not in this compositor.", "Bake first.", contract.ExitCode.BAKE)
    if node.inputs["CG"].is_linked:
        raise contract.JobError(
            f'The input "CG" of {GROUP_NAME} is already linked.',
            "Unlink it first.",
            contract.ExitCode.BAKE,
        )
    return node


def combine_cg(scene: bpy.types.Scene) -> list[str]:
    """Links the scene's render to the group, which composites it with the frozen frames by depth. Returns the changes.

    The view layer must have its depth pass. Raises JobError as `may_combine_cg` does.
    """
    may_combine_cg(scene)
    tree = freeze_group.single_user_tree(scene)
    node = present(freeze_group.group_node(tree))
    layers: Any = tree.nodes.new("CompositorNodeRLayers")
    layers[TAG] = _CG
    layers.scene = scene
    layers.name = layers.label = "CG among the frozen"
    layers.location = (node.location.x - 2 * GAP, node.location.y - 300.0)
    tree.links.new(layers.outputs["Image"], node.inputs["CG"])
    tree.links.new(layers.outputs["Depth"], node.inputs["CG Depth"])
    return [
        "The scene's render was linked into the freeze. Objects appear in front of or behind the frozen "
        "people by depth."
    ]


def remove(scene: bpy.types.Scene) -> bool:
    """Removes the group, restores the link and deletes data that only we used. True if there was a group."""
    tree = compat.compositor_tree(scene)
    node = freeze_group.group_node(tree) if tree else None
    if tree is None or node is None or library_of(tree):
        return False
    tree = freeze_group.single_user_tree(scene)
    node = present(freeze_group.group_node(tree))
    group = present(node.node_tree)
    before = json.loads(group.get(freeze_group.BEFORE, "{}"))
    placing.bypass(tree, node)
    images = [n.image for n in group.nodes if isinstance(n, bpy.types.CompositorNodeImage) and n.image]
    textures = [t for n in group.nodes if n.bl_idname == "CompositorNodeTexture" and (t := getattr(n, "texture", None))]
    tree.nodes.remove(node)
    if group.users == 0:  # unless another scene uses it
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


def prefetch(take: Take, plate: Path | None = None, warp: bool = False) -> Iterator[None]:
    """Loads the images that `insert` needs, one per iteration."""
    wanted: list[tuple[Path, str, sequences.Encoding]] = [
        (numbered.frame_path(take.folder, take.first), f"Frozen {take.folder.name}", take.light)
    ]
    if warp and any(take.plate_size):
        wanted.append(_warp_picture(take))
    for path, name, encoding in wanted:
        # Blender's window is blocked while it loads an image, so the timer gets a turn after each.
        sequences.read(path, name, encoding, take.first, take.last)
        yield
    if plate is not None:
        yield from original_plate.prefetch(take, _shot_of(take), plate)


def _warp_picture(take: Take) -> tuple[Path, str, sequences.Encoding]:
    """First file, data-block name and encoding of a take's warp."""
    warps = contract.TakeFolder(take.folder).warps
    return numbered.frame_path(warps, take.first), f"Warp {take.folder.name}", take.light


_OUTPUTS = ("CompositorNodeComposite", "NodeGroupOutput", "NodeGroupInput")


def _show_plate(
    scene: bpy.types.Scene,
    tree: bpy.types.NodeTree,
    node: bpy.types.CompositorNodeGroup,
    plate: original_plate.Plate,
    take: Take,
) -> bool:
    """Links the undistorted plate to our group, or updates the existing link. Mix then fades between plate and freeze.

    The artist may edit the minimal tree: existing nodes of ours are reused, and the artist's links are kept.
    Returns False without changes if the artist links another stream to the group, or shows another image in our node.
    """
    ours, before = _stream_of(tree, node), placing.links_of(node.inputs["Image"])
    reader = next((n for n in ours if isinstance(n, bpy.types.CompositorNodeImage)), None)
    is_foreign = before and before[0].from_node not in ours if reader is None else _is_foreign(reader.image)
    stale = [] if is_foreign else _images(ours)
    if not is_foreign:
        if reader is None:
            for old in ours:
                original_plate.drop(old)
            _make_stream(scene, tree, node, plate, take)
        else:
            sequences.show_sequence(reader, plate.image, take.first, take.last, plate.shift)
            _follow_plate(scene, tree, node, reader, ours, plate)
    for image in {i.name: i for i in [*stale, plate.image, plate.map] if i is not None}.values():
        if image.users == 0 and not _is_foreign(image):
            bpy.data.images.remove(image)
    return not is_foreign


def _stream_of(tree: bpy.types.NodeTree, node: bpy.types.CompositorNodeGroup) -> list[bpy.types.Node]:
    """Our nodes of the plate's stream, those upstream of the group first."""
    # An artist's copies of our nodes carry the same tag.
    marked = [n for n in tree.nodes if n.get(TAG) and n.get(TAG) != _CG]
    sources = placing.upstream(node)
    return sorted(marked, key=lambda n: n not in sources)


def _is_foreign(image: bpy.types.Image | None) -> bool:
    return image is not None and not image.get(TAG)


def _images(nodes: Sequence[bpy.types.Node]) -> list[bpy.types.Image]:
    return [image for node in nodes for image in original_plate.images_of(node)]


def _make_stream(
    scene: bpy.types.Scene,
    tree: bpy.types.NodeTree,
    node: bpy.types.CompositorNodeGroup,
    plate: original_plate.Plate,
    take: Take,
) -> None:
    """Builds the plate's stream from left to right in a tree without one."""
    reader = tree.nodes.new("CompositorNodeImage")
    assert isinstance(reader, bpy.types.CompositorNodeImage)
    reader[TAG] = True
    reader.name = reader.label = "Plate"
    sequences.show_sequence(reader, plate.image, take.first, take.last, plate.shift)
    end = present(present(compat.output_socket(tree)).node)
    end.location = (node.location.x + node.width + 60.0, node.location.y)
    reader.location = (node.location.x - (3 if original_plate.between(plate) else 2) * GAP, node.location.y)
    _follow_plate(scene, tree, node, reader, [], plate)


def _follow_plate(
    scene: bpy.types.Scene,
    tree: bpy.types.NodeTree,
    node: bpy.types.CompositorNodeGroup,
    reader: bpy.types.CompositorNodeImage,
    ours: Sequence[bpy.types.Node],
    plate: original_plate.Plate,
) -> None:
    """Adapts the nodes between Plate and the group to a plate. A new node takes over the links of the node it
    replaces."""
    fit = next((n for n in ours if n.bl_idname == "CompositorNodeScale"), None)
    inner = next((n for n in ours if original_plate.kind(n)), None)
    wanted, stream = original_plate.between(plate), present(reader.outputs)["Image"]
    if inner is not None and original_plate.kind(inner) == wanted:
        original_plate.refill(inner, plate)
        stream = inner.outputs[0]
    elif inner is not None or wanted:
        anchor = (inner or fit or node).location
        place = (anchor.x - (0 if inner else GAP if fit else 2 * GAP), anchor.y)
        targets = [present(k.to_socket) for k in placing.links_of(stream if inner is None else inner.outputs[0])]
        if inner is not None:
            stream = next((present(k.from_socket) for k in placing.links_of(inner.inputs[0])), stream)
            original_plate.drop(inner)
        stream = original_plate.through(tree, stream, plate, place)
        for target in targets:
            tree.links.new(stream, target)
    mode, image_input = fitting.fit_mode(scene, plate.size), node.inputs["Image"]
    if fit is None and not image_input.is_linked:
        fit = compat.new_fit_node(tree, mode)
        fit[TAG], fit[_FIT_MODE] = True, mode
        fit.label = "Fit Plate"
        fit.location = (node.location.x - GAP, node.location.y)
    elif fit is not None and fit.get(_FIT_MODE) != mode:
        compat.set_fit(fit, mode)
        fit[_FIT_MODE] = mode
    if fit is not None and not fit.inputs[0].is_linked:
        tree.links.new(stream, fit.inputs[0])
    if fit is not None and not image_input.is_linked:
        tree.links.new(fit.outputs[0], image_input)
