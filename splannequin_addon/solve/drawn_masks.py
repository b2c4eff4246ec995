"""A mask drawn in Blender's Movie Clip or Image editor, rendered to pictures over the clip's frames for the backend."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
import uuid
from collections.abc import Generator
from pathlib import Path
from typing import Any

import bpy

from ...torch_backend import contract
from .. import compat
from ..access import present
from ..scene import same_footage, session
from ..shot import inventory, places


def render(mask: bpy.types.Mask, shot: Path, kind: str) -> Path:
    """`in_turns`, all at once."""
    turns = in_turns(mask.session_uid, mask.name, shot, kind)
    while True:
        try:
            next(turns)
        except StopIteration as end:
            return end.value


def in_turns(mask_uid: int, name: str, shot: Path, kind: str) -> Generator[tuple[int, int], None, Path]:
    """Renders a mask for every frame of an imported shot, a frame a turn; yields how many are done, and of how many.

    Returns the folder, SHOT/masks/KIND, with a picture for each. What it held stays until all of them are there.

    A frame of the scene is that of the clip which the Movie Clip editor shows there. Without a movie clip of the
    shot's footage in this file the scene's frames are the clip's own. Nothing of bpy is kept between two turns.

    JobError if the shot is not imported, the mask is gone, or a picture was not written.
    """
    folder = contract.ShotFolder(shot)
    try:
        listing = contract.read_json(folder.listing)
        numbers = [int(row["frame"]) for row in listing["frames"]]
        size = int(listing["width"]), int(listing["height"])
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise contract.JobError("There is no shot yet.", "Import the clip first.", contract.ExitCode.USAGE) from error
    into = folder.own(folder.drawn_masks(kind))
    into.mkdir(parents=True, exist_ok=True)
    _tidy(into.parent)
    partial = _beside(into, os.getpid())
    shift = _shift(folder)
    try:
        for done, number in enumerate(numbers, 1):
            _render_one(mask_uid, name, size, partial / contract.frame_file(number, contract.PICTURE), number + shift)
            yield done, len(numbers)
        for old in into.glob("*.png"):
            if old.stem.isdecimal():
                contract.remove_file(old)
        for made in sorted(partial.iterdir()):
            contract.replace_file(made, into / made.name)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return into


def _beside(into: Path, pid: int) -> Path:
    """Where a process makes the pictures of a folder: not in it, since what is killed leaves some. Its name says whose
    they are."""
    return into.with_name(f".{into.name}-{_here()}-{pid}-{int(contract.process_start(pid))}-{uuid.uuid4().hex[:8]}")


_BESIDE = re.compile(r"\.[a-z]+-([0-9a-f]{8})-([0-9]{1,10})-([0-9]{1,20})-[0-9a-f]{8}")


def _here() -> str:
    """Digest of this computer's name, for the name of a folder."""
    return hashlib.sha256(contract.computer_name().encode()).hexdigest()[:8]


def _tidy(masks: Path) -> None:
    """Removes what Blenders of this computer that were killed while they rendered a mask left in a shot."""
    if contract.is_link(masks):
        return
    left = [(folder, _BESIDE.fullmatch(folder.name)) for folder in masks.glob(".*")]
    for folder, match in left:
        if match and match[1] == _here() and not contract.runs_still(int(match[2]), float(match[3])):
            shutil.rmtree(folder, ignore_errors=True)  # a link is left alone


def _render_one(mask_uid: int, name: str, size: tuple[int, int], file: Path, frame: int) -> None:
    """A mask at a frame of the scene, as a picture. JobError if it is gone, or the picture was not written."""
    mask = session.of(bpy.data.masks, mask_uid)
    if mask is None:
        raise contract.JobError(f"The mask {name} is gone.", "Choose another mask.", contract.ExitCode.USAGE)
    with _stage(mask, size) as scene:
        scene.frame_set(frame)
        scene.render.filepath = str(file)
        bpy.ops.render.render(scene=scene.name, write_still=True)
    if not file.is_file():
        raise contract.JobError(
            f"The mask {name} was not written to {file}.",
            "Make room, or see to it that the shot's folder can be written.",
            contract.ExitCode.DISK,
        )


@contextlib.contextmanager
def _stage(mask: bpy.types.Mask, size: tuple[int, int]) -> Generator[bpy.types.Scene]:
    """A scene of its own, gone afterwards, whose compositor shows the mask alone."""
    scene = bpy.data.scenes.new("Splannequin Mask")
    camera: Any = bpy.data.objects.new("Splannequin Mask", bpy.data.cameras.new("Splannequin Mask"))
    try:
        scene.collection.objects.link(camera)
        scene.camera = camera  # nothing is rendered through it, but Blender asks for one
        tree = compat.new_compositor_tree(scene, "Splannequin Mask")
        compat.enable_compositor(scene)
        node: Any = tree.nodes.new("CompositorNodeMask")
        node.mask = mask
        tree.links.new(node.outputs[0], present(compat.output_socket(tree)))
        render = scene.render
        render.resolution_x, render.resolution_y, render.resolution_percentage = *size, 100
        compat.set_png(render.image_settings)
        render.dither_intensity = 0.0
        with contextlib.suppress(TypeError):  # an OCIO configuration of the artist's own may have no such view
            # Half of the mask is half of the picture's values, which is where the solve cuts: AgX makes 0.2 of it half.
            view: Any = present(scene.view_settings)
            view.view_transform = "Raw"
        yield scene
    finally:
        data = camera.data
        compat.drop_compositor_tree(scene)
        bpy.data.objects.remove(camera)
        bpy.data.cameras.remove(data)
        bpy.data.scenes.remove(scene)


def _shift(folder: contract.ShotFolder) -> int:
    """What to add to a frame number of the shot to get the scene's frame at which its movie clip shows it."""
    state = inventory.read(folder.root)
    named = (str(state.info.get("source", "")), places.source_of(state))  # where it was, and where it is
    sources = [Path(path) for path in named if os.path.isabs(path)]
    shown = next((clip for clip in bpy.data.movieclips if same_footage.shows(clip, sources)), None)
    if shown is None:
        return 0
    return int(shown.frame_start) - same_footage.first_number(shown) - state.shift
