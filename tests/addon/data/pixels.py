"""Reads pictures as stored, and renders frames through the compositor."""

from pathlib import Path

import bpy
import numpy as np


def read(path: str | Path) -> np.ndarray:
    """[H, W, channels] float32: stored values of a picture, top row first."""
    image = bpy.data.images.load(str(path))
    try:
        image.colorspace_settings.is_data = True
        image.alpha_mode = "CHANNEL_PACKED"
        width, height = image.size
        return np.array(image.pixels[:], np.float32).reshape(height, width, -1)[::-1]
    finally:
        bpy.data.images.remove(image)


def glow(colour: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)) -> bpy.types.Material:
    """New material that emits light of one colour."""
    material = bpy.data.materials.new("glow")
    material.use_nodes = True
    material.node_tree.nodes.clear()
    shine, end = (material.node_tree.nodes.new(f"ShaderNode{kind}") for kind in ("Emission", "OutputMaterial"))
    shine.inputs["Color"].default_value = colour
    material.node_tree.links.new(shine.outputs[0], end.inputs["Surface"])
    return material


def set_format(scene: bpy.types.Scene, kind: str) -> None:
    """Set the format of the scene's render; EXRs have 32 bits."""
    settings = scene.render.image_settings
    if hasattr(settings, "media_type"):
        settings.media_type = {"FFMPEG": "VIDEO", "OPEN_EXR_MULTILAYER": "MULTI_LAYER_IMAGE"}.get(kind, "IMAGE")
    settings.file_format = kind
    if kind.startswith("OPEN_EXR"):
        settings.color_depth = "32"
    if kind == "OPEN_EXR":
        settings.color_mode = "RGBA"


def render(scene: bpy.types.Scene, folder: Path, frame: int = 6, size: tuple[int, int] = (56, 42)) -> np.ndarray:
    """[H, W, 4] float32: a frame rendered through the compositor, top row first. The default size is
    `make_detail`'s."""
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = *size, 100
    set_format(scene, "OPEN_EXR")
    scene.render.filepath = str(folder / f"{frame}.exr")
    scene.frame_set(frame)
    bpy.ops.render.render(write_still=True)
    return read(scene.render.filepath)
