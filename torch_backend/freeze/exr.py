"""Reads and writes frozen frames as single-part OpenEXR: colour, depth, mattes and sources of the pixels.

Channel names are the result of tests with the bpy wheels 4.2.23, 4.5.15, 5.0.1 and 5.2.3. With `CHANNELS`, Blender
loads the file as MULTILAYER, "Linear Rec.709". In all four versions, the compositor's Image node has the sockets
Combined, Alpha, Depth, Motion and Support, with bit-exact values. R G B A Z have no prefix, so Nuke and other readers
show `rgba` and `depth` directly, and `Support` and `Motion` as layers. `GRAIN_CHANNELS` add a colour socket Grain.
`DETAIL_CHANNELS` add a colour socket Splat and value sockets Plate and Source.

Rejected: `Frozen.Combined.R ...` (the same sockets, but no plain RGBA in other programs); plain RGBA with
`Frozen.Support.V` (a second layer, so the mattes are not on the same node); a single `.R` or `.A` in a matte (crashes
5.2.3 with corrupted memory).
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import shutil
from collections.abc import Callable, Generator, Mapping, Sequence
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
from .exr_rows import Packing

CHANNELS = channels_of("")
"""Channel names in the order of the arrays: colour, depth, support matte, motion matte."""
GRAIN_CHANNELS = channels_of("grain")
"""Channel names of the grain; optional in a frame."""
DETAIL_CHANNELS = channels_of("detail")
"""Channel names of `DetailLayers`; missing in a frame of splats alone."""
HALF_MAX = 65504.0
"""Largest finite half float; brighter colour is clamped to it."""
EXR_VERSION = 1
"""Version of the `splannequin:` attributes."""
COLOR_SPACE = "lin_{}_scene"
"""Format string of the name of a scene-linear colour space (ASWF colour interop ID, stored as `colorInteropID`)."""

_STORAGE = {"half": oiio.HALF, "float": oiio.FLOAT}
_FORMATS, _GRAIN_FORMATS, _DETAIL_FORMATS = (
    tuple(_STORAGE[layer.stored] for layer in layers_of(part) for _ in layer.channels)
    for part in ("", "grain", "detail")
)
_PARTS = ("", "grain", "detail")
"""Parts whose layers are separate arguments of `write_frozen_exr`; all other layers are passed in `more`."""
_MORE = {layer.name: layer for layer in FRAME_LAYERS if layer.part not in _PARTS}
_CHANNELS_OF = {"rgba": (4,), "splat": (4,), "grain": (3,)}
ROWS = 64
"""Number of rows that are computed and written at a time."""
_FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class FrameMetadata:
    """Metadata of a frozen frame, stored as EXR attributes."""

    frame: int
    """Frame number in the clip's own numbering."""
    t_star_frame: float
    """Frozen instant, as a (fractional) frame number of the clip."""
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
    """Primaries of the light in the file, one of `LIGHTS`. Arrays in memory are always Rec.709."""


class Rows(Protocol):
    """A layer [H,W,...] that can be sliced by rows: an array or `LazyLayer`."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    def __getitem__(self, rows: slice, /) -> NDArray[Any]: ...


@dataclass(frozen=True)
class LazyLayer:
    """A layer that is computed while it is written, some rows at a time, to save memory."""

    shape: tuple[int, ...]
    """[H,W] or [H,W,C]."""
    rows: Callable[[slice], NDArray[Any]]
    """Function that returns the requested rows, any float dtype. It is called once per slice, from the top."""

    def __getitem__(self, rows: slice, /) -> NDArray[Any]:
        return self.rows(rows)


@dataclass(frozen=True, eq=False)
class DetailLayers:
    """Sources of the pixels of a frame that is composited from plates and splats."""

    splat: ArrayLike | LazyLayer
    """[H,W,4] scene-linear, premultiplied: the frame rendered from splats alone."""
    plate: ArrayLike
    """[H,W] in 0..1: share of the pixel that comes from plates. 0: all of it comes from splats."""
    source: ArrayLike
    """[H,W] frame number of the plate with the largest share; 0 where `plate` is 0."""


@dataclass(frozen=True, eq=False)
class FrozenFrame:
    """One frozen frame as read from a file."""

    rgba: NDArray[np.float32]
    """[H,W,4] scene-linear, premultiplied."""
    depth: NDArray[np.float32]
    """[H,W] planar depth along the camera's axis, in `metadata.depth_units`; 1e10 where alpha is 0."""
    support: NDArray[np.float32]
    """[H,W] in 0..1. 1: the surface is static, or a frame near t* shows it. 0: no frame shows its state at t*."""
    motion: NDArray[np.float32]
    """[H,W] in 0..1: share of the pixel that moves in the clip."""
    metadata: FrameMetadata
    margin: tuple[int, int] = (0, 0)
    """Pixels of overscan (left and right, above and below), included in the arrays."""
    grain: NDArray[np.float32] | None = None
    """[H,W,3] scene-linear, premultiplied: the plate's grain, to be added to `rgba`. None: not in the file."""
    detail: DetailLayers | None = None
    """Sources of the pixels, float32. None: the frame is of splats alone."""
    more: Mapping[str, NDArray[np.float32]] = field(default_factory=dict[str, NDArray[np.float32]])
    """Other layers of `FRAME_LAYERS` in the file, by name: [H,W], or [H,W,C] for several channels."""


def write_frozen_exr(
    path: str | Path,
    rgba: ArrayLike | LazyLayer,  # [H,W,4]
    depth: ArrayLike | LazyLayer,  # [H,W]
    support: ArrayLike | LazyLayer,  # [H,W]
    motion: ArrayLike | LazyLayer,  # [H,W]
    metadata: FrameMetadata,
    margin: tuple[int, int] = (0, 0),
    grain: ArrayLike | LazyLayer | None = None,  # [H,W,3]
    detail: DetailLayers | None = None,
    more: Mapping[str, ArrayLike | LazyLayer] | None = None,  # [H,W] or [H,W,4]
) -> Path:
    """Writes one frame atomically: half colour and mattes, float32 depth and `source`, ZIP. Arrays as in `FrozenFrame`.

    Grain is noise, which does not compress. It is therefore stored with 2 bits of mantissa and a relative error of at
    most 1/8, and adds a third less to the file (0.74 instead of 1.25 MB at 640 x 480). `splat` is stored with 8 bits of
    mantissa, four times finer than 8-bit sRGB, and `plate` in steps of 1/256. With `source` they add 0.95 MB instead of
    1.29 MB.

    Colours are converted from Rec.709 to the primaries `metadata.light`.

    Attributes:
    - `chromaticities` and `colorInteropID` of these primaries, and `splannequin:probe` (see `contract.PROBE`) if they
      are not Rec.709.
    - `worldToCamera`, the OpenEXR standard matrix, in the renderer axes of Blender and Nuke (x right, y up, looking
      along -z). It is for Imath's row vectors: p_camera = p_world @ M, translation in the last row.
    - `splannequin:viewmat` and `splannequin:K`, row-major as in `FrameMetadata`.
    - `splannequin:frame`, `:tStarFrame`, `:depthUnits`, `:version`, `:key`.

    Half channels are clamped to +-65504.

    With a `margin` the arrays are the data window. The display window is the frame inside of it, and K counts in its
    pixels. Blender 4.2 to 5.2 reads the whole data window and centres it in the render, wherever the display window is;
    margins are therefore equal on opposite sides.

    `more` holds other layers of `FRAME_LAYERS`, by name. KeyError if the table has no layer of that name.

    `LazyLayer`s are computed while they are written. ValueError names the layer whose shape is wrong or that
    holds NaN or infinity; OSError if the file cannot be written (errno ENOSPC when the disk is full).
    """
    path = Path(path)
    layers = {"rgba": rgba, "depth": depth, "support": support, "motion": motion}
    names, formats = CHANNELS, _FORMATS
    if grain is not None:
        layers |= {"grain": grain, "alpha of the grain": np.broadcast_to(np.float32(0.0), tuple(np.shape(depth)))}
        names, formats = names + GRAIN_CHANNELS, formats + _GRAIN_FORMATS
    if detail is not None:
        layers |= {"splat": detail.splat, "plate": detail.plate, "source": detail.source}
        names, formats = names + DETAIL_CHANNELS, formats + _DETAIL_FORMATS
    for name, layer in (more or {}).items():
        row = _MORE[name]
        layers[name] = layer
        names, formats = names + row.channels, formats + (_STORAGE[row.stored],) * len(row.channels)
    matrix = light_matrix(metadata.light)
    parts = {name: _in_primaries(name, layer, matrix) for name, layer in _checked(layers).items()}
    height, width = parts["rgba"].shape[:2]
    spec = frame_spec(width, height, names, formats, metadata)
    set_margin(spec, margin)
    return write_exr(path, spec, [*parts.values()], [*parts])


def set_margin(spec: oiio.ImageSpec, margin: tuple[int, int]) -> None:
    """Sets the display window of `spec` to the picture without `margin` pixels (left and right, above and below).

    ValueError if the display window would be empty.
    """
    across, down = margin
    if not (0 <= 2 * across < spec.width and 0 <= 2 * down < spec.height):
        raise ValueError(f"a margin of {margin} pixels leaves nothing of {spec.width} x {spec.height}")
    spec.x, spec.y = -across, -down
    spec.full_x, spec.full_y = 0, 0
    spec.full_width, spec.full_height = spec.width - 2 * across, spec.height - 2 * down


def write_exr(path: Path, spec: oiio.ImageSpec, parts: Sequence[Rows], names: Sequence[str] = ()) -> Path:
    """Writes layers [H,W,c] or [H,W], whose channels are those of `spec` in order, atomically and ZIP-compressed.

    Half channels are clamped to +-65504. Rows are written in bands, because all layers of a 4K frame have half a
    gigabyte. Layers with `names` must be finite: ValueError names a bad one. OSError as `write_frozen_exr`.
    """
    packing = Packing(spec, names or [""] * len(parts))
    plain, header = packing.disguised()

    def rows(output: Any, top: int) -> bool:
        of = slice(top, min(top + ROWS, spec.height))
        with np.errstate(over="ignore"):
            values = [np.asarray(part[of], np.float32) for part in parts]
        packed, infinite = packing.packed(values)
        for name in filter(None, infinite):
            check_finite(name, values[list(names).index(name)], top)
        begin = spec.y + top
        return bool(output.write_scanlines(begin, begin + len(packed), 0, packed[..., None]))

    return write_picture(path, plain, rows, header)


def write_picture(path: Path, spec: oiio.ImageSpec, rows: Callable[[Any, int], bool], header: bytes = b"") -> Path:
    """Writes a picture atomically. `rows(output, top)` writes `ROWS` rows from row `top` and returns False on failure.

    `header` replaces the first bytes of the file. OSError with the system's reason, as `write_frozen_exr`.
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
            output.close()  # Windows cannot remove an open file
            raise
        if not (good and output.close()):
            raise write_error(output.geterror(), path, spec.height * spec.width * 4 * spec.nchannels)
        with open(partial, "rb+") as handle:
            handle.write(header)
    return path


def channel_names(spec: oiio.ImageSpec) -> list[str]:
    """Names of a file's channels, in file order."""
    return list(cast(Any, spec).channelnames)


_Facts = TypeVar("_Facts")


@contextlib.contextmanager
def _opened(path: Path) -> Generator[oiio.ImageInput]:
    """An open EXR. Raises FileNotFoundError if there is no file, UserError if it cannot be read."""
    if not path.is_file():
        raise FileNotFoundError(errno.ENOENT, "no such EXR", str(path))
    image = oiio.ImageInput.open(regular_file(path))
    if image is None:
        raise UserError(f"{path}: cannot be read as EXR: {error_of()}")
    try:
        yield image
    finally:
        image.close()


def read_layers(
    path: Path, channels: Sequence[str], what: str, metadata: Callable[[oiio.ImageSpec, Path], _Facts]
) -> tuple[oiio.ImageSpec, list[str], _Facts, NDArray[np.float32]]:
    """(spec, names of the channels, metadata, pixels [H, W, C] float32) of an EXR that has at least `channels`.

    `what` is the message for a file without these channels ("not a frozen frame"). FileNotFoundError if there is no
    file; ValueError if it cannot be read or lacks a channel, or if `metadata` raises it.
    """
    with _opened(path) as image:
        spec = image.spec()
        names = channel_names(spec)
        missing = [name for name in channels if name not in names]
        if missing:
            raise UserError(f"{path}: {what}, it has no channel {', '.join(missing)}")
        facts = metadata(spec, path)
        pixels = image.read_image(oiio.FLOAT)
        if pixels is None:
            raise UserError(f"{path}: damaged, {error_of(image)}")
    return spec, names, facts, np.asarray(pixels, dtype=np.float32)


def read_frozen_exr(path: str | Path) -> FrozenFrame:
    """Reads a file of `write_frozen_exr`; all arrays are float32.

    FileNotFoundError if there is no file; ValueError if it cannot be read, is not a frozen frame, or is from a newer
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


def read_metadata(path: str | Path) -> FrameMetadata:
    """Metadata of a file of `write_frozen_exr`, from its header. Raises as `read_frozen_exr`."""
    path = Path(path)
    with _opened(path) as image:
        return _metadata(image.spec(), path)


def read_key(path: str | Path) -> str | None:
    """`FrameMetadata.key` of a file, from its header; None if the file cannot be read."""
    try:
        with _opened(Path(path)) as image:
            return str(image.spec().getattribute("splannequin:key") or "")
    except (OSError, ValueError):
        return None


def _in_primaries(name: str, layer: Rows, matrix: NDArray[np.float32] | None) -> Rows:
    """A layer as stored in the file: colours converted by `matrix` to the file's primaries."""
    if matrix is not None and len(layer.shape) == 3 and (name not in _MORE or _MORE[name].is_colour):
        return LazyLayer(layer.shape, lambda rows: in_light(layer[rows], matrix))
    return layer


def _checked(layers: dict[str, ArrayLike | LazyLayer]) -> dict[str, Rows]:
    """The layers as float32. ValueError names a layer that has not the size of `rgba`."""
    with np.errstate(over="ignore"):
        found: dict[str, Rows] = {
            name: layer if isinstance(layer, LazyLayer) else np.asarray(layer, dtype=np.float32)
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
    return found


def check_finite(name: str, layer: NDArray[np.float32], top: int = 0) -> None:
    """Raises ValueError if a layer [H,W,...] has NaN or infinity. `top`: row of the picture in which it starts."""
    finite = np.isfinite(layer)
    if not finite.all():
        y, x, *_ = np.argwhere(~finite)[0]
        count, place = finite.size - finite.sum(), (int(x), int(top + y))
        raise ValueError(f"{name} has {count} NaN or infinite values, the first at {place}")


def frame_spec(
    width: int, height: int, names: tuple[str, ...], formats: tuple[oiio.BASETYPE, ...], metadata: FrameMetadata
) -> oiio.ImageSpec:
    """Header of a frame's EXR, ZIP-compressed. ValueError if a matrix is invalid or the instant is not finite."""
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
    """Header of a ZIP-compressed EXR with these channels, scene-linear with the primaries `light`, one of `LIGHTS`."""
    spec = oiio.ImageSpec(width, height, len(names), formats[0])
    spec.channelnames = names
    if len(set(formats)) > 1:  # the writer ignores them otherwise
        spec.channelformats = formats
    spec.attribute("compression", "zip")
    spec.attribute("DateTime", "")  # otherwise the writer stores the current time, and files would differ
    spec.attribute("oiio:ColorSpace", COLOR_SPACE.format(light))
    spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), PRIMARIES[light][1])
    if light != LIGHTS[0]:
        spec.attribute("splannequin:probe", oiio.TypeDesc("vector"), InputSpace("lin", light).probe)
    return spec


def read_light(spec: oiio.ImageSpec) -> str:
    """Primaries of a file of `linear_spec`, one of `LIGHTS`."""
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
    """OSError with an errno derived from a library's `message` and the free disk space, because libraries return only
    text. `byte_count`: size of the file."""
    code = next((c for c in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG) if os.strerror(c) in message), None)
    if code is None:
        code = errno.ENOSPC if shutil.disk_usage(path.parent).free < byte_count else errno.EIO
    return OSError(code, f"EXR not written: {message.strip() or os.strerror(code)}", str(path))
