"""Picture sequences as data-blocks: ours have a mark, are found again by their path, and can be read ahead."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import bpy

from .. import compat
from . import paths
from .ownership import TAG

_ahead: set[str] = set()
"""Files that `read_ahead` has just had read: the next `load_sequence` takes them as they are."""


def forget_ahead() -> None:
    """Drops what is known of pictures read ahead: another file has others."""
    _ahead.clear()


def read(path: Path, name: str, encoding: str, first: int, last: int) -> None:
    """Has a picture of a sequence read, whose frames go from `first` to `last`: a node does it for the frame that it
    shows."""
    _ahead.discard(os.path.abspath(path))
    image = load_sequence(path, name, encoding)
    reader = bpy.data.node_groups.new("Splannequin Reader", "CompositorNodeTree")
    try:
        show_sequence(reader.nodes.new("CompositorNodeImage"), image, first, last)
    finally:
        bpy.data.node_groups.remove(reader)
    _ahead.add(os.path.abspath(path))


def load_sequence(path: Path, name: str, encoding: str) -> bpy.types.Image:
    """An image sequence as a data-block, reused by path; `encoding` is "linear" or "srgb"."""
    wanted = os.path.abspath(path)
    for image in bpy.data.images:
        if image.get(TAG) and os.path.abspath(bpy.path.abspath(image.filepath)) == wanted:
            if wanted not in _ahead:
                image.reload()
            _ahead.discard(wanted)
            return image
    compat.colour_space(encoding)  # before anything is made: a configuration may have none
    image = bpy.data.images.load(wanted)
    image.name = name
    image.source = "SEQUENCE"
    image[TAG] = True
    compat.set_image_colour(image, encoding)
    image.filepath = paths.blend_path(path)
    return image


def relative_images() -> None:
    """Makes the paths of our images relative to the .blend, once it has a place."""
    for image in bpy.data.images:
        if image.get(TAG) and image.filepath:
            image.filepath = paths.blend_path(Path(bpy.path.abspath(image.filepath)))


def show_sequence(user: Any, image: bpy.types.Image, first: int, last: int) -> None:
    """Makes an Image node (or an image user) show file n at scene frame n."""
    if hasattr(user, "image"):
        user.image = image
    user.frame_duration = last - first + 1
    user.frame_start = first
    user.frame_offset = first - 1
    user.use_auto_refresh = True
