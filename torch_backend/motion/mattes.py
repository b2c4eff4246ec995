"""The motion mattes of a shot: each labels the pixels of a delivered frame as still, unknown or moving.

Files: SHOT/solve/motion/NNNNNN.png, grey, of the working frames' size, with values STILL, UNKNOWN or MOVING.
motion.json in that folder records the cameras of the mattes. Mattes of an earlier solve and their points of still
surfaces (`surface`) are not read. Painted mattes, SHOT/motion_paint/NNNNNN.png, take precedence over detected ones; a
solve does not change them.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from ..contract import (
    LONGEST_PICTURE,
    MOST_PIXELS,
    MOTION_FILE,
    MOTION_UNFINISHED_FILE,
    PAINTED_FOLDER,
    ExitCode,
    JobError,
    open_regular,
    png_size,
    read_json,
)
from ..footage.images import is_whole_png, too_large
from ..sfm.masks import masks_key, write_grey
from ..shot import Shot, content_key
from .flow import FlowConfig
from .surface import NO_SURFACE, SurfacePoints, read_surface

STILL, UNKNOWN, MOVING = 0, 128, 255
"""Values of a matte. Readers round other values to the nearest of these."""
MOTION_VERSION = 7
PAINTED = PAINTED_FOLDER
"""Folder of painted mattes in the shot's folder."""
_RECORD, _UNFINISHED = MOTION_FILE, MOTION_UNFINISHED_FILE
_LABELS = np.array([STILL, UNKNOWN, MOVING], np.uint8)


def solve_key(shot: Shot, config: FlowConfig) -> str:
    """Key of the cameras, frames and masks that a matte is computed from. Missing files are left out of the key."""
    digests: list[str] = []
    for file in (shot.cameras, shot.listing):
        with contextlib.suppress(OSError, ValueError):
            stat = file.stat()
            digests.append(_digest(file, stat.st_ino, stat.st_size, stat.st_mtime_ns))
    return content_key(MOTION_VERSION, config, digests, *masks_key(shot))


# Every matte needs it, and the files grow with the clip.
@functools.lru_cache(maxsize=16)
def _digest(file: Path, *_state: int) -> str:
    """SHA-256 of a file, cached by inode, size and time."""
    with open_regular(file) as handle:
        return hashlib.sha256(handle.read()).hexdigest()


def record_of(path: Path) -> dict[str, Any]:
    """The record in a file; {} if it cannot be read or is of another version."""
    try:
        found = read_json(path)
    except (OSError, ValueError):
        return {}
    whole = found.get("version") == MOTION_VERSION and isinstance(found.get("key"), str)
    result: Any = found.get("result", {})
    if not whole or not isinstance(result, dict):
        return {}
    named = path.name != _RECORD or set(cast(dict[str, Any], result)) == {"motion_pixels_share", "unknown_share"}
    return found if named else {}


def is_found(shot: Shot) -> bool:
    """True if the shot has mattes of its current solve."""
    return record_of(shot.motion / _RECORD).get("key") == solve_key(shot, FlowConfig())


def is_outdated(shot: Shot) -> bool:
    """True if the shot has unusable mattes: of another version of this program, of other cameras, or of an unfinished
    search."""
    return any((shot.motion / name).is_file() for name in (_RECORD, _UNFINISHED)) and not is_found(shot)


def motion_key(shot: Shot, with_found: bool = True) -> str:
    """Key that changes with every painted matte and, if `with_found`, with the detected mattes."""
    found = record_of(shot.motion / _RECORD).get("key") if with_found and is_found(shot) else None
    painted = sorted(p for p in shot.painted.glob("*.png") if p.is_file())
    # By content instead of time, so that a training run can resume in a copied shot.
    return content_key(found, [[p.name, _content(p)] for p in painted])


def _content(path: Path) -> str:
    with open_regular(path, LONGEST_PICTURE) as source:
        return hashlib.sha256(source.read()).hexdigest()


def load_motion(shot: Shot, frame: int) -> NDArray[np.uint8] | None:
    """The matte of a frame: STILL, UNKNOWN or MOVING, [h, w] of the working frames; None if there is none.

    Painted pixels replace detected ones. Raises JobError if a file is damaged.
    """
    path = shot.matte(frame)
    painted = shot.painted_matte(frame)
    found = read_found(path) if path.is_file() and is_found(shot) else None
    if not painted.is_file():
        return found
    info = shot.info()
    size = (info.width, info.height) if found is None else found.shape[::-1]
    return _painted(painted, found, size)


def load_surface(shot: Shot) -> SurfacePoints:
    """Points of still surfaces of the shot's current solve; none if the solve predates such points."""
    return read_surface(shot.motion) if is_found(shot) else NO_SURFACE


def write_matte(path: Path, labels: NDArray[np.uint8]) -> None:
    """Writes [H, W] uint8 as a grey PNG, whole or not at all."""
    write_grey(path, labels)


def read_found(path: Path) -> NDArray[np.uint8]:
    """[h, w] labels of a detected matte. Raises JobError if the file is damaged."""
    pixels = _decoded(path, cv2.IMREAD_GRAYSCALE)
    if pixels is None or pixels.dtype != np.uint8:
        raise JobError(f"The motion matte {path} is damaged.", "Solve the camera again.", ExitCode.SOLVE)
    return pixels


def _painted(path: Path, found: NDArray[np.uint8] | None, size: tuple[int, int]) -> NDArray[np.uint8]:
    """`found` with the painted labels over it.

    Grey below 85 of 255 is still, above 170 moving, between unknown. Pixels with alpha up to 0.5 are not painted.
    """
    pixels = _decoded(path, cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype.type not in (np.uint8, np.uint16):
        raise JobError(
            f"The painted motion matte {path} is damaged, or not a PNG.",
            "Paint it again, or remove it.",
            ExitCode.FOOTAGE,
        )
    scale = 255.0 / np.iinfo(pixels.dtype).max
    pixels = pixels[..., None] if pixels.ndim == 2 else pixels
    # Resized before the conversion to float, which would take four times the memory of a large picture.
    colour = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_NEAREST_EXACT)).reshape(*size[::-1], -1)
    grey = colour[..., : 3 if pixels.shape[2] >= 3 else 1].astype(np.float32).mean(2) * scale
    labels = _LABELS[np.searchsorted([85.0, 170.0], grey, side="right")]
    alpha = np.full_like(grey, 255.0)
    if pixels.shape[2] in (2, 4):
        plane = pixels[..., -1].astype(np.float32) * scale
        alpha = np.asarray(cv2.resize(plane, size, interpolation=cv2.INTER_LINEAR))
    below = np.full_like(labels, UNKNOWN) if found is None else found
    return np.where(alpha > 127.5, labels, below)


def _decoded(path: Path, how: int) -> NDArray[Any] | None:
    """Pixels of a PNG; None if the file is damaged or incomplete. Raises JobError if the picture is too large."""
    width, height = png_size(path)
    if width * height > MOST_PIXELS:
        raise too_large(path.name, width, height)
    with open_regular(path) as handle:
        data = np.frombuffer(handle.read(), np.uint8)
    if not len(data) or not is_whole_png(path):
        return None
    try:
        return cv2.imdecode(data, how)
    except cv2.error:
        return None
