"""Every difference between Blender 4.2 and 5.2 that the add-on meets, and nowhere else.

The compositor tree moved from `scene.node_tree` (4.x, output: Composite node) to `scene.compositing_node_group`
(5.x, output: the group's output node); Math and Mix nodes took the shader names; node options became sockets.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import bpy
from mathutils import Color

from ..torch_backend.contract import PROBE, UserError

if TYPE_CHECKING:
    from bpy.stub_internal.rna_enums import PropertyFlagItems

# A feature is looked up where Blender lists it, which also works in a Blender that was never tried. A behaviour is not
# listed, so it goes by the version.
HAS_COMPOSITING_GROUP = "compositing_node_group" in bpy.types.Scene.bl_rna.properties
"""True where the compositor is a node group of the scene (5.0 on)."""
HAS_TEXTURE_NODE = hasattr(bpy.types, "CompositorNodeTexture")
"""True where the compositor has a Texture node, which knows a pixel's place in the frame (until 5.0)."""
CROPS_WHOLE = bpy.app.version >= (4, 5, 0)
"""True where a Scale node that crops sets every pixel: before 4.5 a row or column at the border is left unset."""
TURNS_VIDEOS = bpy.app.version >= (4, 5, 0)
"""True if a video is turned by quarter turns as its header says. 4.2 and 4.3 show it as stored; 4.4 was not tried."""

HAS_PATH_TEMPLATES = "is_path_supports_templates" in bpy.types.Property.bl_rna.properties
"""True where braces in an output path are templates (4.5 on)."""

POINT_SHADERS = ("POINT_FLAT_COLOR", "FLAT_COLOR") if bpy.app.version >= (4, 5, 0) else ("FLAT_COLOR",)
"""Built-in shaders that colour points, the best first: points have one of their own since 4.5."""

PATH_OPTIONS: set[PropertyFlagItems] = set()
"""Options of a path property that may hold a path relative to the .blend (`//`); said aloud since 4.5."""
if "is_path_supports_blend_relative" in bpy.types.Property.bl_rna.properties:
    PATH_OPTIONS.add("PATH_SUPPORTS_BLEND_RELATIVE")


def compositor_tree(scene: bpy.types.Scene) -> bpy.types.NodeTree | None:
    """The scene's compositor tree, or None if it has none."""
    return scene.compositing_node_group if HAS_COMPOSITING_GROUP else _own_tree(scene)


def own_compositor_tree(scene: bpy.types.Scene) -> bpy.types.NodeTree:
    """The scene's compositor tree, copied first if another scene has it, too (5.0 on). Only for a scene with one."""
    if not HAS_COMPOSITING_GROUP:
        return _own_tree(scene)
    tree = scene.compositing_node_group
    assert tree is not None
    sharing = [other for other in bpy.data.scenes if other != scene and other.compositing_node_group == tree]
    if not sharing:
        return tree
    fresh = scene.compositing_node_group = tree.copy()
    for node in fresh.nodes:  # what showed one of these scenes in the shared tree stood for the scene itself
        if isinstance(node, bpy.types.CompositorNodeRLayers) and node.scene in sharing:
            node.scene = scene
    return fresh


def _own_tree(scene: Any) -> bpy.types.NodeTree:
    """The scene's tree until 5.0, which no newer Blender's types know of."""
    return scene.node_tree


def compositor_enabled(scene: bpy.types.Scene) -> bool:
    """True if rendering the scene runs its compositor tree."""
    used = HAS_COMPOSITING_GROUP or scene.use_nodes
    return bool(used and scene.render.use_compositing and compositor_tree(scene))


def enable_compositor(scene: bpy.types.Scene) -> None:
    """Makes rendering the scene run its compositor tree."""
    scene.render.use_compositing = True
    if not HAS_COMPOSITING_GROUP:
        scene.use_nodes = True


def compositor_switches(scene: bpy.types.Scene) -> dict[str, bool]:
    """What `enable_compositor` may change, by name."""
    nodes = {} if HAS_COMPOSITING_GROUP else {"use_nodes": bool(scene.use_nodes)}
    return {"use_compositing": bool(scene.render.use_compositing), **nodes}


def restore_compositor_switches(scene: bpy.types.Scene, switches: Mapping[str, bool]) -> None:
    """Sets what `compositor_switches` told; other names are passed over."""
    if "use_compositing" in switches:
        scene.render.use_compositing = switches["use_compositing"]
    if "use_nodes" in switches:
        scene.use_nodes = switches["use_nodes"]


def new_compositor_tree(scene: bpy.types.Scene, name: str) -> bpy.types.NodeTree:
    """An empty tree with an output node, made the scene's own. Only for a scene without one."""
    if not HAS_COMPOSITING_GROUP:
        scene.use_nodes = True
        tree = _own_tree(scene)
        tree.nodes.clear()
        tree.nodes.new("CompositorNodeComposite")
        return tree
    tree = bpy.data.node_groups.new(name, "CompositorNodeTree")
    new_socket(tree, "Image", "OUTPUT", "NodeSocketColor")
    tree.nodes.new("NodeGroupOutput")
    scene.compositing_node_group = tree
    return tree


def drop_compositor_tree(scene: bpy.types.Scene) -> None:
    """Takes the tree that `new_compositor_tree` made away again."""
    if not HAS_COMPOSITING_GROUP:
        _own_tree(scene).nodes.clear()
        scene.use_nodes = False
        return
    tree = scene.compositing_node_group
    scene.compositing_node_group = None
    if tree is not None and tree.users == 0:
        bpy.data.node_groups.remove(tree)


def output_socket(tree: bpy.types.NodeTree) -> bpy.types.NodeSocket | None:
    """The input socket through which the tree's picture leaves: of the Composite or of the group output node."""
    if HAS_COMPOSITING_GROUP:
        nodes = [n for n in tree.nodes if isinstance(n, bpy.types.NodeGroupOutput) and n.is_active_output]
        sockets = [s for n in nodes for s in n.inputs if s.type == "RGBA"]
        return sockets[0] if sockets else None
    nodes = [n for n in tree.nodes if n.bl_idname == "CompositorNodeComposite"]
    # Several Composite nodes are legal and which one renders is not told: the active one, then a linked one.
    nodes.sort(key=lambda n: (n == tree.nodes.active, n.inputs["Image"].is_linked))
    return nodes[-1].inputs["Image"] if nodes else None


def new_output_node(tree: bpy.types.NodeTree) -> bpy.types.NodeSocket | None:
    """Adds the missing output node to a tree; returns the socket through which the picture leaves."""
    if not HAS_COMPOSITING_GROUP:
        return tree.nodes.new("CompositorNodeComposite").inputs["Image"]
    if not any(i.in_out == "OUTPUT" and str(i.socket_type) == "NodeSocketColor" for i in sockets_of(tree)):
        new_socket(tree, "Image", "OUTPUT", "NodeSocketColor")
    tree.nodes.new("NodeGroupOutput")
    return output_socket(tree)


def new_mix_node(tree: bpy.types.NodeTree, blend: str = "MIX") -> tuple[Any, Any, Any, Any, Any]:
    """A colour mix node: (node, factor socket, first colour, second colour, result). Only MIX clamps its factor."""
    if HAS_COMPOSITING_GROUP:
        node: Any = tree.nodes.new("ShaderNodeMix")
        node.data_type = "RGBA"
        node.blend_type = blend
        node.clamp_factor = blend == "MIX"
        enabled = [s for s in node.inputs if s.enabled]
        result = next(s for s in node.outputs if s.enabled)
        return node, enabled[0], enabled[1], enabled[2], result
    node: Any = tree.nodes.new("CompositorNodeMixRGB")
    node.blend_type = blend
    return node, node.inputs[0], node.inputs[1], node.inputs[2], node.outputs[0]


def sockets_of(group: bpy.types.NodeTree) -> list[bpy.types.NodeTreeInterfaceSocket]:
    """Inputs and outputs of a group, as its nodes have them."""
    assert group.interface is not None
    return [i for i in group.interface.items_tree if isinstance(i, bpy.types.NodeTreeInterfaceSocket)]


def new_socket(group: bpy.types.NodeTree, name: str, side: str, kind: str, text: str = "") -> Any:
    """Gives a group an input or output; `side` is "INPUT" or "OUTPUT", `kind` the name of a class of sockets."""
    face: Any = group.interface  # whose types know sockets without a kind alone
    return face.new_socket(name, in_out=side, socket_type=kind, description=text)


def new_math_node(tree: bpy.types.NodeTree, operation: str = "MULTIPLY") -> Any:
    """A Math node on inputs[0] and inputs[1]: MULTIPLY, LESS_THAN and so on."""
    node: Any = tree.nodes.new("ShaderNodeMath" if HAS_COMPOSITING_GROUP else "CompositorNodeMath")
    node.operation = operation
    return node


def new_over_node(tree: bpy.types.NodeTree) -> tuple[Any, Any, Any]:
    """An Alpha Over node of premultiplied pictures: (node, background socket, foreground socket)."""
    node: Any = tree.nodes.new("CompositorNodeAlphaOver")
    pictures = [s for s in node.inputs if s.type == "RGBA"]
    return node, pictures[0], pictures[1]


def new_fit_node(tree: bpy.types.NodeTree, how: str = "Fit") -> Any:
    """A Scale node that brings inputs[0] to the render size, and leaves what has that size as it is, bit by bit.

    Args:
        tree: where it is made.
        how: "Fit" shows all and leaves bars, "Crop" fills the frame and cuts off what is over; both keep the shape.
            "Stretch" does not.
    """
    node: Any = tree.nodes.new("CompositorNodeScale")
    if HAS_COMPOSITING_GROUP:
        node.inputs["Type"].default_value = "Render Size"
    else:
        node.space = "RENDER_SIZE"
    set_fit(node, how)
    return node


def set_fit(fit: bpy.types.Node, how: str) -> None:
    """Has a node of `new_fit_node` do it in another way."""
    node: Any = fit
    if HAS_COMPOSITING_GROUP:
        node.inputs["Frame Type"].default_value = how
        beyond = "Extend" if how == "Crop" else "Clip"  # else the outermost pixels fade out
        node.inputs["Extension X"].default_value = node.inputs["Extension Y"].default_value = beyond
    else:
        node.frame_method = how.upper()


def new_quotient(tree: bpy.types.NodeTree, picture: bpy.types.NodeSocket, value: bpy.types.NodeSocket) -> Any:
    """Socket of a picture whose four channels are divided by a value; 0 where that is 0. Until 4.5."""
    node: Any = tree.nodes.new("CompositorNodeMixRGB")
    node.blend_type = "DIVIDE"
    parts = tree.nodes.new("CompositorNodeSeparateColor")
    alpha = new_math_node(tree, "DIVIDE")
    for source, target in (
        (picture, node.inputs[1]), (value, node.inputs[2]), (picture, parts.inputs[0]),
        (parts.outputs["Alpha"], alpha.inputs[0]), (value, alpha.inputs[1]),
    ):  # fmt: skip
        tree.links.new(source, target)
    return with_alpha(tree, node.outputs[0], alpha.outputs[0])


def with_alpha(tree: bpy.types.NodeTree, picture: bpy.types.NodeSocket, alpha: bpy.types.NodeSocket) -> Any:
    """Socket of a picture with another alpha; its colours stay. A mix has its first picture's until 5.1, then a mix."""
    node: Any = tree.nodes.new("CompositorNodeSetAlpha")
    if HAS_COMPOSITING_GROUP:
        node.inputs["Type"].default_value = "Replace Alpha"
    else:
        node.mode = "REPLACE_ALPHA"
    tree.links.new(picture, node.inputs["Image"])
    tree.links.new(alpha, node.inputs["Alpha"])
    return node.outputs[0]


def new_nearest_node(tree: bpy.types.NodeTree) -> Any:
    """A node whose output is the least of inputs[0] at a pixel and its eight neighbours."""
    node: Any = tree.nodes.new("CompositorNodeDilateErode")
    if "Size" in node.inputs:  # 4.5 on
        node.inputs["Size"].default_value = -1
    else:
        node.distance = -1
    if "Type" in node.inputs:  # 5.0 on
        node.inputs["Type"].default_value = "Steps"
    else:
        node.mode = "STEP"
    return node


def new_crop_node(tree: bpy.types.NodeTree, margin: tuple[int, int], size: tuple[int, int]) -> Any:
    """A Crop node that leaves the middle, `size`, of inputs[0]: `margin` pixels are cut off each side, up and down."""
    node: Any = tree.nodes.new("CompositorNodeCrop")
    (left, low), (width, height) = margin, size
    if "Width" in node.inputs:  # 4.5 on
        node.inputs["Alpha Crop"].default_value = False
        for name, value in (("X", left), ("Y", low), ("Width", width), ("Height", height)):
            node.inputs[name].default_value = value
    else:
        node.use_crop_size, node.relative = True, False
        node.min_x, node.max_x = left, left + width
        node.min_y, node.max_y = low + height, low  # the upper one first
    return node


def new_look_up(
    tree: bpy.types.NodeTree, picture: bpy.types.NodeSocket, x: bpy.types.NodeSocket, y: bpy.types.NodeSocket
) -> Any:
    """Socket of a picture's pixels at coordinates x and y, 0..1 over it, each the nearest one, as it is."""
    place: Any = tree.nodes.new(f"{'Shader' if HAS_COMPOSITING_GROUP else 'Compositor'}NodeCombineXYZ")
    place.inputs["Z"].default_value = 1.0  # 0 would be nothing
    node: Any = tree.nodes.new("CompositorNodeMapUV")
    if HAS_COMPOSITING_GROUP:
        node.inputs["Interpolation"].default_value = "Nearest"
    else:
        node.filter_type, node.alpha = "NEAREST", 0
    for source, target in (
        (x, place.inputs["X"]), (y, place.inputs["Y"]),
        (picture, node.inputs["Image"]), (place.outputs[0], node.inputs["UV"]),
    ):  # fmt: skip
        tree.links.new(source, target)
    return node.outputs[0]


def new_coordinates(tree: bpy.types.NodeTree, vector: bpy.types.NodeSocket) -> tuple[Any, Any]:
    """Sockets of the first two values of a vector."""
    s, t, _ = separated(tree, vector)
    return s, t


def separated(tree: bpy.types.NodeTree, picture: bpy.types.NodeSocket) -> tuple[Any, Any, Any]:
    """Sockets of a picture's red, green and blue, nothing cut."""
    node: Any = tree.nodes.new(f"{'Shader' if HAS_COMPOSITING_GROUP else 'Compositor'}NodeSeparateXYZ")
    tree.links.new(picture, node.inputs[0])
    return node.outputs["X"], node.outputs["Y"], node.outputs["Z"]


def combined(tree: bpy.types.NodeTree, channels: Sequence[bpy.types.NodeSocket]) -> Any:
    """Socket of an opaque picture of its red, green and blue."""
    node: Any = tree.nodes.new(f"{'Shader' if HAS_COMPOSITING_GROUP else 'Compositor'}NodeCombineXYZ")
    for socket, channel in zip(node.inputs, channels, strict=True):
        tree.links.new(channel, socket)
    return node.outputs[0]


def sized(tree: bpy.types.NodeTree, picture: bpy.types.NodeSocket, size: tuple[int, int]) -> Any:
    """Socket of a picture brought to a size in pixels; one that has it stays as it is, bit by bit.

    The picture itself before 4.5, where a Scale node leaves no pixel as it is.
    """
    if not CROPS_WHOLE:
        return picture
    node: Any = tree.nodes.new("CompositorNodeScale")
    if HAS_COMPOSITING_GROUP:
        node.inputs["Type"].default_value = "Absolute"
        node.inputs["Extension X"].default_value = node.inputs["Extension Y"].default_value = "Extend"
    else:
        node.space = "ABSOLUTE"
    node.inputs["X"].default_value, node.inputs["Y"].default_value = size
    tree.links.new(picture, node.inputs[0])
    return node.outputs[0]


def literal(path: str) -> str:
    """An output path that means these very letters: braces are doubled where Blender would fill something in."""
    return path.replace("{", "{{").replace("}", "}}") if HAS_PATH_TEMPLATES else path


def set_png(settings: bpy.types.ImageFormatSettings) -> None:
    """8-bit RGB PNG as a scene's output format. RGB, so that holes come out black instead of divided by alpha."""
    if hasattr(settings, "media_type"):
        settings.media_type = "IMAGE"
    settings.file_format = "PNG"
    settings.color_mode = "RGB"
    settings.color_depth = "8"
    settings.compression = 15
    settings.color_management = "FOLLOW_SCENE"


_PROBE = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 1\n" + bytes((*(int(256 * v) for v in PROBE), 128))
"""A picture of one pixel, `PROBE`, as a file."""
_LIKELY = {
    "linear": ("Linear Rec.709", "Linear Rec.709 (sRGB)", "lin_rec709", "Utility - Linear - sRGB", "Linear"),
    "srgb": ("sRGB", "sRGB - Texture", "sRGB Encoded Rec.709 (sRGB)", "Utility - sRGB - Texture", "sRGB EOTF"),
}
"""What colour configurations call these spaces: looked at first, and believed where none can be told by its effect."""
_spaces: dict[str | tuple[float, ...], str] = {}
"""Encoding -> colour space. The configuration is chosen once, when Blender starts."""


def set_image_colour(image: bpy.types.Image, encoding: str | tuple[float, ...]) -> None:
    """States the encoding of an image's file, as `colour_space`."""
    name = colour_space(encoding)
    space = _space_of(image)
    if space.name != name:
        space.name = name


def _space_of(image: bpy.types.Image) -> Any:
    """Where an image's colour space is set. Its types list the names of one configuration, and there are others."""
    return image.colorspace_settings


def set_data(image: bpy.types.Image) -> None:
    """States that an image's file holds numbers, not colours."""
    _space_of(image).is_data = True


def knows_colour(encoding: str | tuple[float, ...]) -> bool:
    """True if `colour_space` finds one."""
    try:
        return bool(colour_space(encoding))
    except ValueError:
        return False


def colour_space(encoding: str | tuple[float, ...]) -> str:
    """Name that Blender's colour configuration (its own, or that of $OCIO) gives an encoding.

    The space is known by what it does to a pixel, so it may be called anything. ValueError if there is none.

    Args:
        encoding: "linear" (Rec.709 primaries), "srgb", or the linear Rec.709 light that `contract.PROBE` means.
    """
    if encoding not in _spaces:
        likely = _LIKELY[encoding] if isinstance(encoding, str) else ()
        image = bpy.data.images.new("Splannequin Probe", 1, 1)
        try:
            space = _space_of(image)
            known = space.bl_rna.properties["name"].enum_items.keys()
            first = [n for n in (*likely, space.name) if n in known]  # the second is a role: bytes
            image.pack(data=_PROBE, data_len=len(_PROBE))
            image.source = "FILE"
            space.is_data = True
            value = Color(_first_pixel(image))
            if encoding == "srgb":
                wanted = tuple(value.from_srgb_to_scene_linear()[:])
            else:
                light = Color(encoding) if isinstance(encoding, tuple) else value
                wanted = tuple(light.from_rec709_linear_to_scene_linear()[:])
            found = (n for n in [*first, *known] if _reads_as(image, n, wanted))
            name = next(found, next((n for n in first if n in likely), ""))
        finally:
            bpy.data.images.remove(image)
        if not name:
            names = {"linear": "scene-linear Rec.709", "srgb": "sRGB"}
            what = names[encoding] if isinstance(encoding, str) else "these pictures"
            raise UserError(
                f"The colour configuration that Blender was started with (OCIO) has no colour space for {what}. "
                "Start Blender without it, or add one to it."
            )
        _spaces[encoding] = name
    return _spaces[encoding]


def _reads_as(image: bpy.types.Image, name: str, wanted: Sequence[float]) -> bool:
    """True if a picture is read as the wanted scene-linear colour in the named space. Its space is set."""
    _space_of(image).name = name
    near = 2e-3 * max(1.0, *(abs(value) for value in wanted))
    return max(abs(a - b) for a, b in zip(_first_pixel(image), wanted, strict=True)) < near


def _first_pixel(image: bpy.types.Image) -> tuple[float, float, float]:
    """Red, green and blue of an image's first pixel."""
    pixels: Any = image.pixels  # a single float, says its type
    return pixels[0], pixels[1], pixels[2]


def usd_import_options() -> list[str]:
    """Names of the switches of Blender's USD importer; none in a Blender without one."""
    importers: Any = bpy.ops.wm
    try:
        return list(importers.usd_import.get_rna_type().properties.keys())
    except (AttributeError, KeyError):  # built without USD
        return []


def splat_import_option() -> str:
    """Name of the USD importer's switch for Gaussian splats, in a Blender that reads them; empty in any other."""
    names = [name for name in usd_import_options() if name.startswith("import_")]
    return next((name for name in names if "splat" in name or "particle_field" in name), "")
