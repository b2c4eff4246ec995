"""Renders a mask drawn in Blender's Movie Clip or Image editor to an image per frame of the clip, for the backend."""

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
    """Runs `in_turns` without interruption."""
    turns = in_turns(mask.session_uid, mask.name, shot, kind)
    while True:
        try:
            next(turns)
        except StopIteration as end:
            return end.value


def in_turns(mask_uid: int, name: str, shot: Path, kind: str) -> Generator[tuple[int, int], None, Path]:
    """Renders a mask for every frame of an imported shot, one frame per step. Yields (frames done, total frames).

    Returns the folder, SHOT/masks/KIND, with one image per frame. Its earlier content stays until all images are
    rendered. The Movie Clip editor defines which clip frame a scene frame shows. If this file has no movie clip of the
    shot's footage, scene frames equal clip frames. Keeps no bpy data between steps. Raises JobError if the shot is not
    imported, the mask no longer exists, or an image was not written.
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
    partial = _temporary_folder(into, os.getpid())
    shift = _shift(folder)
    try:
        for done, number in enumerate(numbers, 1):
            _render_one(mask_uid, name, size, partial / contract.frame_file(number, contract.PICTURE), number + shift)
            yield done, len(numbers)
        for old in into.glob("*.png"):
            if old.stem.isdecimal():
                contract.remove_file(old)
        for image in sorted(partial.iterdir()):
            contract.replace_file(image, into / image.name)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return into


def _temporary_folder(into: Path, pid: int) -> Path:
    """Temporary folder next to `into` for a process's images. A killed process leaves it behind; its name identifies
    the process."""
    return into.with_name(
        f".{into.name}-{_computer_digest()}-{pid}-{int(contract.process_start(pid))}-{uuid.uuid4().hex[:8]}"
    )


_TEMPORARY_NAME = re.compile(r"\.[a-z]+-([0-9a-f]{8})-([0-9]{1,10})-([0-9]{1,20})-[0-9a-f]{8}")


def _computer_digest() -> str:
    """Digest of this computer's name, for folder names."""
    return hashlib.sha256(contract.computer_name().encode()).hexdigest()[:8]


def _tidy(masks: Path) -> None:
    """Removes temporary folders in a shot that were left by killed Blender processes of this computer."""
    if contract.is_link(masks):
        return
    left = [(folder, _TEMPORARY_NAME.fullmatch(folder.name)) for folder in masks.glob(".*")]
    for folder, match in left:
        if match and match[1] == _computer_digest() and not contract.runs_still(int(match[2]), float(match[3])):
            shutil.rmtree(folder, ignore_errors=True)  # does not follow links


def _render_one(mask_uid: int, name: str, size: tuple[int, int], file: Path, frame: int) -> None:
    """Renders a mask at a scene frame to an image file. Raises JobError if the mask no longer exists or the file is not
    written."""
    mask = session.of(bpy.data.masks, mask_uid)
    if mask is None:
        raise contract.JobError(f"The mask {name} no longer exists.", "Choose another mask.", contract.ExitCode.USAGE)
    with _stage(mask, size) as scene:
        scene.frame_set(frame)
        scene.render.filepath = compat.literal(str(file))
        bpy.ops.render.render(scene=scene.name, write_still=True)
    if not file.is_file():
        raise contract.JobError(
            f"The mask {name} was not written to {file}.",
            "Free disk space, or make sure that the shot folder is writable.",
            contract.ExitCode.DISK,
        )


@contextlib.contextmanager
def _stage(mask: bpy.types.Mask, size: tuple[int, int]) -> Generator[bpy.types.Scene]:
    """Context manager with a temporary scene whose compositor shows only the mask."""
    scene = bpy.data.scenes.new("Splannequin Mask")
    camera: Any = bpy.data.objects.new("Splannequin Mask", bpy.data.cameras.new("Splannequin Mask"))
    try:
        scene.collection.objects.link(camera)
        scene.camera = camera  # Blender requires a camera, although it renders nothing
        tree = compat.new_compositor_tree(scene, "Splannequin Mask")
        compat.enable_compositor(scene)
        node: Any = tree.nodes.new("CompositorNodeMask")
        node.mask = mask
        tree.links.new(node.outputs[0], present(compat.output_socket(tree)))
        render = scene.render
        render.resolution_x, render.resolution_y, render.resolution_percentage = *size, 100
        compat.set_png(render.image_settings)
        render.dither_intensity = 0.0
        with contextlib.suppress(TypeError):  # a custom OCIO configuration may lack this view
            # A mask value of 0.5 must stay 0.5, which is the solve's threshold. AgX would map 0.2 to 0.5.
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
    """Offset from a frame number of the shot to the scene frame at which its movie clip shows it."""
    state = inventory.read(folder.root)
    named = (str(state.info.get("source", "")), places.source_of(state))  # stored and current location
    sources = [Path(path) for path in named if os.path.isabs(path)]
    shown = next((clip for clip in bpy.data.movieclips if same_footage.shows(clip, sources)), None)
    if shown is None:
        return 0
    return int(shown.frame_start) - same_footage.first_number(shown) - state.shift
