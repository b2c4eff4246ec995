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


def render(scene: bpy.types.Scene, folder: Path, frame: int = 6, size: tuple[int, int] = (56, 42)) -> np.ndarray:
    """[H, W, 4] float32: a frame rendered through the compositor, top row first. The default size is
    `make_detail`'s."""
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = *size, 100
    settings = scene.render.image_settings
    if hasattr(settings, "media_type"):
        settings.media_type = "IMAGE"
    settings.file_format, settings.color_depth, settings.color_mode = "OPEN_EXR", "32", "RGBA"
    scene.render.filepath = str(folder / f"{frame}.exr")
    scene.frame_set(frame)
    bpy.ops.render.render(write_still=True)
    return read(scene.render.filepath)
