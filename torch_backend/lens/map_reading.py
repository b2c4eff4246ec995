"""Reads the lens from an imported ST map, or reports why the file holds none.

Red is s, 0 to 1 from left to right. Green is t, 0 to 1 from the bottom (Nuke's STMap, Flame, Blender's Map UV) or from
the top; the sign of its slope shows which. Coordinates refer to the whole picture that is sampled; the centre of pixel
i lies at (i + 0.5) / size. The display window of the file is the map's picture. Pixels outside of that window, and a
map larger than the footage, are overscan. A map does not state its direction, so `--st-map-way` does:

    undistort   a map of the undistorted picture, with coordinates in the original (undistorts a plate)
    redistort   a map of the original picture, with coordinates in the undistorted one (distorts a render)

Pixels that are 0 in both channels, transparent, or clipped at 0 or 1 are ignored.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from ..contract import LONGEST_PICTURE, ST_MAP_WAYS, ExitCode, JobError, Reporter, open_regular, regular_file
from ..footage.images import check_size, error_of
from ..footage.oiio_types import bits_of, channel_names
from .map_lens import MapLens, Polynomial, fitted, widest

UNDISTORT, REDISTORT = ST_MAP_WAYS
PAIRS = (("r", "g"), ("red", "green"), ("u", "v"), ("s", "t"), ("x", "y"))
"""Known names of the two channels, in lower case."""
DEGREES = (1, 3, 5, 7, 9, 11, 13, 15)
CLOSE_PX = 5e-3
"""Largest error of a polynomial, in pixels of the footage, at which the search for a better fit stops."""
ROUGH_PX = 0.1
"""Largest accepted error in pixels, in addition to the rounding of the file. Above it, the map is not smooth."""
NO_GAIN = 0.996
"""Largest ratio of new to old error at which a higher degree counts as better. Above it, only noise remains."""
STRAIGHT_PX = 0.05
"""Largest distortion in pixels of a map without a lens."""
SHAPE = 0.03
"""Tolerance for the ratio of the scales along x and y in the middle of the picture, as a natural logarithm."""
# Margin around the original picture within which values of an undistorting map are used, as a share of the picture.
_CUT = 0.02
_SAMPLES, _CHECKED = 8_000, 60_000
_LEAST_SHARE = 0.5
_LARGEST = 32_768


@dataclass
class _Map:
    """Contents of an ST map file."""

    s: NDArray[np.float64]
    """[h, w]: to the right, 0 to 1."""
    t: NDArray[np.float64]
    """[h, w]: up or down as in the file, 0 to 1."""
    known: NDArray[np.bool_]
    """[h, w]: True where the map holds coordinates."""
    at: tuple[int, int]
    """Column and row of the first pixel within the display window."""
    size: tuple[int, int]
    """Width and height of the display window, pixels."""
    rounding: float
    """Largest step between two values of the file near 1."""


def fingerprint(path: str) -> str:
    """SHA-256 of a map's file. Raises JobError (USAGE) if the file cannot be read."""
    digest = hashlib.sha256()
    try:
        with open_regular(path, LONGEST_PICTURE) as source:
            while block := source.read(1 << 20):
                digest.update(block)
    except OSError as error:
        raise _refused(f"The ST map {path} cannot be read: {error.strerror or error}.", "Check the path.") from error
    return digest.hexdigest()


def read_lens(path: str, way: str, layer: str, frames: dict[str, Any], report: Reporter) -> MapLens:
    """The lens of an ST map for the working frames.

    Args:
        path: file of the map.
        way: one of `contract.ST_MAP_WAYS`.
        layer: layer of the map; empty: red and green without a layer name, or the only pair of channels.
        frames: contents of frames.json of the import.
        report: receives warnings about assumptions and about parts that the map lacks.

    Returns:
        The lens with the widest window that has no empty pixels, without intrinsics.

    Raises:
        JobError: (USAGE or SOLVE) the file holds no usable map.
    """
    name = f"The ST map {Path(path).name}"
    read = _read(Path(path), layer, name)
    size = int(frames["width"]), int(frames["height"])
    source = tuple(int(n) for n in frames.get("source_size") or size)
    scale = np.array(source, np.float64)
    undistorted, original = _samples(read, way, name, report)
    if read.rounding * scale.max() > ROUGH_PX:
        report.warning(
            f"{name} has 16-bit floats, with steps of up to {read.rounding * float(scale.max()):.1f} pixels of this "
            "footage: it is smoothed.",
            "Export it with 32 bits.",
        )
    found = _fit(undistorted, original, read, scale)
    if found.errors.max() > ROUGH_PX + 2.0 * read.rounding * scale.max():
        worst = (undistorted if way == UNDISTORT else original)[int(found.errors.argmax())] * read.size
        raise _refused(
            f"{name} is not a smooth map of a lens: at column {worst[0]:.0f}, row {worst[1]:.0f} it differs by "
            f"{found.errors.max():.2f} pixels from its surroundings.",
            "Export only the lens, without stabilisation, as an uncompressed or zip-compressed 32-bit EXR.",
        )
    _check_bend(found, name, scale, read.rounding, report)
    aspect = float(frames.get("reading", {}).get("pixel_aspect", 1.0))
    lens = MapLens(size[0], size[1], found.bend, found.forward)
    shape = _shape(read, lens, way, source, aspect, name)
    half = 0.5 / np.array(read.size)
    known = (*(undistorted.min(0) - half), *(undistorted.max(0) + half)) if way == UNDISTORT else None
    lens = widest(lens, shape, known)
    lens.check()
    if known is not None:
        _warn_uncovered(lens, known, name, report)
    return lens


# ------------------------------------------------------------------------------------------------- the file


def _read(path: Path, layer: str, name: str) -> _Map:
    """Reads the two channels and the mask of valid pixels. Raises JobError (USAGE) as `read_lens` does."""
    opened = oiio.ImageInput.open(regular_file(path)) if path.is_file() else None
    if opened is None:
        why = error_of() if path.is_file() else "it does not exist"
        raise _refused(f"{name} cannot be read: {why.rstrip('.')}.", "Choose an EXR file.")
    try:
        part, channels, alpha = _channels(opened, layer, name)
        opened.seek_subimage(part, 0)
        spec = opened.spec()
        bits = bits_of(spec)
        kind = str(spec.format)
        if kind not in ("float", "half", "double", "uint16", "uint") or bits <= 12:
            raise _refused(
                f"{name} has {bits} bits per channel, which is too coarse for positions within a pixel.",
                "Export it as a 32-bit EXR.",
            )
        check_size(name, spec)
        if max(spec.full_width, spec.full_height, spec.width, spec.height) > _LARGEST:
            raise _refused(
                f"{name} is {spec.full_width} x {spec.full_height}.", f"Use at most {_LARGEST} pixels per side."
            )
        pixels = opened.read_image(part, 0, 0, spec.nchannels, oiio.FLOAT)
        if pixels is None:
            raise _refused(f"{name} cannot be read: {error_of(opened)}.", "Export it again.")
    finally:
        opened.close()
    pixels = np.asarray(pixels, np.float64).reshape(spec.height, spec.width, -1)
    s, t = pixels[..., channels[0]], pixels[..., channels[1]]
    invalid = ~(np.isfinite(s) & np.isfinite(t))
    if invalid.any():
        row, column = np.argwhere(invalid)[0]
        raise _refused(
            f"{name} contains {int(invalid.sum())} pixels that are not numbers (NaN), the first at column {column}, "
            f"row "
            f"{row}.",
            "Export it without them: 0 in both channels marks an empty pixel.",
        )
    known = (s != 0.0) | (t != 0.0)
    if alpha is not None:
        known &= pixels[..., alpha] > 0.0
    if min(s.min(), t.min()) >= 0.0 and max(s.max(), t.max()) <= 1.0:  # values are clipped
        known &= (s > 0.0) & (s < 1.0) & (t > 0.0) & (t < 1.0)
    rounding = {"half": 2.0**-11, "uint16": 2.0**-16}.get(kind, 2.0**-24)
    at = spec.x - spec.full_x, spec.y - spec.full_y
    return _Map(s, t, known, at, (spec.full_width, spec.full_height), rounding)


def _channels(opened: oiio.ImageInput, layer: str, name: str) -> tuple[int, tuple[int, int], int | None]:
    """(part, the two channels, alpha or None). Raises JobError if the choice is ambiguous, and lists the layers."""
    found: list[tuple[str, int, tuple[int, int], int | None]] = []
    part = 0
    while opened.seek_subimage(part, 0) and (part == 0 or opened.format_name() == "openexr"):
        spec = opened.spec()
        named = [one.lower() for one in channel_names(spec)]
        several = spec.get_int_attribute("oiio:subimages") > 1
        title = str(spec.getattribute("oiio:subimagename") or "") if several else ""
        for prefix in dict.fromkeys(one.rpartition(".")[0] for one in named):
            dot = prefix + "." if prefix else ""
            pair = next((p for p in PAIRS if all(dot + one in named for one in p)), None)
            if pair is not None:
                alpha = named.index(dot + "a") if dot + "a" in named else None
                places = named.index(dot + pair[0]), named.index(dot + pair[1])
                found.append((prefix or title.lower(), part, places, alpha))
        part += 1
    names = ", ".join(one[0] or "red and green without a name" for one in found)
    layer_name = layer.lower()
    matching = [x for x in found if not layer_name or layer_name in (x[0], x[0].rpartition(".")[2])]
    if not found:
        raise _refused(f"{name} has no red and green channel.", "Write s into red and t into green.")
    if not matching:
        raise _refused(f"{name} has no layer {layer!r} with two channels of coordinates.", f"It has: {names}.")
    plain = [x for x in matching if not x[0]] if not layer_name else [x for x in matching if x[0] == layer_name]
    if len(matching) > 1 and len(plain) != 1:
        raise _refused(f"{name} has several layers that could be the map: {names}.", "Choose one: --st-map-layer.")
    chosen = (plain or matching)[0]
    return chosen[1], chosen[2], chosen[3]


# ------------------------------------------------------------------------------------------------- the fitted lens


def _samples(read: _Map, way: str, name: str, report: Reporter) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corresponding points in the undistorted picture [N, 2] and in the original [N, 2], y down, 0 to 1.

    Raises JobError as `read_lens` does.
    """
    columns, rows = (_spread(length) for length in read.s.shape[::-1])
    at = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)
    known = read.known[at[:, 1], at[:, 0]]
    points = (at + 0.5 + read.at) / read.size
    values = np.stack([read.s[at[:, 1], at[:, 0]], read.t[at[:, 1], at[:, 0]]], -1)
    valid = known & ((points > 0.0) & (points < 1.0)).all(1)
    if valid.sum() < _LEAST_SHARE * ((points > 0.0) & (points < 1.0)).all(1).sum() or valid.sum() < 100:
        raise _refused(
            f"{name} has coordinates in only {100 * float(valid.mean()):.0f} % of its picture.",
            "Check that it is an ST map: red should grow from left to right, green from bottom to top.",
        )
    slope = fitted(points[valid], values[valid], 1, (0.0, 0.0, 1.0, 1.0)).slopes(np.array([[0.5, 0.5]]))[0]
    across, down = float(slope[0, 0]), float(slope[1, 1])
    if max(abs(float(slope[0, 1])), abs(float(slope[1, 0]))) > min(abs(across), abs(down)):
        raise _refused(f"{name} has s and t swapped, or is rotated.", "Red should be s, and green t.")
    if abs(across) < 0.25 or abs(down) < 0.25:
        raise _refused(
            f"{name} contains no coordinates: red grows by {across:.3f} from left to right, but about 1 is expected.",
            "If it stores displacements, add each pixel's own position, (x + 0.5) / width and (y + 0.5) / height.",
        )
    if across < 0.0:
        raise _refused(
            f"{name} is mirrored: its red falls from left to right.", "Flip it, and the footage in the same way."
        )
    if across > 8.0 or abs(down) > 8.0:
        raise _refused(
            f"{name} contains pixels (up to {float(np.abs(values[valid]).max()):.0f}) instead of coordinates from 0 to "
            "1.",
            "Divide red by the width and green by the height of the source picture.",
        )
    if down > 0.0:
        report.warning(f"{name} counts t from the top, and is read that way.")
    else:
        values[:, 1] = 1.0 - values[:, 1]
    if way == REDISTORT:
        return values[known], points[known]
    valid = known & ((values > -_CUT) & (values < 1.0 + _CUT)).all(
        1
    )  # lens models are arbitrary outside of the picture
    return points[valid], values[valid]


def _spread(length: int) -> NDArray[np.int64]:
    """Evenly spaced indices of an axis, including both ends."""
    return np.unique(np.linspace(0, length - 1, min(length, round(_CHECKED**0.5))).round().astype(np.int64))


@dataclass
class _Fit:
    """A polynomial fitted to a map."""

    bend: Polynomial
    forward: bool
    """True if `bend` maps the undistorted picture to the original; False for the opposite direction."""
    points: NDArray[np.float64]
    """[N, 2]: input points of the fit."""
    errors: NDArray[np.float64]
    """[N]: error at each point, in pixels of the footage."""

    @property
    def error(self) -> float:
        """Root mean square of `errors`."""
        return float(np.sqrt((self.errors**2).mean()))


def _fit(
    undistorted: NDArray[np.float64], original: NDArray[np.float64], read: _Map, scale: NDArray[np.float64]
) -> _Fit:
    """Fits the polynomial of the lowest sufficient degree to corresponding points [N, 2], in the better direction."""
    sample = np.unique(np.linspace(0, len(original) - 1, _SAMPLES).astype(np.int64))
    # Include the outermost known points, which keep the polynomial stable at the border.
    sample = np.union1d(sample, np.flatnonzero((np.abs(undistorted - 0.5) >= np.abs(undistorted - 0.5).max(0)).any(1)))

    def tried(degree: int, forward: bool) -> _Fit:
        points, values = (undistorted, original) if forward else (original, undistorted)
        half = 0.5 / np.array(read.size)
        box = (*(points.min(0) - half), *(points.max(0) + half))
        bend = fitted(points[sample], values[sample], degree, box)
        return _Fit(bend, forward, points, np.hypot(*((bend(points) - values) * scale).T))

    best: dict[bool, _Fit] = {}
    for degree in DEGREES:
        for forward in (True, False):
            candidate, before = tried(degree, forward), best.get(forward)
            if candidate.errors.max() < CLOSE_PX:
                return candidate
            if before is None or candidate.error < NO_GAIN * before.error:
                best[forward] = candidate
        better = min(best.values(), key=lambda one: one.error)
        if better.bend.degree < degree and better.error < read.rounding * scale.max():
            break  # the remaining error is the rounding of the file
    return min(best.values(), key=lambda one: one.error)


def _check_bend(found: _Fit, name: str, scale: NDArray[np.float64], rounding: float, report: Reporter) -> None:
    """Raises JobError for a map that folds over or only shifts. Warns about a map without distortion."""
    grid = found.points[:: max(1, len(found.points) // 20_000)]
    determinants = np.linalg.det(found.bend.slopes(grid))
    if not determinants.min() > 0.0:
        worst = 100.0 * grid[int(determinants.argmin())]
        raise _refused(
            f"{name} folds over: at {worst[0]:.0f} % of the width and {worst[1]:.0f} % of the height, two of its "
            "pixels point to the same place.",
            "Export it with less overscan, or with 0 in both channels there.",
        )
    at, seen = (grid - 0.5) * scale, (found.bend(grid) - 0.5) * scale
    plain = np.concatenate([at, np.ones((len(at), 1))], 1)  # inputs of an affine fit
    affine = np.linalg.lstsq(plain, seen, rcond=None)[0]
    if np.abs(plain @ affine - seen).max() > STRAIGHT_PX + rounding * scale.max():
        return
    shift = affine[2] if found.forward else -affine[2]
    if np.abs(shift).max() > 2.0 * STRAIGHT_PX + 0.5 * rounding * scale.max():
        raise _refused(
            f"{name} has no distortion, but moves the whole picture by {shift[0]:.2f} and {shift[1]:.2f} pixels.",
            "A pixel's centre is at (i + 0.5) / size: with i / size, everything is off by half a pixel.",
        )
    report.warning(f"{name} has no distortion: the footage is treated as undistorted.")


def _shape(read: _Map, lens: MapLens, way: str, source: tuple[int, ...], aspect: float, name: str) -> float:
    """Width over height of the undistorted picture in square pixels. JobError if the map is of another picture."""
    # The window of this lens is the map's whole picture.
    # In the middle of a lens, the scales along x and y are equal. So they tell the aspect ratio for any overscan.
    slope = lens.slopes_in_the_middle
    width, height = read.size
    footage_shape = source[0] / source[1]
    fits: dict[float, float] = {}
    for stretch in {1.0, aspect}:  # a map for anamorphic footage has square pixels, or the pixels of the footage
        map_shape = stretch * width / height
        if way == UNDISTORT:
            fits[map_shape] = slope[0] / slope[1] * footage_shape / map_shape
        elif abs(map_shape / footage_shape - 1.0) < 0.01:
            fits[footage_shape] = slope[0] / slope[1]
    best = min(fits, key=lambda map_shape: abs(math.log(fits[map_shape])), default=None)
    if best is None or abs(math.log(fits[best])) > SHAPE:
        raise _refused(
            f"{name} is {width} x {height}, the footage {source[0]} x {source[1]}: their aspect ratios differ.",
            "Use a map at the footage's size, with overscan added if needed.",
        )
    return best


def _warn_uncovered(lens: MapLens, known: tuple[Any, ...], name: str, report: Reporter) -> None:
    """Warns if redistortion needs coordinates outside of the map."""
    x, y = np.linspace(0.5, lens.width - 0.5, 41), np.linspace(0.5, lens.height - 0.5, 41)
    at = lens.map_of_plate(lens.to_plate(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)))
    pixel = 1.0 / np.array([lens.width, lens.height])
    lost = ((at < np.array(known[:2]) - pixel) | (at > np.array(known[2:]) + pixel)).any(1)
    if lost.any():
        report.warning(
            f"{name} does not cover the whole original picture ({100 * float(lost.mean()):.0f} % of it is missing): "
            "the inverse is extrapolated there.",
            "Use a map with overscan, or the map for the other direction (--st-map-way redistort).",
        )


def _refused(message: str, hint: str) -> JobError:
    return JobError(message, hint, ExitCode.USAGE)
