"""Image sequences as data-blocks. Ours are tagged, reused by path, and can be loaded ahead of use."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from .. import compat
from ..access import size_of
from . import paths
from .ownership import TAG

Encoding = str | tuple[float, ...]
"""Encoding of a file's values, in the form that `compat.colour_space` accepts."""
# Files that `read` and `read_numbers` have just loaded. The next load function uses them without a reload.
_prefetched: set[str] = set()


def clear_prefetched() -> None:
    """Clears the record of images loaded ahead. Call it when another file is loaded."""
    _prefetched.clear()


def read(
    path: Path, name: str, encoding: Encoding, first: int, last: int, opaque: bool = False, shift: int = 0
) -> None:
    """Loads an image of a sequence with the frames `first` to `last`, by showing it in a temporary node.

    `opaque`: see `load_sequence`; `shift`: see `show_sequence`.
    """
    _prefetched.discard(os.path.abspath(path))
    shown_size(load_sequence(path, name, encoding, opaque), first, last, shift)
    _prefetched.add(os.path.abspath(path))


def read_numbers(path: Path, name: str) -> None:
    """Loads an image of numbers, as `read` does for colours."""
    _prefetched.discard(os.path.abspath(path))
    size_of(load_numbers(path, name))
    _prefetched.add(os.path.abspath(path))


def shown_size(image: bpy.types.Image, first: int, last: int, shift: int = 0) -> tuple[int, int]:
    """Width and height of a sequence's images in a node set up by `show_sequence`; (0, 0) for multilayer images."""
    # Blender knows no size of a sequence that no node shows.
    reader = bpy.data.node_groups.new("Splannequin Reader", "CompositorNodeTree")
    try:
        show_sequence(reader.nodes.new("CompositorNodeImage"), image, first, last, shift)
        return size_of(image)
    finally:
        bpy.data.node_groups.remove(reader)


def find(path: str) -> bpy.types.Image | None:
    """Our image data-block of the file with this absolute path, or None.

    Linked images do not count: their relative paths start at their own file, and they are read-only.
    """
    ours = (image for image in bpy.data.images if image.get(TAG) and not image.library)
    return next((image for image in ours if paths.same(paths.absolute(image.filepath), path)), None)


def load_sequence(path: Path, name: str, encoding: Encoding, opaque: bool = False) -> bpy.types.Image:
    """An image sequence or a video as a data-block, reused by path.

    With `opaque`, the file's alpha is ignored and its colours are used unchanged. Raises ValueError if the colour
    configuration lacks the encoding, and RuntimeError if Blender cannot read the file.
    """
    wanted = os.path.abspath(path)
    known = find(wanted)
    if known is not None:
        compat.set_image_colour(known, encoding)  # another import may have used another encoding
        _make_opaque(known, opaque)
        if wanted not in _prefetched:
            known.reload()
        _prefetched.discard(wanted)
        return known
    compat.colour_space(encoding)  # fails before anything is created if the configuration lacks the space
    image = bpy.data.images.load(contract.regular_file(wanted, None))
    image.name = name
    if image.source != "MOVIE":
        image.source = "SEQUENCE"
    image[TAG] = True
    compat.set_image_colour(image, encoding)
    _make_opaque(image, opaque)
    image.filepath = paths.blend_path(path)
    return image


def _make_opaque(image: bpy.types.Image, opaque: bool) -> None:
    """Makes Blender ignore an image's alpha."""
    if opaque and image.alpha_mode != "NONE":  # each assignment loads the image again
        image.alpha_mode = "NONE"


def load_numbers(path: Path, name: str) -> bpy.types.Image:
    """An image of numbers instead of colours as a data-block, reused by path."""
    wanted = os.path.abspath(path)
    known = find(wanted)
    if known is not None:
        if wanted not in _prefetched:
            known.reload()
        _prefetched.discard(wanted)
        return known
    image = bpy.data.images.load(contract.regular_file(wanted))
    image.name = name
    image[TAG] = True
    compat.set_data(image)
    image.filepath = paths.blend_path(path)
    return image


def relative_images() -> None:
    """Makes the paths of our images relative to the .blend, once it has a path."""
    for image in bpy.data.images:
        if image.get(TAG) and image.filepath and not image.library:
            image.filepath = paths.blend_path(Path(bpy.path.abspath(image.filepath)))


def show_sequence(user: Any, image: bpy.types.Image, first: int, last: int, shift: int = 0) -> None:
    """Makes an Image node (or an image user) show file n - `shift` at scene frame n, from `first` to `last`."""
    if hasattr(user, "image"):
        user.image = image
    # Blender shows file `frame - frame_start + 1 + frame_offset`.
    user.frame_duration = last - first + 1
    user.frame_start = first
    user.frame_offset = first - shift - 1
    user.use_auto_refresh = True
