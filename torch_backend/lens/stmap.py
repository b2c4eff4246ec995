"""ST maps of a solve, and how much picture beyond the plate's border a way back through the lens needs.

A map is a picture of coordinates: R is s, to the right, G is t, up, both from 0 to 1 over the picture that is looked
into, and pixel centres lie at (i + 0.5) / size. So Nuke's STMap and Blender's Map UV read them. B is 1: Blender's node
takes it for how opaque the pixel is, Nuke's does not look at it.
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
"""Names of the maps in a shot's solve/."""
LARGEST = 16_384
"""Most pixels of a map along a side."""
_ROWS = 64
_FILTER_PX = 2
"""Pixels around a point that a cubic filter reads."""
_TOUCHING_PX = 1e-3
_MOST_PERCENT = 100.0


def undistort_map(lens: Lens | MapLens, width: int, height: int) -> NDArray[np.float32]:
    """[height, width, 3]: for each pixel of the undistorted frame, where to look in the original one."""
    out = np.ones((height, width, 3), np.float32)
    for top in range(0, height, _ROWS):
        at = lens.to_original(_centres(lens, width, height, top))
        out[top : top + _ROWS, :, :2] = _st(at, lens).reshape(-1, width, 2)
    return out


def redistort_map(
    lens: Lens | MapLens, width: int, height: int, beyond: tuple[float, float] = (0.0, 0.0)
) -> NDArray[np.float32]:
    """[height, width, 3]: for each pixel of the original frame, where to look in the undistorted one.

    `beyond`: the undistorted frame goes on past the plate by this share of the plate's width on the left and right, and
    of its height above and below; (0, 0) is the plate itself, and where the lens looks past it, values lie below 0 and
    above 1.
    """
    out = np.ones((height, width, 3), np.float32)
    more = np.array(beyond)
    for top in range(0, height, _ROWS):
        at = _st(lens.to_plate(_centres(lens, width, height, top)), lens)
        out[top : top + _ROWS, :, :2] = ((at + more) / (1.0 + 2.0 * more)).reshape(-1, width, 2)
    return out


def needed_margin(lens: Lens | MapLens, width: int, height: int) -> tuple[int, int]:
    """Pixels that a frozen frame of `width` x `height` needs beyond each side, and beyond top and bottom.

    With them every pixel of the original frame finds its neighbours for a bilinear or cubic filter. The same on
    opposite sides, so that the plate stays in the middle.
    """
    if lens.is_none:
        return 0, 0  # also for a smaller frame, whose outer pixel centres lie farther in than the original's
    x, y = np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5
    border = np.concatenate(
        [np.stack(np.broadcast_arrays(x, edge), 1) for edge in (y[0], y[-1])]
        + [np.stack(np.broadcast_arrays(edge, y), 1) for edge in (x[0], x[-1])]
    )
    size = np.array([width, height])
    at = lens.to_plate(border) * (size / [lens.width, lens.height])
    past = np.maximum(0.5 - at.min(axis=0), at.max(axis=0) - (size - 0.5))
    across, down = (math.ceil(p) + _FILTER_PX if p > _TOUCHING_PX else 0 for p in past)
    return across, down


def margin(shot: Shot, params: FreezeParams, width: int, height: int, Ks: NDArray[np.float64]) -> tuple[int, int]:
    """Pixels that a take of `width` x `height` has beyond each side, and beyond top and bottom, for its overscan.

    `Ks` [F, 4] are fx, fy, cx, cy of its frames at that size: what the lens needs is known for the clip's own alone.
    JobError (USAGE or SOLVE) if it cannot be had.
    """
    overscan = params.overscan
    if overscan == 0.0:
        return 0, 0
    if overscan < 0.0:
        lens = load_lens(shot)
        if not same_camera(lens, width, height, Ks):
            raise JobError(
                "What the lens needs beyond the frame is known for the clip's own camera only, "
                "and this path has another focal length or shape.",
                "Give the camera the lens of the solved one and the clip's size, or switch overscan off.",
                ExitCode.USAGE,
            )
        lens.check()
        found = needed_margin(lens, width, height)
        if found[0] > width or found[1] > height:
            raise JobError(
                f"The way back through the lens needs {found[0]} x {found[1]} pixels beyond a frame of "
                f"{width} x {height}: that is no lens.",
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
    """True if frames with intrinsics `Ks` [F, 4], of `width` x `height`, show what the plate shows, lens for lens."""
    ratio = np.array([width / lens.width, height / lens.height] * 2)
    side = max(width, height)
    return bool((np.abs(np.asarray(Ks) - np.array(lens.intrinsics) * ratio) < 1e-3 * side).all())


def write_maps(shot: Shot, width: int = 0) -> dict[str, Any]:
    """Writes both maps of a solved shot into solve/; returns where they are and what they need.

    `width` of the maps in pixels; 0: the working frames'. JobError (SOLVE) if the lens is not told or has no way back,
    USAGE for a width that is out of the question, DISK.
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
    """The redistortion map over the whole overscanned frames of a take, at `path`: `width` x `height` and `beyond`
    around it.

    As large as the working frames, so that it gives back the original picture. None if the take's intrinsics `Ks`
    [F, 4] are not the plate's: a camera of the artist's own has no lens. JobError (SOLVE) as `Lens.check`.
    """
    lens = load_lens(shot)
    if not same_camera(lens, width, height, Ks):
        return None
    lens.check()
    path.parent.mkdir(exist_ok=True)
    pixels = redistort_map(lens, lens.width, lens.height, (beyond[0] / width, beyond[1] / height))
    return write_map(path, pixels)


def write_plate_map(path: Path, lens: PlateLens | MapLens, width: int, height: int, key: str) -> Path:
    """The map from footage of `width` x `height` to the plate of that size without its lens, unless it is there.

    `key` tells whether a file that is there is this map. JobError (DISK), OSError.
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
    """A map [H, W, 3] as a 32-bit float EXR, whole or not at all. JobError (DISK) if the disk is full, else OSError."""
    height, width = pixels.shape[:2]
    spec = oiio.ImageSpec(width, height, 3, oiio.FLOAT)
    spec.channelnames = ("R", "G", "B")
    spec.attribute("compression", "zip")
    spec.attribute("DateTime", "")  # as of frozen frames: a map is the same whoever wrote it, whenever
    spec.attribute("oiio:ColorSpace", "data")
    if key:
        spec.attribute("splannequin:key", key)
    try:
        with atomic_path(path) as partial:
            output = oiio.ImageOutput.create(str(partial))
            if output is None:
                raise OSError(errno.EIO, f"OpenImageIO cannot write EXR: {oiio.geterror()}", str(path))
            if not (open_output(output, partial, spec) and output.write_image(pixels) and output.close()):
                need_disk(path.parent, pixels.nbytes, "the map")
                raise OSError(errno.EIO, f"map not written: {output.geterror()}", str(path))
    except OSError as error:
        raise (disk_error(path.parent) if is_disk_full(error) else error) from error
    return path


def _centres(lens: Lens | MapLens, width: int, height: int, top: int) -> NDArray[np.float64]:
    """[P, 2]: pixel centres of rows from `top` of a map of that size, in pixels of the working frames."""
    x = (np.arange(width) + 0.5) / width * lens.width
    y = (np.arange(top, min(top + _ROWS, height)) + 0.5) / height * lens.height
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _st(pixels: NDArray[np.float64], lens: Lens | MapLens) -> NDArray[np.float64]:
    """Pixels [P, 2] of a working frame, y down, as s and t, t up."""
    return np.stack([pixels[:, 0] / lens.width, 1.0 - pixels[:, 1] / lens.height], axis=1)
