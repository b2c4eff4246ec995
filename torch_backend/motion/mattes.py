"""The motion matte of a shot: per delivered frame what stands still, what moves by itself, and what is not known.

SHOT/solve/motion/NNNNNN.png, grey, of the working frames' size: STILL, UNKNOWN or MOVING. motion.json beside
them says which cameras they belong to; mattes of an earlier solve are not read, nor are the points of still surfaces
that lie with them (`surface`). What an artist paints goes before what is found: SHOT/motion_paint/NNNNNN.png, which no
solve touches.
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
"""Values of a matte. Whoever reads one takes those nearer to another for that one."""
MOTION_VERSION = 7
PAINTED = PAINTED_FOLDER
"""Of painted mattes, in the shot's folder."""
_RECORD, _UNFINISHED = MOTION_FILE, MOTION_UNFINISHED_FILE
_LABELS = np.array([STILL, UNKNOWN, MOVING], np.uint8)


def solve_key(shot: Shot, config: FlowConfig) -> str:
    """Identifies the cameras, frames and masks that a matte is made from; of a shot without them, what it has."""
    digests: list[str] = []
    for file in (shot.cameras, shot.listing):
        with contextlib.suppress(OSError, ValueError):
            stat = file.stat()
            digests.append(_digest(file, stat.st_ino, stat.st_size, stat.st_mtime_ns))
    return content_key(MOTION_VERSION, config, digests, *masks_key(shot))


@functools.lru_cache(maxsize=16)
def _digest(file: Path, *_state: int) -> str:
    """SHA-256 of a file in the state that it is in: asked for with each matte, and the files grow with the clip."""
    with open_regular(file) as handle:
        return hashlib.sha256(handle.read()).hexdigest()


def record_of(path: Path) -> dict[str, Any]:
    """A record of this version; {} if there is none that can be read."""
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
    """True if the shot has mattes of the solve that it has now."""
    return record_of(shot.motion / _RECORD).get("key") == solve_key(shot, FlowConfig())


def is_outdated(shot: Shot) -> bool:
    """True if the shot has mattes that are not read: of an earlier version of this program, of other cameras, or of a
    search that was cancelled or killed."""
    return any((shot.motion / name).is_file() for name in (_RECORD, _UNFINISHED)) and not is_found(shot)


def motion_key(shot: Shot, with_found: bool = True) -> str:
    """Changes when any matte does, found or painted; without those that were found, only when a painted one does.

    Painted ones count by content: a shot that was copied is still the same shot, and a run of it goes on.
    """
    found = record_of(shot.motion / _RECORD).get("key") if with_found and is_found(shot) else None
    painted = sorted(p for p in shot.painted.glob("*.png") if p.is_file())
    return content_key(found, [[p.name, _content(p)] for p in painted])


def _content(path: Path) -> str:
    with open_regular(path, LONGEST_PICTURE) as source:
        return hashlib.sha256(source.read()).hexdigest()


def load_motion(shot: Shot, frame: int) -> NDArray[np.uint8] | None:
    """The matte of a frame: STILL, UNKNOWN or MOVING, [h, w] of the working frames; None if there is none.

    Where an artist painted, that is it. JobError if a file of it is damaged.
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
    """Points of still surfaces of the solve that the shot has now; none if it was solved before they were kept."""
    return read_surface(shot.motion) if is_found(shot) else NO_SURFACE


def write_matte(path: Path, labels: NDArray[np.uint8]) -> None:
    """Writes [H, W] uint8 as a grey PNG, whole or not at all."""
    write_grey(path, labels)


def read_found(path: Path) -> NDArray[np.uint8]:
    """[h, w] labels of a matte that was found. JobError if the file is damaged."""
    pixels = _decoded(path, cv2.IMREAD_GRAYSCALE)
    if pixels is None or pixels.dtype != np.uint8:
        raise JobError(f"The motion matte {path} is damaged.", "Solve the camera again.", ExitCode.SOLVE)
    return pixels


def _painted(path: Path, found: NDArray[np.uint8] | None, size: tuple[int, int]) -> NDArray[np.uint8]:
    """`found` with what was painted over it: grey below 85 of 255 is still, above 170 moving, alpha to 0.5 nothing."""
    pixels = _decoded(path, cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype.type not in (np.uint8, np.uint16):
        raise JobError(
            f"The painted motion matte {path} is damaged or no PNG.", "Paint it again, or remove it.", ExitCode.FOOTAGE
        )
    scale = 255.0 / np.iinfo(pixels.dtype).max
    pixels = pixels[..., None] if pixels.ndim == 2 else pixels
    # Made small as it is stored: as floats a large picture would take four times its memory.
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
    """Pixels of a PNG; None if it holds no picture that can be read whole. JobError if it is too large."""
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
