"""ST maps of a solve, and the overscan beyond the plate's border that redistortion needs.

A map is a picture of coordinates: R is s, to the right, G is t, up, both from 0 to 1 over the sampled picture. Pixel
centres lie at (i + 0.5) / size, as Nuke's STMap and Blender's Map UV expect. B is 1: Blender's node reads it as the
opacity of the pixel; Nuke's node ignores it.
"""

from __future__ import annotations

import errno
import math
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from ..contract import STMAP_FILES, ExitCode, FreezeParams, JobError, regular_file
from ..footage.oiio_types import open_output
from ..shot import Shot, atomic_path, disk_error, is_disk_full, need_disk
from .lens import Lens, load_lens
from .map_lens import MapLens
from .plate_lens import PlateLens

UNDISTORT, REDISTORT = STMAP_FILES
"""File names of the maps in a shot's solve/ folder."""
LARGEST = 16_384
"""Maximum width of a map in pixels."""
_ROWS = 64
# Radius of a cubic filter in pixels.
_FILTER_PX = 2
_TOUCHING_PX = 1e-3
_MOST_PERCENT = 100.0


def undistort_map(lens: Lens | MapLens, width: int, height: int) -> NDArray[np.float32]:
    """The map [height, width, 3] that holds, for each pixel of the undistorted frame, its place in the original one."""
    out = np.ones((height, width, 3), np.float32)
    for top in range(0, height, _ROWS):
        at = lens.to_original(_centres(lens, width, height, top))
        out[top : top + _ROWS, :, :2] = _st(at, lens).reshape(-1, width, 2)
    return out


def redistort_map(
    lens: Lens | MapLens, width: int, height: int, beyond: tuple[float, float] = (0.0, 0.0)
) -> NDArray[np.float32]:
    """The map [height, width, 3] that holds, for each pixel of the original frame, its place in the undistorted one.

    `beyond`: overscan of the undistorted frame on each side, as a share of the plate's width (left and right) and
    height (above and below). Without overscan, (0, 0), values below 0 or above 1 lie outside of the plate.
    """
    out = np.ones((height, width, 3), np.float32)
    more = np.array(beyond)
    for top in range(0, height, _ROWS):
        at = _st(lens.to_plate(_centres(lens, width, height, top)), lens)
        out[top : top + _ROWS, :, :2] = ((at + more) / (1.0 + 2.0 * more)).reshape(-1, width, 2)
    return out


def needed_margin(lens: Lens | MapLens, width: int, height: int) -> tuple[int, int]:
    """Overscan in pixels of a frozen frame of `width` x `height`: at left and right, and at top and bottom.

    Opposite sides have the same overscan, so that the plate stays in the middle.
    """
    if lens.is_none:
        return 0, 0  # the formula below would give overscan to a smaller frame: its outer pixel centres lie farther in
    x, y = np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5
    border = np.concatenate(
        [np.stack(np.broadcast_arrays(x, edge), 1) for edge in (y[0], y[-1])]
        + [np.stack(np.broadcast_arrays(edge, y), 1) for edge in (x[0], x[-1])]
    )
    size = np.array([width, height])
    at = lens.to_plate(border) * (size / [lens.width, lens.height])
    past = np.maximum(0.5 - at.min(axis=0), at.max(axis=0) - (size - 0.5))
    # A bilinear or cubic filter then finds all its samples for every pixel of the original.
    across, down = (math.ceil(p) + _FILTER_PX if p > _TOUCHING_PX else 0 for p in past)
    return across, down


def margin(shot: Shot, params: FreezeParams, width: int, height: int, Ks: NDArray[np.float64]) -> tuple[int, int]:
    """Overscan in pixels of a take of `width` x `height`: at left and right, and at top and bottom.

    `Ks` [F, 4] are fx, fy, cx, cy of the take's frames at this size. Automatic overscan requires the intrinsics of the
    solved camera. Raises JobError (USAGE or SOLVE) if the overscan cannot be computed.
    """
    overscan = params.overscan
    if overscan == 0.0:
        return 0, 0
    if overscan < 0.0:
        lens = load_lens(shot)
        if not same_camera(lens, width, height, Ks):
            raise JobError(
                "The overscan that the lens needs is only known for the clip's own camera, but this path has another "
                "focal length or aspect ratio.",
                "Use the lens of the solved camera and the clip's size, or switch overscan off.",
                ExitCode.USAGE,
            )
        lens.check()
        found = needed_margin(lens, width, height)
        if found[0] > width or found[1] > height:
            raise JobError(
                f"Adding the lens distortion back needs {found[0]} x {found[1]} pixels beyond a frame of {width} x "
                f"{height}, which no real lens does.",
                "Solve the camera again with the other kind of lens.",
                ExitCode.SOLVE,
            )
        return found
    if not overscan <= _MOST_PERCENT:
        raise JobError(
            f"Overscan is {overscan:g} percent: it should be 0 to {_MOST_PERCENT:g}, or what the lens needs.",
            "Choose a smaller one.",
            ExitCode.USAGE,
        )
    return math.ceil(overscan / 100.0 * width), math.ceil(overscan / 100.0 * height)


def same_camera(lens: Lens | MapLens, width: int, height: int, Ks: NDArray[np.float64]) -> bool:
    """True if frames of `width` x `height` with intrinsics `Ks` [F, 4] have the same field of view as the plate."""
    ratio = np.array([width / lens.width, height / lens.height] * 2)
    side = max(width, height)
    return bool((np.abs(np.asarray(Ks) - np.array(lens.intrinsics) * ratio) < 1e-3 * side).all())


def write_maps(shot: Shot, width: int = 0) -> dict[str, Any]:
    """Writes both maps of a solved shot into solve/. Returns their paths, their size and the required overscan.

    `width`: width of the maps in pixels; 0: the width of the working frames. Raises JobError: SOLVE if the lens is
    unknown or cannot be inverted, USAGE if `width` is out of range, DISK if the disk is full.
    """
    lens = load_lens(shot)
    if width and not 16 <= width <= LARGEST:
        raise JobError(f"The maps cannot be {width} pixels wide.", f"Choose 16 to {LARGEST}, or 0.", ExitCode.USAGE)
    lens.check()
    width = width or lens.width
    height = max(1, round(lens.height * width / lens.width))
    need_disk(shot.solve, 2 * width * height * 12.0, "the maps")
    facts = {
        "undistort": str(write_map(shot.solve / UNDISTORT, undistort_map(lens, width, height))),
        "redistort": str(write_map(shot.solve / REDISTORT, redistort_map(lens, width, height))),
        "width": width,
        "height": height,
    }
    across, down = needed_margin(lens, lens.width, lens.height)
    return {**facts, "overscan_percent": [100.0 * across / lens.width, 100.0 * down / lens.height]}


def write_take_map(
    shot: Shot, path: Path, width: int, height: int, beyond: tuple[int, int], Ks: NDArray[np.float64]
) -> Path | None:
    """Writes the redistortion map for the frames of a take to `path`. Returns the path.

    The take's frames are `width` x `height` pixels with `beyond` pixels of overscan on each side. The map has the size
    of the working frames, so that it restores the original picture. Returns None if the take's intrinsics `Ks` [F, 4]
    differ from the plate's: the artist's camera has no lens distortion. Raises JobError (SOLVE) as `Lens.check` does.
    """
    lens = load_lens(shot)
    if not same_camera(lens, width, height, Ks):
        return None
    lens.check()
    path.parent.mkdir(exist_ok=True)
    pixels = redistort_map(lens, lens.width, lens.height, (beyond[0] / width, beyond[1] / height))
    return write_map(path, pixels)


def write_plate_map(path: Path, lens: PlateLens | MapLens, width: int, height: int, key: str) -> Path:
    """Writes the map that undistorts footage of `width` x `height` to a plate of the same size. Returns the path.

    Does nothing if the existing file has the same `key`. Raises JobError (DISK) or OSError.
    """
    known = oiio.ImageInput.open(regular_file(path)) if path.is_file() else None
    if known is not None:
        try:
            if known.spec().getattribute("splannequin:key") == key:
                return path
        finally:
            known.close()
    need_disk(path.parent, width * height * 12.0, "the map")
    pixels = np.ones((height, width, 3), np.float32)
    where = lens.where(width, height)
    np.divide(where[..., 0], np.float32(width), out=pixels[..., 0])
    np.subtract(np.float32(1.0), where[..., 1] / np.float32(height), out=pixels[..., 1])
    path.parent.mkdir(exist_ok=True)
    return write_map(path, pixels, key)


def write_map(path: Path, pixels: NDArray[np.float32], key: str = "") -> Path:
    """Writes a map [H, W, 3] atomically as a 32-bit float EXR. Raises JobError (DISK) for a full disk, else OSError."""
    height, width = pixels.shape[:2]
    spec = oiio.ImageSpec(width, height, 3, oiio.FLOAT)
    spec.channelnames = ("R", "G", "B")
    spec.attribute("compression", "zip")
    spec.attribute("DateTime", "")  # makes the file reproducible, as for frozen frames
    spec.attribute("oiio:ColorSpace", "data")
    if key:
        spec.attribute("splannequin:key", key)
    try:
        with atomic_path(path) as partial:
            output = oiio.ImageOutput.create(str(partial))
            if output is None:
                raise OSError(errno.EIO, f"OpenImageIO cannot write EXR: {oiio.geterror()}", str(path))
            if not (open_output(output, partial, spec) and output.write_image(pixels) and output.close()):
                output.close()  # Windows cannot remove the partial file while it is open
                need_disk(path.parent, pixels.nbytes, "the map")
                raise OSError(errno.EIO, f"map not written: {output.geterror()}", str(path))
    except OSError as error:
        raise (disk_error(path.parent) if is_disk_full(error) else error) from error
    return path


def _centres(lens: Lens | MapLens, width: int, height: int, top: int) -> NDArray[np.float64]:
    """Pixel centres [P, 2] of `_ROWS` rows from `top` of a `width` x `height` map, in pixels of the working frames."""
    x = (np.arange(width) + 0.5) / width * lens.width
    y = (np.arange(top, min(top + _ROWS, height)) + 0.5) / height * lens.height
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _st(pixels: NDArray[np.float64], lens: Lens | MapLens) -> NDArray[np.float64]:
    """Converts pixels [P, 2] of a working frame, y down, to s and t, t up."""
    return np.stack([pixels[:, 0] / lens.width, 1.0 - pixels[:, 1] / lens.height], axis=1)
