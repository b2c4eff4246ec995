"""Picture sequences as data-blocks: ours have a mark, are found again by their path, and can be read ahead."""

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
"""How a file's numbers are meant, as `compat.colour_space` has it."""
_ahead: set[str] = set()
"""Files that `read` and `read_numbers` have just had read: the next time that they are loaded they are taken as they
are."""


def forget_ahead() -> None:
    """Drops what is known of pictures read ahead: another file has others."""
    _ahead.clear()


def read(
    path: Path, name: str, encoding: Encoding, first: int, last: int, opaque: bool = False, shift: int = 0
) -> None:
    """Has a picture of a sequence read, whose frames go from `first` to `last`: a node does it for the frame that it
    shows. `opaque`: see `load_sequence`; `shift`: see `show_sequence`."""
    _ahead.discard(os.path.abspath(path))
    shown_size(load_sequence(path, name, encoding, opaque), first, last, shift)
    _ahead.add(os.path.abspath(path))


def read_numbers(path: Path, name: str) -> None:
    """Has a picture of numbers read, as `read` does."""
    _ahead.discard(os.path.abspath(path))
    size_of(load_numbers(path, name))
    _ahead.add(os.path.abspath(path))


def shown_size(image: bpy.types.Image, first: int, last: int, shift: int = 0) -> tuple[int, int]:
    """Width and height of the pictures of a sequence, which `show_sequence` would show so, as a node shows them.

    (0, 0) of those with several layers. A sequence that no node shows has none.
    """
    reader = bpy.data.node_groups.new("Splannequin Reader", "CompositorNodeTree")
    try:
        show_sequence(reader.nodes.new("CompositorNodeImage"), image, first, last, shift)
        return size_of(image)
    finally:
        bpy.data.node_groups.remove(reader)


def load_sequence(path: Path, name: str, encoding: Encoding, opaque: bool = False) -> bpy.types.Image:
    """An image sequence or a video as a data-block, reused by path.

    `opaque`: its colours are taken as they stand in the file, whatever its alpha is.

    ValueError if the colour configuration has no such encoding, RuntimeError if Blender cannot read the file.
    """
    wanted = os.path.abspath(path)
    for image in bpy.data.images:
        if image.get(TAG) and paths.same(paths.absolute(image.filepath), wanted):
            compat.set_image_colour(image, encoding)  # another import may have made it of other light
            _make_opaque(image, opaque)
            if wanted not in _ahead:
                image.reload()
            _ahead.discard(wanted)
            return image
    compat.colour_space(encoding)  # before anything is made: a configuration may have none
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
    """Sets it once and at first: a change has Blender read the picture again."""
    if opaque and image.alpha_mode != "NONE":
        image.alpha_mode = "NONE"


def load_numbers(path: Path, name: str) -> bpy.types.Image:
    """A picture of numbers, not colours, as a data-block, reused by path."""
    wanted = os.path.abspath(path)
    for known in bpy.data.images:
        if known.get(TAG) and paths.same(paths.absolute(known.filepath), wanted):
            if wanted not in _ahead:
                known.reload()
            _ahead.discard(wanted)
            return known
    image = bpy.data.images.load(contract.regular_file(wanted))
    image.name = name
    image[TAG] = True
    compat.set_data(image)
    image.filepath = paths.blend_path(path)
    return image


def relative_images() -> None:
    """Makes the paths of our images relative to the .blend, once it has a place."""
    for image in bpy.data.images:
        if image.get(TAG) and image.filepath:
            image.filepath = paths.blend_path(Path(bpy.path.abspath(image.filepath)))


def show_sequence(user: Any, image: bpy.types.Image, first: int, last: int, shift: int = 0) -> None:
    """Makes an Image node (or an image user) show file n - `shift` at scene frame n, from `first` to `last`."""
    if hasattr(user, "image"):
        user.image = image
    user.frame_duration = last - first + 1
    user.frame_start = first
    user.frame_offset = first - shift - 1
    user.use_auto_refresh = True
