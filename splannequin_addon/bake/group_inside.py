"""The inside of the freeze group: frames, warp, grain, CG composited by depth, mattes."""

from __future__ import annotations

import bpy

from ...torch_backend import contract
from .. import compat
from ..access import named, present
from ..scene import sequences
from . import fitting, warp_nodes
from .node_names import AS_WARP, DEPTH, FROZEN, GAP, GRAIN, INVENTED, SOFTNESS
from .take_files import Take

# Depths of CG from this value on mean that the pixel shows no surface.
_NOTHING = 0.1 * contract.NO_DEPTH
# Tolerances as fractions of the frozen depth. CG up to `_EVEN` behind the frozen surface counts as in front. Over a
# further `_SOFT` it fades behind. `_EVEN` is the median error of frozen depth on truth (docs/benchmarks.md, "Depth").
# Without this tolerance, the frozen surface shows through objects that stand on it: through a quarter of their rims and
# a twelfth of their shadows.
_EVEN, _SOFT = 0.005, 0.01
# Fraction of its depth by which a caught shadow (black CG) counts as nearer. A take's surface mesh lies up to 3 %
# behind its frames (docs/benchmarks.md, "The frozen scene as a mesh"), which left holes in shadows.
_SHADOW = 0.05


def fill(
    scene: bpy.types.Scene,
    node: bpy.types.CompositorNodeGroup,
    take: Take,
    image: bpy.types.Image,
    warp: bpy.types.Image | None,
) -> None:
    """Builds or rebuilds the inside of our node's group. Its sockets, and so the links to it, stay."""
    group, shown = present(node.node_tree), {i.name for i in (image, warp) if i is not None}
    readers = [n for n in group.nodes if isinstance(n, bpy.types.CompositorNodeImage)]
    old = {n.image.name for n in readers if n.image} - {fitting.RAMP}
    group.nodes.clear()
    enter = group.nodes.new("NodeGroupInput")
    leave = group.nodes.new("NodeGroupOutput")
    frozen = group.nodes.new("CompositorNodeImage")
    frozen.name = frozen.label = FROZEN
    sequences.show_sequence(frozen, image, take.first, take.last)
    mix, factor, first, second, mixed = compat.new_mix_node(group)
    depth = compat.new_math_node(group)
    depth.name = depth.label = DEPTH
    depth.inputs[1].default_value = take.depth_scale
    enter.location, frozen.location = (-2 * GAP, 150.0), (-3 * GAP, -100.0)
    mix.location, depth.location, leave.location = (3 * GAP, 150.0), (GAP, -100.0), (4 * GAP, 0.0)

    layers = {n: frozen.outputs[n] for n in (layer.name for layer in contract.FRAME_LAYERS) if n in frozen.outputs}
    if warp is not None:
        layers["Combined"] = _warped(group, enter, layers["Combined"], warp, take)
    if "Plate" in layers:
        layers["Combined"] = _looked_at(group, enter, layers)
    for layer in contract.FRAME_LAYERS:
        if not layer.output and layer.name != GRAIN:
            layers.pop(layer.name, None)  # no later node reads this layer
    fitted = fitting.fitted(scene, group, take.size, take.margin, layers)
    share = _share(group, enter, fitted)
    nearer = _nearer(group, _cg_depth(group, enter), depth.outputs[0], enter.outputs[SOFTNESS])
    group.links.new(share, factor)
    # CG is in both inputs: Mix, Wipe and the mattes choose between stream and frozen frame but do not hide CG.
    group.links.new(_insert_cg(group, enter, enter.outputs["Image"], nearer, "CG in your stream"), first)
    group.links.new(_insert_cg(group, enter, _grainy(group, enter, fitted), nearer, "CG among the frozen"), second)
    group.links.new(mixed, leave.inputs["Image"])
    group.links.new(fitted["Depth"], depth.inputs[0])
    group.links.new(depth.outputs[0], leave.inputs["Depth"])
    if "Source" in fitted:  # plate numbers: scaling may have made fractions of them
        whole = compat.new_math_node(group, "ROUND")
        group.links.new(fitted["Source"], whole.inputs[0])
        fitted["Source"] = whole.outputs[0]
    for layer in contract.FRAME_LAYERS:
        if layer.output and layer.name in fitted and layer.name not in ("Combined", "Depth"):
            group.links.new(fitted[layer.name], leave.inputs[layer.output])
    for name in old - shown:
        stale = named(bpy.data.images, name)
        if stale is not None and stale.users == 0:
            bpy.data.images.remove(stale)


def _warped(
    group: bpy.types.NodeTree,
    enter: bpy.types.Node,
    frame_socket: bpy.types.NodeSocket,
    image: bpy.types.Image,
    take: Take,
) -> bpy.types.NodeSocket:
    """Socket of the frozen image: the take's frames, or the group's input frozen by the take's warp."""
    reader = group.nodes.new("CompositorNodeImage")
    reader.name = reader.label = "Warp"
    reader.location = (-3 * GAP, -1500.0)
    sequences.show_sequence(reader, image, take.first, take.last)
    frozen = warp_nodes.frozen(group, enter.outputs["Image"], reader.outputs, take.plate_size)
    node, factor, first, second, mixed = compat.new_mix_node(group)
    node.label, node.location = AS_WARP, (-2 * GAP, 330.0)
    group.links.new(enter.outputs[AS_WARP], factor)
    group.links.new(frame_socket, first)
    group.links.new(frozen, second)
    return mixed


# Colour of the tint for invented pixels, and its strength where no pixel comes from a plate.
_TINT, _TINTED = (1.0, 0.0, 0.4, 1.0), 0.6


def _looked_at(
    group: bpy.types.NodeTree, enter: bpy.types.Node, layers: dict[str, bpy.types.NodeSocket]
) -> bpy.types.NodeSocket:
    """Socket of the frozen image or the splats alone, with invented pixels tinted by the requested amount."""
    node, factor, first, second, chosen = compat.new_mix_node(group)
    node.label, node.location = "Splat", (-2 * GAP, 500.0)
    group.links.new(enter.outputs["Splat"], factor)
    group.links.new(layers["Combined"], first)
    group.links.new(layers["Splat"], second)
    # tinted * (1 - plate), by the requested amount
    invented = compat.new_math_node(group, "MULTIPLY_ADD")
    invented.inputs[1].default_value, invented.inputs[2].default_value = -_TINTED, _TINTED
    group.links.new(layers["Plate"], invented.inputs[0])
    amount = _product(group, enter.outputs[INVENTED], invented.outputs[0])
    tint, factor, first, second, tinted = compat.new_mix_node(group)
    tint.label, second.default_value = INVENTED, _TINT
    group.links.new(amount, factor)
    group.links.new(chosen, first)
    invented.location, tint.location = (-2 * GAP, 670.0), (-GAP, 500.0)
    return tinted


def _grainy(
    group: bpy.types.NodeTree, enter: bpy.types.Node, layers: dict[str, bpy.types.NodeSocket]
) -> bpy.types.NodeSocket:
    """Socket of the frozen image with the requested amount of grain. Earlier takes have no grain."""
    if GRAIN not in layers:
        return layers["Combined"]
    node, factor, first, second, summed = compat.new_mix_node(group, "ADD")
    node.name = node.label = GRAIN
    node.location = (0.0, -900.0)
    group.links.new(enter.outputs[GRAIN], factor)
    group.links.new(layers["Combined"], first)
    group.links.new(layers[GRAIN], second)
    return summed


def _insert_cg(
    group: bpy.types.NodeTree,
    enter: bpy.types.Node,
    picture: bpy.types.NodeSocket,
    nearer: bpy.types.NodeSocket,
    label: str,
) -> bpy.types.NodeSocket:
    """Socket of an image composited with CG: CG over it where CG is nearer, under it elsewhere."""
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
        node.location = (GAP, -350.0 - 170.0 * row)
    choose.location = (2 * GAP, -350.0)
    return chosen


def _cg_depth(group: bpy.types.NodeTree, enter: bpy.types.Node) -> bpy.types.NodeSocket:
    """Socket of the depth of CG. Pixels without a depth use the nearest depth of their neighbours."""
    # A pixel that CG covers partly often has the depth of the empty background.
    around = compat.new_nearest_node(group)
    group.links.new(enter.outputs["CG Depth"], around.inputs[0])
    # Where the pixel has a depth, the neighbours' depth is raised so far that the minimum keeps the pixel's depth.
    has_depth = compat.new_math_node(group, "LESS_THAN")
    has_depth.inputs[1].default_value = _NOTHING
    group.links.new(enter.outputs["CG Depth"], has_depth.inputs[0])
    far = compat.new_math_node(group, "MULTIPLY_ADD")
    far.inputs[1].default_value = contract.NO_DEPTH
    group.links.new(has_depth.outputs[0], far.inputs[0])
    group.links.new(around.outputs[0], far.inputs[2])
    depth = compat.new_math_node(group, "MINIMUM")
    depth.label = "Depth of CG, edges too"
    group.links.new(enter.outputs["CG Depth"], depth.inputs[0])
    group.links.new(far.outputs[0], depth.inputs[1])
    for column, node in enumerate((around, has_depth, far, depth)):
        node.location = (GAP * (column - 3), -1100.0)
    return _shadows_nearer(group, enter, depth.outputs[0])


def _shadows_nearer(
    group: bpy.types.NodeTree, enter: bpy.types.Node, depth: bpy.types.NodeSocket
) -> bpy.types.NodeSocket:
    """Socket of the depth of CG, reduced by the fraction `_SHADOW` where CG is black, as a shadow catcher renders
    it."""
    red, green, blue = compat.separated(group, enter.outputs["CG"])
    brighter, brightest = (compat.new_math_node(group, "MAXIMUM") for _ in range(2))
    black, share, nearer = (compat.new_math_node(group, o) for o in ("LESS_THAN", "MULTIPLY_ADD", "MULTIPLY"))
    black.inputs[1].default_value, share.inputs[1].default_value, share.inputs[2].default_value = 1e-6, -_SHADOW, 1.0
    nearer.label = "Depth of CG, shadows nearer"
    for source, target in (
        (red, brighter.inputs[0]), (green, brighter.inputs[1]), (brighter.outputs[0], brightest.inputs[0]),
        (blue, brightest.inputs[1]), (brightest.outputs[0], black.inputs[0]), (black.outputs[0], share.inputs[0]),
        (depth, nearer.inputs[0]), (share.outputs[0], nearer.inputs[1]),
    ):  # fmt: skip
        group.links.new(source, target)
    for column, node in enumerate((brighter, brightest, black, share, nearer)):
        node.location = (GAP * (column - 3), -1500.0)
    return nearer.outputs[0]


def _nearer(
    group: bpy.types.NodeTree, cg: bpy.types.NodeSocket, frozen: bpy.types.NodeSocket, softness: bpy.types.NodeSocket
) -> bpy.types.NodeSocket:
    """Socket of the weight of CG in front: 1 up to `_EVEN` behind the frozen depth, falling smoothly to 0 over `_SOFT`.

    Softness, in scene units, extends the transition by that length at both ends. At 0 it changes no bit of the result.
    """
    ratio = compat.new_math_node(group, "DIVIDE")
    group.links.new(cg, ratio.inputs[0])
    group.links.new(frozen, ratio.inputs[1])
    rise = compat.new_math_node(group, "MULTIPLY_ADD")
    rise.inputs[1].default_value, rise.inputs[2].default_value = -1.0 / _SOFT, 1.0 + (1.0 + _EVEN) / _SOFT
    # (rise + k) / (1 + 2 k), k = softness / (frozen depth * _SOFT)
    longer, raised, length, eased = (
        compat.new_math_node(group, o) for o in ("DIVIDE", "MULTIPLY_ADD", "MULTIPLY_ADD", "DIVIDE")
    )
    raised.inputs[1].default_value = 1.0 / _SOFT
    length.inputs[1].default_value, length.inputs[2].default_value = 2.0 / _SOFT, 1.0
    eased.use_clamp = True
    # t * t * (3 - 2 * t)
    square, slope, smooth = (compat.new_math_node(group, o) for o in ("MULTIPLY", "MULTIPLY_ADD", "MULTIPLY"))
    slope.inputs[1].default_value, slope.inputs[2].default_value = -2.0, 3.0
    smooth.label = "CG is nearer"
    group.links.new(softness, longer.inputs[0])
    group.links.new(frozen, longer.inputs[1])
    for source, target in (
        (ratio, rise.inputs[0]), (longer, raised.inputs[0]), (rise, raised.inputs[2]), (longer, length.inputs[0]),
        (raised, eased.inputs[0]), (length, eased.inputs[1]),
        (eased, square.inputs[0]), (eased, square.inputs[1]), (eased, slope.inputs[0]),
        (square, smooth.inputs[0]), (slope, smooth.inputs[1]),
    ):  # fmt: skip
        group.links.new(source.outputs[0], target)
    for column, node in enumerate((ratio, rise, longer, raised, length, eased, square, slope, smooth)):
        node.location = (GAP * (column - 5), -1300.0)
    return smooth.outputs[0]


def _share(
    group: bpy.types.NodeTree, enter: bpy.types.Node, layers: dict[str, bpy.types.NodeSocket]
) -> bpy.types.NodeSocket:
    """Socket of the frozen frame's weight: the product of Mix, the area left of Wipe and the mattes."""
    left = compat.new_math_node(group, "LESS_THAN")
    left.label = "Left of the wipe"
    group.links.new(fitting.across(group), left.inputs[0])
    group.links.new(enter.outputs["Wipe"], left.inputs[1])
    total = _product(group, enter.outputs["Mix"], left.outputs[0])
    for row, (name, layer) in enumerate((("Only Supported", "Support"), ("Only Moving", "Motion"))):
        # 1 - amount * (1 - matte)
        complement = compat.new_math_node(group, "SUBTRACT")
        complement.inputs[0].default_value = 1.0
        group.links.new(layers[layer], complement.inputs[1])
        removed = _product(group, enter.outputs[name], complement.outputs[0])
        kept = compat.new_math_node(group, "SUBTRACT")
        kept.inputs[0].default_value = 1.0
        group.links.new(removed, kept.inputs[1])
        total = _product(group, total, kept.outputs[0])
        complement.location, kept.location = (-2 * GAP, 500.0 + 170.0 * row), (-GAP, 500.0 + 170.0 * row)
    left.location = (-GAP, 330.0)
    return total


def _product(
    group: bpy.types.NodeTree, first: bpy.types.NodeSocket, second: bpy.types.NodeSocket
) -> bpy.types.NodeSocket:
    node = compat.new_math_node(group)
    node.location = (0.0, 330.0)
    group.links.new(first, node.inputs[0])
    group.links.new(second, node.inputs[1])
    return node.outputs[0]
