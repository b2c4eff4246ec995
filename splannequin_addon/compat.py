"""Differences between Blender 4.2 and 5.2, except those of animation, and colour spaces, whose names differ as well."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import bpy
from mathutils import Color

from ..torch_backend.contract import PROBE, UserError

if TYPE_CHECKING:
    import gpu
    from bpy.stub_internal.rna_enums import PropertyFlagItems

# Features are detected in Blender's type information, which also works in untested versions. Behaviours are not listed
# there, so they depend on the version.
HAS_COMPOSITING_GROUP = "compositing_node_group" in bpy.types.Scene.bl_rna.properties
"""True if the compositor is a node group of the scene (5.0 on)."""
HAS_TEXTURE_NODE = hasattr(bpy.types, "CompositorNodeTexture")
"""True if the compositor has a Texture node, which gives a pixel's position in the frame (until 5.0)."""
CROPS_WHOLE = bpy.app.version >= (4, 5, 0)
"""True if a cropping Scale node sets every pixel. Before 4.5 a row or column at the border is left unset."""
SCALES_EXACTLY = bpy.app.version >= (4, 5, 0)
"""True if a Scale node that keeps the size leaves every pixel unchanged. Before 4.5 it changes every pixel."""
TURNS_VIDEOS = bpy.app.version >= (4, 5, 0)
"""True if Blender rotates a video by the quarter turns in its header. 4.2 and 4.3 do not; 4.4 was not tested."""

HAS_PATH_TEMPLATES = "is_path_supports_templates" in bpy.types.Property.bl_rna.properties
"""True if braces in an output path are templates (4.5 on)."""

POINT_SHADERS = ("POINT_FLAT_COLOR", "FLAT_COLOR") if bpy.app.version >= (4, 5, 0) else ("FLAT_COLOR",)
"""Built-in shaders that colour points, best first. A dedicated point shader exists since 4.5."""

PATH_OPTIONS: set[PropertyFlagItems] = set()
"""Options of a path property that may hold a path relative to the .blend (`//`). Needed since 4.5."""
if "is_path_supports_blend_relative" in bpy.types.Property.bl_rna.properties:
    PATH_OPTIONS.add("PATH_SUPPORTS_BLEND_RELATIVE")


def compositor_tree(scene: bpy.types.Scene) -> bpy.types.NodeTree | None:
    """The scene's compositor tree, or None if it has none."""
    return scene.compositing_node_group if HAS_COMPOSITING_GROUP else _scene_node_tree(scene)


def single_user_compositor_tree(scene: bpy.types.Scene) -> bpy.types.NodeTree:
    """The scene's compositor tree, copied first if another scene shares it (5.0 on). The scene must have a tree."""
    if not HAS_COMPOSITING_GROUP:
        return _scene_node_tree(scene)
    tree = scene.compositing_node_group
    assert tree is not None
    sharing = [user for user in bpy.data.scenes if user != scene and user.compositing_node_group == tree]
    if not sharing:
        return tree
    fresh = scene.compositing_node_group = tree.copy()
    for node in fresh.nodes:  # nodes of the shared tree that showed another of these scenes now show this one
        if isinstance(node, bpy.types.CompositorNodeRLayers) and node.scene in sharing:
            node.scene = scene
    return fresh


def _scene_node_tree(scene: Any) -> bpy.types.NodeTree:
    """The scene's compositor tree before 5.0. The type stubs of newer versions lack it."""
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
    """Values that `enable_compositor` may change, by name."""
    nodes = {} if HAS_COMPOSITING_GROUP else {"use_nodes": bool(scene.use_nodes)}
    return {"use_compositing": bool(scene.render.use_compositing), **nodes}


def restore_compositor_switches(scene: bpy.types.Scene, switches: Mapping[str, bool]) -> None:
    """Restores the values from `compositor_switches`. Ignores other names."""
    if "use_compositing" in switches:
        scene.render.use_compositing = switches["use_compositing"]
    if "use_nodes" in switches:
        scene.use_nodes = switches["use_nodes"]


def new_compositor_tree(scene: bpy.types.Scene, name: str) -> bpy.types.NodeTree:
    """A new tree with an output node, assigned to the scene. Only for a scene without a tree."""
    if not HAS_COMPOSITING_GROUP:
        scene.use_nodes = True
        tree = _scene_node_tree(scene)
        tree.nodes.clear()
        tree.nodes.new("CompositorNodeComposite")
        return tree
    tree = bpy.data.node_groups.new(name, "CompositorNodeTree")
    new_socket(tree, "Image", "OUTPUT", "NodeSocketColor")
    tree.nodes.new("NodeGroupOutput")
    scene.compositing_node_group = tree
    return tree


def drop_compositor_tree(scene: bpy.types.Scene) -> None:
    """Removes the tree that `new_compositor_tree` made."""
    if not HAS_COMPOSITING_GROUP:
        _scene_node_tree(scene).nodes.clear()
        scene.use_nodes = False
        return
    tree = scene.compositing_node_group
    scene.compositing_node_group = None
    if tree is not None and tree.users == 0:
        bpy.data.node_groups.remove(tree)


def output_socket(tree: bpy.types.NodeTree) -> bpy.types.NodeSocket | None:
    """The input socket of the tree's output: of the Composite node, or of the group output node."""
    if HAS_COMPOSITING_GROUP:
        nodes = [n for n in tree.nodes if isinstance(n, bpy.types.NodeGroupOutput) and n.is_active_output]
        sockets = [s for n in nodes for s in n.inputs if s.type == "RGBA"]
        return sockets[0] if sockets else None
    nodes = [n for n in tree.nodes if n.bl_idname == "CompositorNodeComposite"]
    # With several Composite nodes, Blender does not report which one renders: prefer the active one, then a linked one.
    nodes.sort(key=lambda n: (n == tree.nodes.active, n.inputs["Image"].is_linked))
    return nodes[-1].inputs["Image"] if nodes else None


def new_output_node(tree: bpy.types.NodeTree) -> bpy.types.NodeSocket | None:
    """Adds the missing output node to a tree. Returns its image input."""
    if not HAS_COMPOSITING_GROUP:
        return tree.nodes.new("CompositorNodeComposite").inputs["Image"]
    if not any(i.in_out == "OUTPUT" and str(i.socket_type) == "NodeSocketColor" for i in sockets_of(tree)):
        new_socket(tree, "Image", "OUTPUT", "NodeSocketColor")
    tree.nodes.new("NodeGroupOutput")
    return output_socket(tree)


def new_mix_node(tree: bpy.types.NodeTree, blend: str = "MIX") -> tuple[Any, Any, Any, Any, Any]:
    """A colour mix node as (node, factor socket, first colour, second colour, result). Only MIX clamps its factor."""
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
    """Input and output sockets of a group's interface."""
    assert group.interface is not None
    return [i for i in group.interface.items_tree if isinstance(i, bpy.types.NodeTreeInterfaceSocket)]


def new_socket(group: bpy.types.NodeTree, name: str, side: str, kind: str, text: str = "") -> Any:
    """Adds an input or output to a group. `side` is "INPUT" or "OUTPUT", `kind` the name of a socket class."""
    face: Any = group.interface  # the stubs only know sockets without a type
    return face.new_socket(name, in_out=side, socket_type=kind, description=text)


def new_math_node(tree: bpy.types.NodeTree, operation: str = "MULTIPLY") -> Any:
    """A Math node with operands inputs[0] and inputs[1]. Examples of `operation`: MULTIPLY, LESS_THAN."""
    node: Any = tree.nodes.new("ShaderNodeMath" if HAS_COMPOSITING_GROUP else "CompositorNodeMath")
    node.operation = operation
    return node


def new_over_node(tree: bpy.types.NodeTree) -> tuple[Any, Any, Any]:
    """An Alpha Over node for premultiplied images, as (node, background socket, foreground socket)."""
    node: Any = tree.nodes.new("CompositorNodeAlphaOver")
    pictures = [s for s in node.inputs if s.type == "RGBA"]
    return node, pictures[0], pictures[1]


def new_fit_node(tree: bpy.types.NodeTree, how: str = "Fit") -> Any:
    """A Scale node that scales inputs[0] to the render size. An input of that size is unchanged, bit by bit.

    Args:
        tree: node tree that gets the node.
        how: "Fit" shows the whole image and leaves bars. "Crop" fills the frame and cuts off the rest. "Stretch"
            changes the aspect ratio.
    """
    node: Any = tree.nodes.new("CompositorNodeScale")
    if HAS_COMPOSITING_GROUP:
        node.inputs["Type"].default_value = "Render Size"  # a menu socket's value is the English text of its item
    else:
        node.space = "RENDER_SIZE"
    set_fit(node, how)
    return node


def set_fit(fit: bpy.types.Node, how: str) -> None:
    """Changes the mode of a node from `new_fit_node`."""
    node: Any = fit
    if HAS_COMPOSITING_GROUP:
        node.inputs["Frame Type"].default_value = how
        beyond = "Extend" if how == "Crop" else "Clip"  # Clip would fade out the outermost pixels
        node.inputs["Extension X"].default_value = node.inputs["Extension Y"].default_value = beyond
    else:
        node.frame_method = how.upper()


def new_quotient(tree: bpy.types.NodeTree, picture: bpy.types.NodeSocket, value: bpy.types.NodeSocket) -> Any:
    """Socket of an image with its four channels divided by a value; 0 where the value is 0. Until 4.5."""
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
    """Socket of an image with another alpha and unchanged colours."""
    # Needed after a Mix node: until 5.1 it takes the first image's alpha, then a mix of both.
    node: Any = tree.nodes.new("CompositorNodeSetAlpha")
    if HAS_COMPOSITING_GROUP:
        node.inputs["Type"].default_value = "Replace Alpha"
    else:
        node.mode = "REPLACE_ALPHA"
    tree.links.new(picture, node.inputs["Image"])
    tree.links.new(alpha, node.inputs["Alpha"])
    return node.outputs[0]


def new_nearest_node(tree: bpy.types.NodeTree) -> Any:
    """A node that outputs the minimum of inputs[0] over a pixel and its eight neighbours."""
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
    """A Crop node that keeps the central `size` of inputs[0]. It removes `margin` (x, y) pixels from each side."""
    node: Any = tree.nodes.new("CompositorNodeCrop")
    (left, low), (width, height) = margin, size
    if "Width" in node.inputs:  # 4.5 on
        node.inputs["Alpha Crop"].default_value = False
        for name, value in (("X", left), ("Y", low), ("Width", width), ("Height", height)):
            node.inputs[name].default_value = value
    else:
        node.use_crop_size, node.relative = True, False
        node.min_x, node.max_x = left, left + width
        node.min_y, node.max_y = low + height, low  # Blender 4.2 expects the upper edge first
    return node


def new_look_up(
    tree: bpy.types.NodeTree, picture: bpy.types.NodeSocket, x: bpy.types.NodeSocket, y: bpy.types.NodeSocket
) -> Any:
    """Socket of an image sampled at coordinates x and y (0..1) with the nearest pixel's exact value."""
    place: Any = tree.nodes.new(f"{'Shader' if HAS_COMPOSITING_GROUP else 'Compositor'}NodeCombineXYZ")
    place.inputs["Z"].default_value = 1.0  # at 0 the node returns nothing
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
    """Sockets of a vector's first two components."""
    s, t, _ = separated(tree, vector)
    return s, t


def separated(tree: bpy.types.NodeTree, picture: bpy.types.NodeSocket) -> tuple[Any, Any, Any]:
    """Sockets of an image's red, green and blue channels, without clamping."""
    node: Any = tree.nodes.new(f"{'Shader' if HAS_COMPOSITING_GROUP else 'Compositor'}NodeSeparateXYZ")
    tree.links.new(picture, node.inputs[0])
    return node.outputs["X"], node.outputs["Y"], node.outputs["Z"]


def combined(tree: bpy.types.NodeTree, channels: Sequence[bpy.types.NodeSocket]) -> Any:
    """Socket of an opaque image made of red, green and blue channels."""
    node: Any = tree.nodes.new(f"{'Shader' if HAS_COMPOSITING_GROUP else 'Compositor'}NodeCombineXYZ")
    for socket, channel in zip(node.inputs, channels, strict=True):
        tree.links.new(channel, socket)
    return node.outputs[0]


def sized(tree: bpy.types.NodeTree, picture: bpy.types.NodeSocket, size: tuple[int, int]) -> Any:
    """Socket of an image scaled to a size in pixels. An image of that size is unchanged, bit by bit.

    Before 4.5 it is `picture` itself.
    """
    if not SCALES_EXACTLY:
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
    """An output path that Blender uses literally: braces are doubled where Blender expands templates."""
    return path.replace("{", "{{").replace("}", "}}") if HAS_PATH_TEMPLATES else path


def unescaped(path: str) -> str:
    """The path that `literal` made an output path of."""
    return path.replace("{{", "{").replace("}}", "}") if HAS_PATH_TEMPLATES else path


def declare_depth_write(info: gpu.types.GPUShaderCreateInfo) -> None:
    """Declares that a shader writes depth (4.4 on)."""
    if hasattr(info, "depth_write"):  # OpenGL, the earlier default, needs no declaration
        info.depth_write("ANY")


def strips_of(editor: bpy.types.SequenceEditor) -> Any:
    """Top-level strips of a sequence editor, which 4.4 renamed."""
    return getattr(editor, "strips" if hasattr(editor, "strips") else "sequences")


def set_png(settings: bpy.types.ImageFormatSettings) -> None:
    """Sets 8-bit RGB PNG as a scene's output format."""
    if hasattr(settings, "media_type"):
        settings.media_type = "IMAGE"
    settings.file_format = "PNG"
    settings.color_mode = "RGB"  # keeps holes black, RGBA would divide them by alpha
    settings.color_depth = "8"
    settings.compression = 15
    settings.color_management = "FOLLOW_SCENE"


# Bytes of an image file with the single pixel `PROBE`.
_PROBE = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 1\n" + bytes((*(int(256 * v) for v in PROBE), 128))
# Usual names of these spaces in colour configurations. They are tried first, and used if no space passes the test.
_LIKELY = {
    "linear": ("Linear Rec.709", "Linear Rec.709 (sRGB)", "lin_rec709", "Utility - Linear - sRGB", "Linear"),
    "srgb": ("sRGB", "sRGB - Texture", "sRGB Encoded Rec.709 (sRGB)", "Utility - sRGB - Texture", "sRGB EOTF"),
}
# Encoding -> colour space. Cached, because the configuration is fixed when Blender starts.
_spaces: dict[str | tuple[float, ...], str] = {}


def set_image_colour(image: bpy.types.Image, encoding: str | tuple[float, ...]) -> None:
    """Sets the colour space of an image file by its encoding, see `colour_space`."""
    name = colour_space(encoding)
    space = _space_of(image)
    if space.name != name:
        space.name = name


def _space_of(image: bpy.types.Image) -> Any:
    """The colour space settings of an image. The stubs list the names of one configuration only."""
    return image.colorspace_settings


def set_data(image: bpy.types.Image) -> None:
    """Marks an image's file as numbers, not colours."""
    _space_of(image).is_data = True


def knows_colour(encoding: str | tuple[float, ...]) -> bool:
    """True if `colour_space` finds a space for an encoding."""
    try:
        return bool(colour_space(encoding))
    except ValueError:
        return False


def colour_space(encoding: str | tuple[float, ...]) -> str:
    """Name of an encoding's colour space in Blender's colour configuration (its own, or that of $OCIO).

    The space is identified by its effect on a pixel. If none has the effect, a usual name of the encoding is used.
    Raises ValueError if there is none either.

    Args:
        encoding: "linear" (Rec.709 primaries), "srgb", or the linear Rec.709 light that the file value `contract.PROBE`
            encodes.
    """
    if encoding not in _spaces:
        likely = _LIKELY[encoding] if isinstance(encoding, str) else ()
        image = bpy.data.images.new("Splannequin Probe", 1, 1)
        try:
            space = _space_of(image)
            known = space.bl_rna.properties["name"].enum_items.keys()
            first = [n for n in (*likely, space.name) if n in known]  # the last one is the default of byte images
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
                f"Blender's OCIO colour configuration has no colour space for {what}. Start Blender without this "
                "configuration, or add the colour space to it."
            )
        _spaces[encoding] = name
    return _spaces[encoding]


def _reads_as(image: bpy.types.Image, name: str, wanted: Sequence[float]) -> bool:
    """True if an image reads as the wanted scene-linear colour in the named space. Sets the image's colour space."""
    _space_of(image).name = name
    near = 2e-3 * max(1.0, *(abs(value) for value in wanted))
    return max(abs(a - b) for a, b in zip(_first_pixel(image), wanted, strict=True)) < near


def _first_pixel(image: bpy.types.Image) -> tuple[float, float, float]:
    """Red, green and blue of an image's first pixel."""
    pixels: Any = image.pixels  # the stubs type them as a single float
    return pixels[0], pixels[1], pixels[2]


def usd_import_options() -> list[str]:
    """Names of the options of Blender's USD importer; empty in a Blender without one."""
    importers: Any = bpy.ops.wm
    try:
        return list(importers.usd_import.get_rna_type().properties.keys())
    except (AttributeError, KeyError):  # built without USD
        return []


def splat_import_option() -> str:
    """Name of the USD importer's option for Gaussian splats; empty if this Blender cannot import them."""
    names = [name for name in usd_import_options() if name.startswith("import_")]
    return next((name for name in names if "splat" in name or "particle_field" in name), "")
