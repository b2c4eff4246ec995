"""Frozen frames as OpenEXR: colour, depth and both mattes in one single-part file.

Channel names were chosen by experiment with the bpy wheels 4.2.23, 4.5.15, 5.0.1 and 5.2.3. With `CHANNELS`, Blender
loads the file as MULTILAYER, "Linear Rec.709", and the compositor's Image node shows the sockets Combined, Alpha,
Depth, Motion and Support in all four versions, values bit-exact; R G B A Z are plain, so Nuke and other readers show
`rgba` and `depth` at once and find `Support` and `Motion` as further layers. With `GRAIN_CHANNELS` a socket Grain joins
them, a colour. Rejected: `Frozen.Combined.R ...` (same
sockets, but no plain RGBA elsewhere); plain RGBA with `Frozen.Support.V` (a second layer, so the mattes are not on
the same node); a lone `.R` or `.A` in a matte (aborts 5.2.3 with corrupted memory).
"""

from __future__ import annotations

import errno
import math
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from numpy.typing import ArrayLike, NDArray

from ..shot import atomic_path

CHANNELS = ("R", "G", "B", "A", "Z", "Support.V", "Motion.V")
"""Channel names in the order of the arrays: colour, depth, support matte, motion matte."""
GRAIN_CHANNELS = ("Grain.R", "Grain.G", "Grain.B", "Grain.A")
"""Channel names of the grain, which a frame may lack."""
BLENDER_SOCKETS = ("Combined", "Alpha", "Depth", "Motion", "Support")
"""Outputs of Blender's compositor Image node for such a file, 4.2 to 5.2."""
HALF_MAX = 65504.0
"""Largest finite half float; brighter colour is clamped to it."""
EXR_VERSION = 1
"""Version of the `splannequin:` attributes."""
COLOR_SPACE = "lin_rec709_scene"
"""Scene-linear, Rec.709 / sRGB primaries, D65 (ASWF colour interop id, written as `colorInteropID`)."""

_FORMATS = (oiio.HALF,) * 4 + (oiio.FLOAT,) + (oiio.HALF,) * 2
_REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
_FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class FrameMetadata:
    """What a frozen frame says about itself, stored as EXR attributes."""

    frame: int
    """Frame number in the clip's own numbering."""
    t_star_frame: float
    """Instant at which time stands still, as a (fractional) frame number of the clip."""
    viewmat: NDArray[np.float32]
    """[4,4] world-to-camera, OpenCV axes, column vectors (p_camera = viewmat @ p_world)."""
    K: NDArray[np.float32]
    """[3,3] intrinsics in pixels of the frame (without a margin), pixel centres at +0.5."""
    depth_units: str = "solve units"
    """Unit of depth and of the translation in `viewmat`."""
    version: int = EXR_VERSION
    """Version of these attributes."""
    key: str = ""
    """What the frame was rendered from, to tell a stale one; empty in frames of before it was noted."""


@dataclass(frozen=True, eq=False)
class FrozenFrame:
    """One frozen frame as read back."""

    rgba: NDArray[np.float32]
    """[H,W,4] scene-linear, premultiplied."""
    depth: NDArray[np.float32]
    """[H,W] planar depth along the camera's axis, in `metadata.depth_units`; 1e10 where alpha is 0."""
    support: NDArray[np.float32]
    """[H,W] in 0..1: how well the pixel was seen at t*."""
    motion: NDArray[np.float32]
    """[H,W] in 0..1: how much of the pixel belongs to what moves in the clip."""
    metadata: FrameMetadata
    margin: tuple[int, int] = (0, 0)
    """Pixels beyond the frame on the left and right, and above and below; the arrays hold them."""
    grain: NDArray[np.float32] | None = None
    """[H,W,3] scene-linear, premultiplied: what added to `rgba` gives it the plate's grain. None: not in the file."""


def write_frozen_exr(
    path: str | Path,
    rgba: ArrayLike,  # [H,W,4]
    depth: ArrayLike,  # [H,W]
    support: ArrayLike,  # [H,W]
    motion: ArrayLike,  # [H,W]
    metadata: FrameMetadata,
    margin: tuple[int, int] = (0, 0),
    grain: ArrayLike | None = None,  # [H,W,3]
) -> Path:
    """Writes one frame atomically: half colour and mattes, float32 depth, ZIP. Arrays as in `FrozenFrame`.

    Grain is noise, which does not compress: it keeps 2 bits of its mantissa and is off by an eighth of itself at most,
    which takes a third off what it adds to the file (0.74 instead of 1.25 MB at 640 x 480).

    Attributes: `chromaticities` and `colorInteropID` (Rec.709); `worldToCamera`, the OpenEXR standard matrix, in the
    renderer axes of Blender and Nuke (x right, y up, looking along -z) for Imath's row vectors (p_camera = p_world @
    M, translation in the last row); `splannequin:viewmat` and `splannequin:K`, row-major as in `FrameMetadata`;
    `splannequin:frame`, `:tStarFrame`, `:depthUnits`, `:version`, `:key`. Half channels are clamped to +-65504.

    With a `margin` the arrays are the data window, and the display window, in whose pixels K counts, is the frame
    inside of them. Blender 4.2 to 5.2 reads the whole data window and puts its middle in the middle of the render,
    wherever the display window lies; so margins are the same on opposite sides.

    ValueError names the layer whose shape is wrong or that holds NaN or infinity; OSError if the file cannot be
    written (errno ENOSPC when the disk is full).
    """
    path = Path(path)
    pixels = _stack(rgba, depth, support, motion)
    if grain is not None:
        pixels = np.concatenate([pixels, _coarse(grain, pixels.shape[:2])], axis=2)
    spec = _spec(pixels.shape[1], pixels.shape[0], metadata, grain is not None)
    across, down = margin
    if not (0 <= 2 * across < pixels.shape[1] and 0 <= 2 * down < pixels.shape[0]):
        raise ValueError(f"a margin of {margin} pixels leaves nothing of {pixels.shape[1]} x {pixels.shape[0]}")
    spec.x, spec.y = -across, -down
    spec.full_x, spec.full_y = 0, 0
    spec.full_width, spec.full_height = pixels.shape[1] - 2 * across, pixels.shape[0] - 2 * down
    with atomic_path(path) as beside:
        output = oiio.ImageOutput.create(str(beside))
        if output is None:
            raise OSError(errno.EIO, f"OpenImageIO cannot write EXR: {oiio.geterror()}", str(path))
        if not (output.open(str(beside), spec) and output.write_image(pixels) and output.close()):
            raise _os_error(output.geterror(), path, pixels.nbytes)
    return path


def read_frozen_exr(path: str | Path) -> FrozenFrame:
    """Reads a file of `write_frozen_exr`; everything float32.

    FileNotFoundError without a file; ValueError if it cannot be read, is not a frozen frame, or is from a newer
    version.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(errno.ENOENT, "no such EXR", str(path))
    image = oiio.ImageInput.open(str(path))
    if image is None:
        raise ValueError(f"{path}: cannot be read as EXR: {oiio.geterror()}")
    try:
        spec = image.spec()
        names = list(spec.channelnames)
        missing = [name for name in CHANNELS if name not in names]
        if missing:
            raise ValueError(f"{path}: not a frozen frame, it has no channel {', '.join(missing)}")
        metadata = _metadata(spec, path)
        pixels = image.read_image(oiio.FLOAT)
        if pixels is None:
            raise ValueError(f"{path}: damaged, {image.geterror()}")
    finally:
        image.close()
    order = [names.index(name) for name in CHANNELS]
    pixels = np.asarray(pixels, dtype=np.float32)
    depth, support, motion = (np.ascontiguousarray(pixels[..., i]) for i in order[4:])
    beyond = (spec.full_x - spec.x, spec.full_y - spec.y)
    grain = None
    if all(name in names for name in GRAIN_CHANNELS):
        grain = np.ascontiguousarray(pixels[..., [names.index(name) for name in GRAIN_CHANNELS[:3]]])
    return FrozenFrame(np.ascontiguousarray(pixels[..., order[:4]]), depth, support, motion, metadata, beyond, grain)


def read_key(path: str | Path) -> str | None:
    """`FrameMetadata.key` of a frame, from its header alone; None if the file cannot be read as one."""
    image = oiio.ImageInput.open(str(path))
    if image is None:
        oiio.geterror()  # else it is told to whoever asks next
        return None
    try:
        return str(image.spec().getattribute("splannequin:key") or "")
    finally:
        image.close()


def _coarse(grain: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Grain [H,W,3], checked, as half floats whose eight lowest bits are 0, and an alpha of 0: [H,W,4]."""
    half = np.asarray(grain, dtype=np.float32).astype(np.float16)
    if half.shape != (*shape, 3):
        raise ValueError(f"grain should be {[*shape, 3]} like rgba, got shape {list(half.shape)}")
    if not np.isfinite(half).all():
        raise ValueError("grain has NaN or infinite values")
    # Rounded to the nearest: cut off, it would lose a tenth of its strength.
    half = ((half.view(np.uint16) + np.uint16(0x80)) & np.uint16(0xFF00)).view(np.float16)
    return np.concatenate([half, np.zeros((*shape, 1), np.float16)], axis=2).astype(np.float32)


def _stack(rgba: ArrayLike, depth: ArrayLike, support: ArrayLike, motion: ArrayLike) -> NDArray[np.float32]:
    """[H,W,7] in the order of `CHANNELS`, checked, half layers clamped."""
    layers = {"rgba": rgba, "depth": depth, "support": support, "motion": motion}
    with np.errstate(over="ignore"):
        arrays = {name: np.asarray(layer, dtype=np.float32) for name, layer in layers.items()}
    colour = arrays["rgba"]
    if colour.ndim != 3 or colour.shape[2] != 4 or not colour.size:
        raise ValueError(f"rgba should be [H,W,4], got shape {colour.shape}")
    pixels = np.empty((*colour.shape[:2], len(CHANNELS)), dtype=np.float32)
    for channel, (name, layer) in zip((slice(0, 4), 4, 5, 6), arrays.items(), strict=True):
        if layer.shape[:2] != colour.shape[:2] or layer.ndim != (3 if name == "rgba" else 2):
            raise ValueError(f"{name} should be {list(colour.shape[:2])} like rgba, got shape {list(layer.shape)}")
        finite = np.isfinite(layer)
        if not finite.all():
            y, x, *_ = np.argwhere(~finite)[0]
            raise ValueError(f"{name} has {finite.size - finite.sum()} NaN or infinite values, the first at ({x}, {y})")
        pixels[..., channel] = layer if name == "depth" else np.clip(layer, -HALF_MAX, HALF_MAX)
    return pixels


def _spec(width: int, height: int, metadata: FrameMetadata, with_grain: bool) -> oiio.ImageSpec:
    viewmat = np.asarray(metadata.viewmat, dtype=np.float32)
    intrinsics = np.asarray(metadata.K, dtype=np.float32)
    for name, matrix, shape in (("viewmat", viewmat, (4, 4)), ("K", intrinsics, (3, 3))):
        if matrix.shape != shape or not np.isfinite(matrix).all():
            raise ValueError(f"metadata.{name} should be a finite matrix of shape {shape}, got {matrix.tolist()}")
    if not math.isfinite(metadata.t_star_frame):
        raise ValueError(f"metadata.t_star_frame should be finite, got {metadata.t_star_frame}")
    names = CHANNELS + (GRAIN_CHANNELS if with_grain else ())
    spec = oiio.ImageSpec(width, height, len(names), oiio.FLOAT)
    spec.channelnames = names
    spec.channelformats = _FORMATS + (oiio.HALF,) * (len(names) - len(CHANNELS))
    spec.attribute("compression", "zip")
    spec.attribute("oiio:ColorSpace", COLOR_SPACE)
    spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), _REC709)
    spec.attribute("worldToCamera", oiio.TypeDesc("matrix"), _flat((_FLIP_YZ @ viewmat).T))
    spec.attribute("splannequin:viewmat", oiio.TypeDesc("matrix"), _flat(viewmat))
    spec.attribute("splannequin:K", oiio.TypeDesc("matrix33"), _flat(intrinsics))
    spec.attribute("splannequin:frame", int(metadata.frame))
    spec.attribute("splannequin:tStarFrame", float(metadata.t_star_frame))
    spec.attribute("splannequin:depthUnits", metadata.depth_units)
    spec.attribute("splannequin:version", int(metadata.version))
    if metadata.key:
        spec.attribute("splannequin:key", metadata.key)
    return spec


def _flat(matrix: NDArray) -> tuple[float, ...]:
    return tuple(float(value) for value in matrix.ravel())


def _metadata(spec: oiio.ImageSpec, path: Path) -> FrameMetadata:
    names = ("frame", "tStarFrame", "viewmat", "K", "depthUnits", "version")
    values = {name: spec.getattribute(f"splannequin:{name}") for name in names}
    missing = [name for name, value in values.items() if value is None]
    if missing:
        raise ValueError(f"{path}: not a frozen frame, it has no attribute splannequin:{missing[0]}")
    if values["version"] > EXR_VERSION:
        raise ValueError(f"{path}: written by a newer version ({values['version']}, this one reads {EXR_VERSION})")
    return FrameMetadata(
        frame=int(values["frame"]),
        t_star_frame=float(values["tStarFrame"]),
        viewmat=np.array(values["viewmat"], dtype=np.float32).reshape(4, 4),
        K=np.array(values["K"], dtype=np.float32).reshape(3, 3),
        depth_units=str(values["depthUnits"]),
        version=int(values["version"]),
        key=str(spec.getattribute("splannequin:key") or ""),
    )


def _os_error(message: str, path: Path, byte_count: int) -> OSError:
    """OSError with the system's reason, which OpenImageIO hands on only in words, if at all."""
    code = next((c for c in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG) if os.strerror(c) in message), None)
    if code is None:
        code = errno.ENOSPC if shutil.disk_usage(path.parent).free < byte_count else errno.EIO
    return OSError(code, f"EXR not written: {message.strip() or os.strerror(code)}", str(path))
