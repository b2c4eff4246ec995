"""Frozen frames as OpenEXR: colour, depth, mattes and what the frame was made of, in one single-part file.

Channel names were chosen by experiment with the bpy wheels 4.2.23, 4.5.15, 5.0.1 and 5.2.3. With `CHANNELS`, Blender
loads the file as MULTILAYER, "Linear Rec.709", and the compositor's Image node shows the sockets Combined, Alpha,
Depth, Motion and Support in all four versions, values bit-exact; R G B A Z are plain, so Nuke and other readers show
`rgba` and `depth` at once and find `Support` and `Motion` as further layers. With `GRAIN_CHANNELS` a socket Grain, a
colour, joins them; with `DETAIL_CHANNELS` Splat, a colour, and Plate and Source, values. Rejected:
`Frozen.Combined.R ...` (same sockets, but no plain RGBA elsewhere); plain RGBA with `Frozen.Support.V` (a second layer,
so the mattes are not on the same node); a lone `.R` or `.A` in a matte (aborts 5.2.3 with corrupted memory).
"""

from __future__ import annotations

import errno
import functools
import math
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeVar, cast

import numpy as np
import OpenImageIO as oiio
from numpy.typing import ArrayLike, NDArray

from ..contract import FRAME_LAYERS, UserError, channels_of, layers_of, parse_timecode, regular_file
from ..contract.timecode import smpte_bits
from ..footage.color import LIGHTS, PRIMARIES, InputSpace, in_light, light_matrix, light_of_chromaticities
from ..footage.images import error_of
from ..shot import atomic_path

CHANNELS = channels_of("")
"""Channel names in the order of the arrays: colour, depth, support matte, motion matte."""
GRAIN_CHANNELS = channels_of("grain")
"""Channel names of the grain, which a frame may lack."""
DETAIL_CHANNELS = channels_of("detail")
"""Channel names of `DetailLayers`, which a frame of splats alone lacks."""
HALF_MAX = 65504.0
"""Largest finite half float; brighter colour is clamped to it."""
EXR_VERSION = 1
"""Version of the `splannequin:` attributes."""
COLOR_SPACE = "lin_{}_scene"
"""Scene-linear of some primaries (ASWF colour interop id, written as `colorInteropID`)."""

_STORAGE = {"half": oiio.HALF, "float": oiio.FLOAT}
_FORMATS, _GRAIN_FORMATS, _DETAIL_FORMATS = (
    tuple(_STORAGE[layer.stored] for layer in layers_of(part) for _ in layer.channels)
    for part in ("", "grain", "detail")
)
_PARTS = ("", "grain", "detail")
"""Parts whose layers have arguments of their own here; layers of any other go by the table alone (`more`)."""
_MORE = {layer.name: layer for layer in FRAME_LAYERS if layer.part not in _PARTS}
_CHANNELS_OF = {"rgba": (4,), "splat": (4,), "grain": (3,)}
ROWS = 64
"""Rows of a picture that are made and written at a time."""
_PLATE_STEPS = 256.0
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
    timecode: str = ""
    """SMPTE timecode of the clip's frame; empty if the clip carries none."""
    depth_units: str = "solve units"
    """Unit of depth and of the translation in `viewmat`."""
    version: int = EXR_VERSION
    """Version of these attributes."""
    key: str = ""
    """Key of the inputs of the frame, to detect a stale one; empty in frames of versions that did not store it."""
    light: str = LIGHTS[0]
    """Primaries of the light in the file, one of `LIGHTS`. Arrays here are Rec.709's, whatever it is."""


class Rows(Protocol):
    """A layer [H,W,...] of which some rows can be had: an array, or `Made`."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    def __getitem__(self, rows: slice, /) -> NDArray[Any]: ...


@dataclass(frozen=True)
class Made:
    """A layer that is made when it is written, a few rows at a time: as a whole it would take up memory."""

    shape: tuple[int, ...]
    """[H,W] or [H,W,C]."""
    rows: Callable[[slice], NDArray[Any]]
    """Those rows of it, any float; asked for once each, from the top."""

    def __getitem__(self, rows: slice, /) -> NDArray[Any]:
        return self.rows(rows)


@dataclass(frozen=True, eq=False)
class DetailLayers:
    """Where the pixels of a frame come from that is made of plates as well as of splats."""

    splat: ArrayLike | Made
    """[H,W,4] scene-linear, premultiplied: the frame as the splats alone show it."""
    plate: ArrayLike
    """[H,W] in 0..1: share of the pixel that is plate; 0 where splats invented it."""
    source: ArrayLike
    """[H,W] number of the frame whose plate gives most of the pixel; 0 where `plate` is 0."""


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
    detail: DetailLayers | None = None
    """float32. None: the frame is of splats alone."""
    more: Mapping[str, NDArray[np.float32]] = field(default_factory=dict[str, NDArray[np.float32]])
    """Further layers of the table that are in the file, by name: [H,W], or [H,W,4] of a colour."""


def write_frozen_exr(
    path: str | Path,
    rgba: ArrayLike | Made,  # [H,W,4]
    depth: ArrayLike | Made,  # [H,W]
    support: ArrayLike | Made,  # [H,W]
    motion: ArrayLike | Made,  # [H,W]
    metadata: FrameMetadata,
    margin: tuple[int, int] = (0, 0),
    grain: ArrayLike | Made | None = None,  # [H,W,3]
    detail: DetailLayers | None = None,
    more: Mapping[str, ArrayLike | Made] | None = None,  # [H,W] or [H,W,4]
) -> Path:
    """Writes one frame atomically: half colour and mattes, float32 depth and `source`, ZIP. Arrays as in `FrozenFrame`.

    Grain is noise, which does not compress: it keeps 2 bits of its mantissa and is off by an eighth of itself at most,
    which takes a third off what it adds to the file (0.74 instead of 1.25 MB at 640 x 480). `splat` keeps 8 bits, four
    times finer than 8-bit sRGB, and `plate` steps of 1/256: with `source` they add 0.95 MB instead of 1.29.

    Colours are converted from Rec.709 to the light that `metadata` names.

    Attributes: `chromaticities` and `colorInteropID` of that light, and `splannequin:probe` (see `contract.PROBE`) if
    it is not Rec.709's; `worldToCamera`, the OpenEXR standard matrix, in the renderer axes of Blender and Nuke (x
    right, y up, looking along -z) for Imath's row vectors (p_camera = p_world @ M, translation in the last row);
    `splannequin:viewmat` and `splannequin:K`, row-major as in `FrameMetadata`; `splannequin:frame`, `:tStarFrame`,
    `:depthUnits`, `:version`, `:key`. Half channels are clamped to +-65504.

    With a `margin` the arrays are the data window, and the display window, in whose pixels K counts, is the frame
    inside of them. Blender 4.2 to 5.2 reads the whole data window and puts its middle in the middle of the render,
    wherever the display window lies; so margins are the same on opposite sides.

    `more` are layers of the table of another part, by name. KeyError if the table has none that is called so.

    Layers that are `Made` are made while they are written. ValueError names the layer whose shape is wrong or that
    holds NaN or infinity; OSError if the file cannot be written (errno ENOSPC when the disk is full).
    """
    path = Path(path)
    layers = {"rgba": rgba, "depth": depth, "support": support, "motion": motion}
    names, formats = CHANNELS, _FORMATS
    if grain is not None:
        layers["grain"] = grain
        names, formats = names + GRAIN_CHANNELS, formats + _GRAIN_FORMATS
    if detail is not None:
        layers |= {"splat": detail.splat, "plate": detail.plate, "source": detail.source}
        names, formats = names + DETAIL_CHANNELS, formats + _DETAIL_FORMATS
    for name, layer in (more or {}).items():
        row = _MORE[name]
        layers[name] = layer
        names, formats = names + row.channels, formats + (_STORAGE[row.stored],) * len(row.channels)
    matrix = light_matrix(metadata.light)
    parts = [_stored(name, layer, matrix) for name, layer in _checked(layers).items()]
    spec = frame_spec(parts[0].shape[1], parts[0].shape[0], names, formats, metadata)
    set_margin(spec, margin)
    return write_exr(path, spec, parts)


def set_margin(spec: oiio.ImageSpec, margin: tuple[int, int]) -> None:
    """Makes the middle of a picture its frame, with `margin` pixels left and right, and above and below, beyond it.

    ValueError if they leave nothing.
    """
    across, down = margin
    if not (0 <= 2 * across < spec.width and 0 <= 2 * down < spec.height):
        raise ValueError(f"a margin of {margin} pixels leaves nothing of {spec.width} x {spec.height}")
    spec.x, spec.y = -across, -down
    spec.full_x, spec.full_y = 0, 0
    spec.full_width, spec.full_height = spec.width - 2 * across, spec.height - 2 * down


def write_exr(path: Path, spec: oiio.ImageSpec, parts: Sequence[Rows]) -> Path:
    """Writes layers [H,W,c] or [H,W], whose channels are those of `spec` one after the other, whole or not at all.

    What is stored as half is clamped to +-65504. A few rows at a time: a 4K frame of all layers has half a gigabyte.
    OSError with the system's reason, as `write_frozen_exr`.
    """
    kinds = [spec.channelformat(channel).basetype for channel in range(spec.nchannels)]
    most = np.array([HALF_MAX if kind == oiio.HALF else np.inf for kind in kinds], np.float32)

    def rows(output: Any, top: int) -> bool:
        values = _rows_of(parts, slice(top, min(top + ROWS, spec.height)), spec.width)
        np.clip(values, -most, most, out=values)
        begin = spec.y + top
        return bool(output.write_scanlines(begin, begin + len(values), 0, values))

    return write_beside(path, spec, rows)


def write_beside(path: Path, spec: oiio.ImageSpec, rows: Callable[[Any, int], bool]) -> Path:
    """Writes a picture whole or not at all. `rows` writes `ROWS` of it from a given one, False if it cannot.

    OSError with the system's reason, as `write_frozen_exr`.
    """
    with atomic_path(path) as partial:
        output = oiio.ImageOutput.create(str(partial))
        if output is None:
            raise OSError(errno.EIO, f"OpenImageIO cannot write EXR: {oiio.geterror()}", str(path))
        good = bool(cast(Any, output).open(str(partial), spec))
        try:
            for top in range(0, spec.height, ROWS) if good else ():
                good = good and rows(output, top)
        except BaseException:
            output.close()  # a file that is open cannot be removed everywhere
            raise
        if not (good and output.close()):
            raise write_error(output.geterror(), path, spec.height * spec.width * 4 * spec.nchannels)
    return path


def _rows_of(parts: Sequence[Rows], rows: slice, width: int) -> NDArray[np.float32]:
    """[h,W,C] float32: some rows of all layers."""
    height = rows.stop - rows.start
    return np.concatenate([part[rows].reshape(height, width, -1) for part in parts], axis=2, dtype=np.float32)


def channel_names(spec: oiio.ImageSpec) -> list[str]:
    """Names of a file's channels, in its order."""
    return list(cast(Any, spec).channelnames)


_Facts = TypeVar("_Facts")


def read_layers(
    path: Path, channels: Sequence[str], what: str, metadata: Callable[[oiio.ImageSpec, Path], _Facts]
) -> tuple[oiio.ImageSpec, list[str], _Facts, NDArray[np.float32]]:
    """(spec, names of the channels, metadata, pixels [H, W, C] float32) of an EXR of ours with `channels`, at least.

    FileNotFoundError without a file; ValueError if it cannot be read or is not `what`, or as `metadata` raises it.
    """
    if not path.is_file():
        raise FileNotFoundError(errno.ENOENT, "no such EXR", str(path))
    image = oiio.ImageInput.open(regular_file(path))
    if image is None:
        raise UserError(f"{path}: cannot be read as EXR: {error_of()}")
    try:
        spec = image.spec()
        names = channel_names(spec)
        missing = [name for name in channels if name not in names]
        if missing:
            raise UserError(f"{path}: {what}, it has no channel {', '.join(missing)}")
        facts = metadata(spec, path)
        pixels = image.read_image(oiio.FLOAT)
        if pixels is None:
            raise UserError(f"{path}: damaged, {error_of(image)}")
    finally:
        image.close()
    return spec, names, facts, np.asarray(pixels, dtype=np.float32)


def read_frozen_exr(path: str | Path) -> FrozenFrame:
    """Reads a file of `write_frozen_exr`; everything float32.

    FileNotFoundError without a file; ValueError if it cannot be read, is not a frozen frame, or is from a newer
    version.
    """
    spec, names, metadata, pixels = read_layers(Path(path), CHANNELS, "not a frozen frame", _metadata)
    order = [names.index(name) for name in CHANNELS]
    forth = light_matrix(metadata.light)
    back = None if forth is None else np.linalg.inv(forth)
    depth, support, motion = (np.ascontiguousarray(pixels[..., i]) for i in order[4:])
    beyond = (spec.full_x - spec.x, spec.full_y - spec.y)
    grain = None
    if all(name in names for name in GRAIN_CHANNELS):
        grain = np.ascontiguousarray(in_light(pixels[..., [names.index(name) for name in GRAIN_CHANNELS[:3]]], back))
    detail = None
    if all(name in names for name in DETAIL_CHANNELS):
        found = pixels[..., [names.index(name) for name in DETAIL_CHANNELS]]
        found = in_light(found, back)
        detail = DetailLayers(*(np.ascontiguousarray(found[..., i]) for i in (slice(0, 4), 4, 5)))
    rgba = np.ascontiguousarray(in_light(pixels[..., order[:4]], back))
    more: dict[str, NDArray[np.float32]] = {}
    for name, row in _MORE.items():
        if set(row.channels) <= set(names):
            at = [names.index(channel) for channel in row.channels]
            layer = pixels[..., at] if len(at) > 1 else pixels[..., at[0]]
            layer = in_light(layer, back) if row.is_colour else layer
            more[name] = np.ascontiguousarray(layer)
    return FrozenFrame(rgba, depth, support, motion, metadata, beyond, grain, detail, more)


def read_key(path: str | Path) -> str | None:
    """`FrameMetadata.key` of a frame, from its header alone; None if the file cannot be read as one."""
    try:
        image = oiio.ImageInput.open(regular_file(path))
    except (OSError, ValueError):
        return None
    if image is None:
        oiio.geterror()  # clears the error, which the next caller would get
        return None
    try:
        return str(image.spec().getattribute("splannequin:key") or "")
    finally:
        image.close()


def _coarse(grain: NDArray[Any]) -> NDArray[np.float16]:
    """Grain [h,W,3] as half floats whose eight lowest bits are 0, and an alpha of 0: [h,W,4]."""
    half = np.clip(grain, -HALF_MAX, HALF_MAX).astype(np.float16)
    # Rounded to the nearest: cut off, it would lose a tenth of its strength.
    half = ((half.view(np.uint16) + np.uint16(0x80)) & np.uint16(0xFF00)).view(np.float16)
    return np.concatenate([half, np.zeros((*half.shape[:2], 1), np.float16)], axis=2)


def _eight_bits(values: NDArray[np.float32]) -> NDArray[np.float16]:
    """Values as half floats with 8 bits of mantissa, rounded to the nearest."""
    bits = np.clip(values, -HALF_MAX, HALF_MAX).view(np.uint32)
    return ((bits + np.uint32(0x4000)) & np.uint32(0xFFFF8000)).view(np.float32).clip(-HALF_MAX, HALF_MAX).astype("f2")


def _in_steps(plate: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.round(plate * _PLATE_STEPS) / _PLATE_STEPS


_STORED: dict[str, Callable[[NDArray[Any]], NDArray[Any]]] = {
    "grain": _coarse,
    "splat": _eight_bits,
    "plate": _in_steps,
}
"""What becomes of a layer's rows as they are written."""


def _stored(name: str, layer: Rows, matrix: NDArray[np.float32] | None) -> Rows:
    """A layer as its file has it: colours in the file's light, rounded as the layer's kind is."""
    change = _STORED.get(name, lambda rows: rows)
    if matrix is not None and len(layer.shape) == 3 and (name not in _MORE or _MORE[name].is_colour):
        return Made(layer.shape, lambda rows: change(in_light(layer[rows], matrix)))
    return Made(layer.shape, lambda rows: change(layer[rows])) if name in _STORED else layer


def _checked(layers: dict[str, ArrayLike | Made]) -> dict[str, Rows]:
    """`rgba` and layers like it as float32, those that are `Made` checked when they are. ValueError names a wrong one.

    Each has the size of `rgba`.
    """
    with np.errstate(over="ignore"):
        found: dict[str, Rows] = {
            name: layer if isinstance(layer, Made) else np.asarray(layer, dtype=np.float32)
            for name, layer in layers.items()
        }
    colour = found["rgba"].shape
    if len(colour) != 3 or colour[2] != 4 or not math.prod(colour):
        raise ValueError(f"rgba should be [H,W,4], got shape {tuple(colour)}")
    for name, layer in found.items():
        colours = len(_MORE[name].channels) if name in _MORE else 1
        expected = (*colour[:2], *_CHANNELS_OF.get(name, (colours,) if colours > 1 else ()))
        if tuple(layer.shape) != expected:
            raise ValueError(f"{name} should be {list(expected)} like rgba, got shape {list(layer.shape)}")
        if isinstance(layer, Made):
            found[name] = Made(layer.shape, functools.partial(_made, name, layer))
        elif isinstance(layer, np.ndarray):
            check_finite(name, cast(NDArray[Any], layer))
    return found


def _made(name: str, layer: Made, rows: slice) -> NDArray[np.float32]:
    """Some rows of a layer, float32. ValueError if they are not finite."""
    with np.errstate(over="ignore"):
        made = np.asarray(layer[rows], dtype=np.float32)
    check_finite(name, made, rows.start)
    return made


def check_finite(name: str, layer: NDArray[np.float32], top: int = 0) -> None:
    """ValueError names a layer [H,W,...] with NaN or infinity in it, and the first place; it begins in row `top`."""
    finite = np.isfinite(layer)
    if not finite.all():
        y, x, *_ = np.argwhere(~finite)[0]
        count, place = finite.size - finite.sum(), (int(x), int(top + y))
        raise ValueError(f"{name} has {count} NaN or infinite values, the first at {place}")


def frame_spec(
    width: int, height: int, names: tuple[str, ...], formats: tuple[oiio.BASETYPE, ...], metadata: FrameMetadata
) -> oiio.ImageSpec:
    """What the EXR of a frame begins with, ZIP-compressed. ValueError on matrices or an instant that are none."""
    viewmat = np.asarray(metadata.viewmat, dtype=np.float32)
    intrinsics = np.asarray(metadata.K, dtype=np.float32)
    for name, matrix, shape in (("viewmat", viewmat, (4, 4)), ("K", intrinsics, (3, 3))):
        if matrix.shape != shape or not np.isfinite(matrix).all():
            raise ValueError(f"metadata.{name} should be a finite matrix of shape {shape}, got {matrix.tolist()}")
    if not math.isfinite(metadata.t_star_frame):
        raise ValueError(f"metadata.t_star_frame should be finite, got {metadata.t_star_frame}")
    spec = linear_spec(width, height, names, formats, metadata.light)
    spec.attribute("worldToCamera", oiio.TypeDesc("matrix"), _flat((_FLIP_YZ @ viewmat).T))
    spec.attribute("splannequin:viewmat", oiio.TypeDesc("matrix"), _flat(viewmat))
    spec.attribute("splannequin:K", oiio.TypeDesc("matrix33"), _flat(intrinsics))
    spec.attribute("splannequin:frame", int(metadata.frame))
    spec.attribute("splannequin:tStarFrame", float(metadata.t_star_frame))
    spec.attribute("splannequin:depthUnits", metadata.depth_units)
    if metadata.timecode:
        spec.attribute("smpte:TimeCode", oiio.TypeDesc("timecode"), smpte_bits(metadata.timecode))
    spec.attribute("splannequin:version", int(metadata.version))
    if metadata.key:
        spec.attribute("splannequin:key", metadata.key)
    return spec


def linear_spec(
    width: int, height: int, names: tuple[str, ...], formats: tuple[oiio.BASETYPE, ...], light: str = LIGHTS[0]
) -> oiio.ImageSpec:
    """What a ZIP-compressed EXR of scene-linear light, one of `LIGHTS`, with these channels begins with."""
    spec = oiio.ImageSpec(width, height, len(names), formats[0])
    spec.channelnames = names
    if len(set(formats)) > 1:  # else the writer passes over them
        spec.channelformats = formats
    spec.attribute("compression", "zip")
    spec.attribute("DateTime", "")  # else the writer puts the hour there: a frame is the same whenever it was made
    spec.attribute("oiio:ColorSpace", COLOR_SPACE.format(light))
    spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), PRIMARIES[light][1])
    if light != LIGHTS[0]:
        spec.attribute("splannequin:probe", oiio.TypeDesc("vector"), InputSpace("lin", light).probe)
    return spec


def read_light(spec: oiio.ImageSpec) -> str:
    """Which of `LIGHTS` a file of `linear_spec` holds."""
    return light_of_chromaticities(cast(Any, spec).getattribute("chromaticities"))


def _flat(matrix: NDArray[Any]) -> tuple[float, ...]:
    return tuple(float(value) for value in matrix.ravel())


def _metadata(spec: oiio.ImageSpec, path: Path) -> FrameMetadata:
    names = ("frame", "tStarFrame", "viewmat", "K", "depthUnits", "version")
    values = {name: spec.getattribute(f"splannequin:{name}") for name in names}
    missing = [name for name, value in values.items() if value is None]
    if missing:
        raise UserError(f"{path}: not a frozen frame, it has no attribute splannequin:{missing[0]}")
    if values["version"] > EXR_VERSION:
        raise UserError(f"{path}: written by a newer version ({values['version']}, this one reads {EXR_VERSION})")
    return FrameMetadata(
        frame=int(values["frame"]),
        t_star_frame=float(values["tStarFrame"]),
        viewmat=np.array(values["viewmat"], dtype=np.float32).reshape(4, 4),
        K=np.array(values["K"], dtype=np.float32).reshape(3, 3),
        depth_units=str(values["depthUnits"]),
        version=int(values["version"]),
        key=str(spec.getattribute("splannequin:key") or ""),
        light=read_light(spec),
        timecode=parse_timecode(str(spec.get_string_attribute("smpte:TimeCode"))),
    )


def write_error(message: str, path: Path, byte_count: int) -> OSError:
    """OSError with the system's reason, which libraries pass on only in words, if at all. `byte_count`: of the file."""
    code = next((c for c in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG) if os.strerror(c) in message), None)
    if code is None:
        code = errno.ENOSPC if shutil.disk_usage(path.parent).free < byte_count else errno.EIO
    return OSError(code, f"EXR not written: {message.strip() or os.strerror(code)}", str(path))
