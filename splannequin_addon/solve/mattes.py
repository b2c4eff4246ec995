"""The motion matte in Blender: the solve's result, shown in the Image Editor, with the artist's paint.

Black is still, white moves, grey is unknown. Saved paint is in the shot, SHOT/motion_paint/NNNNNN.png, and takes
precedence over the results of this and later solves. Unsaved paint is kept in the .blend, in packed images.
"""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from bpy.app.handlers import persistent

from ...torch_backend import contract
from ..access import camera_of, pixels_of, size_of
from ..scene import numbered, paths, sequences
from ..scene.ownership import MATTE_SHOT, TAG
from ..shot import inventory, scene_objects
from . import motion_overlay

# Property of a painted image: frame number. `MATTE_SHOT` is the property for its shot.
_FRAME = "splannequin_matte"
# Property of a painted image: digest of the frame's image, to detect that another clip was imported since.
_PICTURE = "splannequin_picture"
MOVING_TINT = (255, 64, 0)
"""Tint of moving pixels, sRGB."""
UNKNOWN_TINT = (64, 128, 255)
"""Tint of unknown pixels, sRGB."""
# Alpha of moving pixels, 0..255, so that the plate remains visible.
_OPAQUE = 150
# Alpha of unknown pixels, 0..255.
_FAINT = 70


def found_file(shot: Path, frame: int) -> Path:
    """Path of the solve's matte of a frame."""
    return contract.ShotFolder(shot).matte(frame)


def painted_file(shot: Path, frame: int) -> Path:
    """Path of the painted matte of a frame."""
    return contract.ShotFolder(shot).painted_matte(frame)


def load_sequence(shot: Path) -> tuple[Any, int, int]:
    """(image sequence of the solve's mattes, first frame, last frame). Raises JobError without mattes."""
    frames = sorted(int(p.stem) for p in contract.ShotFolder(shot).motion.glob("*.png") if p.stem.isdecimal())
    if not frames:
        raise no_matte(shot)
    image = sequences.load_sequence(found_file(shot, frames[0]), f"Motion {scene_objects.name_of(shot)}", "srgb")
    return image, frames[0], frames[-1]


def no_matte(shot: Path) -> contract.JobError:
    """The error for a shot that was solved before mattes existed."""
    message = f"{scene_objects.name_of(shot)} has no motion matte."
    return contract.JobError(message, "Solve the camera again to create it.", contract.ExitCode.USAGE)


def paint_image(shot: Path, frame: int) -> bpy.types.Image:
    """An image to paint the matte of a frame on: the existing one, else a copy of the painted matte or the solve's.

    Raises JobError if the frame has no matte, or if a file cannot be read.
    """
    image = find_image(shot, frame)
    if image is not None:
        return image
    pixels = matte_pixels(shot, frame)
    height, width = pixels.shape[:2]
    image = next((i for i in bpy.data.images if _is_of(i, shot, frame)), None)
    if image is None:
        image = bpy.data.images.new(f"Motion {scene_objects.name_of(shot)} {frame}", width, height, alpha=True)
        image[_FRAME], image[MATTE_SHOT] = frame, paths.blend_path(shot)
        image[_PICTURE] = inventory.picture_of(shot, frame)
    _fill(image, pixels)
    return image


def matte_pixels(shot: Path, frame: int) -> np.ndarray:
    """The matte of a frame from the shot's files, [H, W, 4] float32, bottom row first. Raises JobError as
    `paint_image`."""
    path = next((p for p in (painted_file(shot, frame), found_file(shot, frame)) if p.is_file()), None)
    if path is None:
        raise contract.JobError(
            f"Frame {frame} of {scene_objects.name_of(shot)} has no motion matte.",
            "Go to a frame of the clip, or solve the camera again.",
            contract.ExitCode.USAGE,
        )
    pixels = _pixels(path)
    if path == painted_file(shot, frame) and found_file(shot, frame).is_file() and (pixels[..., 3] <= 0.5).any():
        below = _pixels(found_file(shot, frame))
        if below.shape == pixels.shape:
            pixels = np.where(pixels[..., 3:] > 0.5, pixels, below)
    pixels[..., 3] = 1.0
    return pixels


def _fill(image: bpy.types.Image, pixels: np.ndarray) -> None:
    """Sets and packs an image's pixels."""
    height, width = pixels.shape[:2]
    if image.source != "GENERATED":
        image.source = "GENERATED"
    if size_of(image) != (width, height):
        image.generated_width, image.generated_height = width, height
    pixels_of(image).foreach_set(pixels.ravel())
    image.update()
    image.pack()  # otherwise Blender does not save the pixels of a generated image


def find_image(shot: Path, frame: int) -> bpy.types.Image | None:
    """The image with the painted matte of a frame, or None if this file has none with pixels."""
    return next((i for i in bpy.data.images if _is_of(i, shot, frame) and not _has_lost_paint(i)), None)


def _is_of(image: bpy.types.Image, shot: Path, frame: int) -> bool:
    # Images of earlier files have no digest and are accepted.
    return _of(image) == (os.path.abspath(shot), frame) and image.get(_PICTURE) in (
        None,
        inventory.picture_of(shot, frame),
    )


def _has_lost_paint(image: bpy.types.Image) -> bool:
    """True if an image has lost its paint, and is black or empty.

    The cause is a missing file, or an earlier version that saved the image without packing it.
    """
    return image.source == "GENERATED" or not all(size_of(image))


def _of(image: bpy.types.Image) -> tuple[str, int] | None:
    """(shot folder, frame) of an image with a painted matte; None for other images and for linked ones, which are
    read-only."""
    frame, folder = image.get(_FRAME), image.get(MATTE_SHOT)
    if image.library or not isinstance(frame, int) or not isinstance(folder, str):
        return None
    return os.path.abspath(bpy.path.abspath(folder)), frame


def save_paint(image: bpy.types.Image) -> Path:
    """Writes an image of `paint_image` into its shot atomically, and makes it an image of that file.

    Raises JobError if it cannot be written.
    """
    known = _of(image)
    if known is None:
        message = f"{image.name} is not a motion matte."
        raise contract.JobError(message, "Press Paint Motion first.", contract.ExitCode.USAGE)
    path = painted_file(Path(known[0]), known[1])
    width, height = size_of(image)
    pixels = np.empty(width * height * image.channels, np.float32)
    pixels_of(image).foreach_get(pixels)
    data = packed(pixels.reshape(height, width, image.channels)[::-1])
    try:
        write(path, data)
    except OSError as error:
        raise inventory.unwritable(
            path, error, "Free disk space, or make sure that the shot folder is writable."
        ) from error
    image.filepath_raw, image.file_format = paths.blend_path(path), "PNG"
    image.source = "FILE"
    if image.packed_file is not None:
        image.unpack(method="REMOVE")  # otherwise Blender would read the packed data again
    image.reload()
    return path


def clear_paint(shot: Path, frame: int) -> bool:
    """Deletes the painted matte of a frame from the shot. True if there was one. The image stays in the file."""
    path = painted_file(shot, frame)
    if contract.is_link(path.parent) or not path.is_file():
        return False
    path.unlink()
    return True


def packed(pixels: np.ndarray) -> bytes:
    """PNG data of [H, W, C] float32 in 0..1, top row first: 8-bit grey, with alpha if any pixel is transparent."""
    channels = pixels.shape[2]
    planes = [pixels[..., : 3 if channels >= 3 else 1].mean(2)]
    if channels in (2, 4) and (pixels[..., -1] < 1.0).any():
        planes.append(pixels[..., -1])
    return png(np.rint(np.clip(np.stack(planes, -1), 0.0, 1.0) * 255.0).astype(np.uint8))


def png(pixels: np.ndarray) -> bytes:
    """PNG data of [H, W, C] uint8, top row first: grey, grey and alpha, RGB, or RGB and alpha."""
    height, width, channels = pixels.shape
    rows = np.concatenate([np.zeros((height, 1), np.uint8), pixels.reshape(height, -1)], axis=1)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, {1: 0, 2: 4, 3: 2, 4: 6}[channels], 0, 0, 0)
    body = zlib.compress(rows.tobytes(), 2)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


def _pixels(path: Path) -> np.ndarray:
    """Stored values of an image file, [H, W, 4] float32, bottom row first. Raises JobError if it cannot be read."""
    announced = contract.png_size(path)
    if announced[0] * announced[1] > contract.MOST_PIXELS:  # Blender would try to allocate all of it
        message = f"{path} has {announced[0]} x {announced[1]} pixels according to its header."
        raise contract.JobError(message, "Remove or shrink it.", contract.ExitCode.USAGE)
    image = bpy.data.images.load(contract.regular_file(path))
    try:
        image.alpha_mode = "CHANNEL_PACKED"  # no premultiplication
        width, height = size_of(image)
        if not (width and height):
            raise contract.JobError(f"{path} cannot be read.", "Remove it.", contract.ExitCode.USAGE)
        pixels = np.empty(width * height * 4, np.float32)
        pixels_of(image).foreach_get(pixels)
        return pixels.reshape(height, width, 4)
    finally:
        bpy.data.images.remove(image)


def write(path: Path, data: bytes) -> None:
    """Writes a file atomically. Raises OSError, also if its folder is a link."""
    if contract.is_link(path.parent):
        raise NotADirectoryError(20, "its folder is a link", str(path))
    contract.write_atomic(path, data, parents=False)


# The rest of this module shows mattes over the plate. A matte is grey without alpha, so it is also written as a file
# with tint and alpha, and again after it has changed.


def overlay_folder(shot: Path) -> Path:
    """Folder of a shot's tinted frames."""
    return contract.ShotFolder(shot).motion / "overlay"


def tint_in_turns(shot: Path) -> Iterator[tuple[int, int]]:
    """Writes tinted frames that are missing or older than their mattes. Yields (frames done, total frames).

    Raises JobError if the shot has no mattes, or if a file cannot be read or written.
    """
    numbers = numbered.frame_numbers(contract.ShotFolder(shot).motion, contract.PICTURE)
    if not numbers:
        raise no_matte(shot)
    folder = overlay_folder(shot)
    stale = [n for n in numbers if not _is_newer(folder / contract.frame_file(n, contract.PICTURE), shot, n)]
    for done, number in enumerate(stale):
        yield done, len(stale)
        try:
            if contract.is_link(folder.parent):
                raise NotADirectoryError(20, "its folder is a link", str(folder))
            folder.mkdir(exist_ok=True)
            data = png(tinted(matte_pixels(shot, number)[::-1, :, 0]))
            write(folder / contract.frame_file(number, contract.PICTURE), data)
        except OSError as error:
            raise inventory.unwritable(
                folder, error, "Free disk space, or make sure that the shot folder is writable."
            ) from error


def tinted(matte: np.ndarray) -> np.ndarray:
    """[H, W, 4] uint8 tint and alpha of a matte [H, W] in 0..1: moving above 0.75, unknown above 0.35, otherwise
    still."""
    moves, unknown = matte > 0.75, (matte > 0.35) & (matte <= 0.75)
    picture = np.zeros((*matte.shape, 4), np.uint8)
    picture[..., :3] = np.where(unknown[..., None], np.array(UNKNOWN_TINT, np.uint8), np.array(MOVING_TINT, np.uint8))
    picture[..., 3] = np.where(moves, _OPAQUE, np.where(unknown, _FAINT, 0))
    return picture


def show_over_plate(scene: bpy.types.Scene, shot: Path) -> list[str]:
    """Shows the tinted frames over the plate in the view of the shot's camera. Returns the changes as sentences.

    Raises JobError without frames or camera.
    """
    camera = scene_objects.part(scene, shot, "camera")
    folder = overlay_folder(shot)
    numbers = numbered.frame_numbers(folder, contract.PICTURE)
    if camera is None:
        raise contract.JobError("The solve is not in this scene.", "Load the camera first.", contract.ExitCode.USAGE)
    if not numbers:
        raise no_matte(shot)
    data = camera_of(camera)
    path = folder / contract.frame_file(numbers[0], contract.PICTURE)
    image = sequences.load_sequence(path, f"Motion over {scene_objects.name_of(shot)}", "srgb")
    image[TAG] = motion_overlay.OVERLAY
    if motion_overlay.find(scene, shot) is None:
        motion_overlay.bare_plate(data, image)
    background = motion_overlay.find(scene, shot) or data.background_images.new()
    background.image = image
    sequences.show_sequence(background.image_user, image, numbers[0], numbers[-1])
    background.frame_method, background.display_depth, background.alpha = "FIT", "FRONT", 1.0
    data.show_background_images = True
    return ["The motion is tinted over the plate: orange moves, blue is unknown."]


def _is_newer(file: Path, shot: Path, number: int) -> bool:
    """True if a tinted frame was written after its mattes (the solve's and the painted one)."""
    sources = [found_file(shot, number), painted_file(shot, number)]
    try:
        return file.stat().st_mtime_ns > max(p.stat().st_mtime_ns for p in sources if p.is_file())
    except (OSError, ValueError):
        return False


@persistent
def _before_save(*_: object) -> None:
    """Handler: packs images that were painted on since the last save."""
    for image in bpy.data.images:
        if _of(image) is not None and image.is_dirty:
            with contextlib.suppress(RuntimeError):  # saving must not fail because of it
                image.pack()


@persistent
def _after_load(*_: object) -> None:
    """Handler: an image from an older file shows the matte of its shot instead of black."""
    for image in bpy.data.images:
        known = _of(image)
        if known is not None and image.source == "GENERATED":
            with contextlib.suppress(contract.JobError, RuntimeError):  # Paint Motion reports the error
                _fill(image, matte_pixels(Path(known[0]), known[1]))


def register() -> None:
    """Registers the handlers for save and load."""
    bpy.app.handlers.save_pre.append(_before_save)
    bpy.app.handlers.load_post.append(_after_load)


def unregister() -> None:
    """Undoes `register`."""
    bpy.app.handlers.load_post.remove(_after_load)
    bpy.app.handlers.save_pre.remove(_before_save)
