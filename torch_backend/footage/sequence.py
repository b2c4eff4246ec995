"""Reads a numbered image sequence through OpenImageIO: one layer, straight colour, square pixels, sRGB or light.

Pictures made for a display stay 8-bit sRGB if they are that already; otherwise they become 16-bit sRGB.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from ..contract import (
    file_as_blender_counts,
    parse_timecode,
    regular_file,
)
from . import plate_encoding
from .color import LIGHTS, InputSpace, named_space, space_of_chromaticities
from .images import check_size, error_of, resize
from .layers import Layer, find_layer, shown
from .lens_tags import focal_of_picture
from .look import look_space
from .ocio import Colours
from .oiio_types import attribute, bits_of, channel_names
from .orientation import UPRIGHT, Orientation, orientation_of_picture
from .sequence_files import FEW, PictureSequence
from .sources import (
    FASTEST_FPS,
    SLOWEST_FPS,
    Known,
    PlateReader,
    SourceFrame,
    SourceInfo,
    believable_aspect,
    content_key_of,
    footage_error,
    frame_words,
    square_size,
)

DEFAULT_FPS = 24.0


# Extensions of files that Blender shows correctly. Blender cannot read JPEG XL, and damages one line of SGI files.
_IN_BLENDER = {
    ".exr", ".png", ".jpg", ".jpeg", ".tif", ".tiff", ".dpx", ".cin", ".hdr", ".tga", ".bmp", ".webp", ".jp2", ".psd",
}  # fmt: skip


_NO_ORIENTATION = (
    "The pictures' header has an orientation that EXIF does not define: they are read as stored.",
    "Export them upright if they look rotated.",
)


def _several_numbers(pattern: str) -> tuple[str, str]:
    """The warning about file names in which more than one number varies."""
    return (
        f"Several numbers vary in the names: the frame number was read where # stands in {pattern}.",
        "If another number counts the frames, choose the clip by a pattern with # in its place.",
    )


class SequenceSource:
    """A numbered sequence. Frame numbers are those of the files. Missing and unreadable frames are omitted."""

    def __init__(
        self,
        sequence: PictureSequence,
        fps: float = 0.0,
        layer: str = "",
        colours: Colours | None = None,
        declared_aspect: Fraction | None = None,
        look: str = "",
    ) -> None:
        self.warnings: list[tuple[str, str]] = []
        self._files = sequence.files
        if len(self._files) < FEW:
            raise footage_error(f"{sequence.pattern} is a single picture.", "A freeze needs a clip: choose a sequence.")
        if sequence.numbered.has_second_number:
            self.warnings.append(_several_numbers(sequence.pattern))
        first, spec, self._layer, names = self._first_readable(layer)
        self._channels = channel_names(spec)
        self._space = look_space(look) if look else _input_space(first, spec, colours or Colours(), self.warnings)
        aspect = declared_aspect or _pixel_aspect(spec)
        self._aspect = believable_aspect(aspect or Fraction(1), self.warnings)
        orientation = orientation_of_picture(spec)
        if orientation is None:
            self.warnings.append(_NO_ORIENTATION)
        self._orientation = orientation or UPRIGHT
        self._stored = spec.full_width, spec.full_height
        width, height = self._orientation.size(*square_size(*self._stored, self._aspect))
        self._describe(names, layer, (width, height))
        rate = fps or _rate(spec)
        space, reading_key = self._space, self._reading_key(len(names))
        light = space.is_light
        self.info = SourceInfo(
            width=width,
            height=height,
            fps=float(rate or DEFAULT_FPS),
            first=min(self._files),
            last=max(self._files),
            deep=light or not space.is_passthrough or str(spec.format) not in ("uint8", "int8"),
            extended=light or not space.is_passthrough or str(spec.format) in ("half", "float", "double"),
            colour="linear" if light else "srgb",
            # By content: footage may be copied or moved. Footage that this version reads differently gets a new key.
            key=content_key_of(self._files) + reading_key,
            former_key=[*self._former_key(sequence), *reading_key],
            reading={
                "files": sequence.pattern,
                "numbers": [min(self._files), max(self._files)],
                "layers": names,
                "pixel_aspect_told": aspect is not None,
                "fps_told": bool(rate),
                **self._reading(spec),
            },
            file=str(first),
            probe=space.probe,
            mismatch=_mismatch(spec, len(names), self._aspect, self._orientation)
            or _name_mismatch(first.name, self._files),
        )

    def _reading_key(self, layers: int) -> list[Any]:
        """Part of the clip's key about the interpretation of the pictures; empty for ordinary ones, as in old keys."""
        space = self._space
        ordinary = space.is_passthrough or space == InputSpace("lin", declared=space.declared)
        ordinary = ordinary and self._aspect == 1 and self._layer.alpha is None and layers == 1
        key: list[Any] = [space.name, self._layer.name, float(self._aspect), "straight", *space.origin.values()]
        rotation = [] if self._orientation == UPRIGHT else [f"orientation {self._orientation.code}"]
        return ([] if ordinary else key) + rotation

    def _former_key(self, sequence: PictureSequence) -> list[Any]:
        """The key of these files in an earlier version: by name, size and modification time."""
        stats = [file.stat() for file in self._files.values()]
        size, time = sum(stat.st_size for stat in stats), max(stat.st_mtime_ns for stat in stats)
        return [_former_name(sequence), len(stats), size, time]

    def _reading(self, spec: oiio.ImageSpec) -> dict[str, Any]:
        """Interpretation of the pictures, for frames.json."""
        space = self._space
        return {
            "colour": space.name,
            "colour_told": space.declared,
            **space.origin,
            **({"light": space.light} if space.light != LIGHTS[0] else {}),
            "layer": self._layer.name,
            "alpha": self._layer.alpha is not None,
            "pixel_aspect": float(self._aspect),
            "timecode": parse_timecode(str(spec.get_string_attribute("smpte:TimeCode"))),
            "bits": bits_of(spec),
            "orientation": self._orientation.code,
            **({"focal_35mm": lens} if (lens := focal_of_picture(spec)) else {}),
        }

    def frames(self, first: int | None, last: int | None) -> Iterator[SourceFrame]:
        """See `Source.frames`."""
        first = self.info.first if first is None else first
        last = max(self._files) if last is None else last
        missing = [
            n for n in range(max(first, self.info.first), min(last, max(self._files)) + 1) if n not in self._files
        ]
        if missing:
            self.warnings.append(
                (
                    f"The sequence lacks {frame_words(missing)}.",
                    "They are frozen with cameras interpolated from their neighbours, in gaps of two seconds at most.",
                )
            )
        unreadable: list[int] = []
        findings = _Findings()
        for number in sorted(n for n in self._files if first <= n <= last):
            try:
                pixels = self._read(self._files[number], findings)
            except (OSError, UnicodeDecodeError):  # UnicodeDecodeError: damaged channel name
                unreadable.append(number)
                continue
            yield SourceFrame(number, (number - self.info.first) / self.info.fps, pixels)
        if unreadable:
            words = frame_words(unreadable).capitalize()
            self.warnings.append((f"{words} cannot be read: left out of the shot.", "Render or copy it again."))
        if findings.transparent:
            self.warnings.append(
                ("The pictures are transparent in places: their colour is used, their alpha is ignored.", "")
            )
        if findings.cropped:
            self.warnings.append(("Pictures fill only a part of their frame: the rest of it is black.", ""))

    def _describe(self, names: list[str], requested_layer: str, size: tuple[int, int]) -> None:
        """Warns about a chosen layer, pixels that are not square, and a conversion of primaries."""
        if len(names) > 1 and not requested_layer:
            unused = ", ".join(shown(n) for n in names if n != self._layer.name)
            message = f"The pictures have {len(names)} layers: {shown(self._layer.name)} is used."
            self.warnings.append((message, f"The others: {unused}."))
        if self._aspect != 1:
            self.warnings.append(
                (
                    f"The pictures have pixels {float(self._aspect):g} times as wide as high: "
                    f"{self._stored[0]}x{self._stored[1]} becomes {size[0]}x{size[1]}.",
                    "",
                )
            )
        if self._space.primaries != "rec709":
            self.warnings.append((f"The pictures are {self._space.name}: converted to Rec.709.", ""))

    def _first_readable(self, requested_layer: str) -> tuple[Path, oiio.ImageSpec, Layer, list[str]]:
        why = ""
        for file in self._files.values():
            try:
                layer, names = find_layer(file, requested_layer)
            except OSError as error:
                why = why or str(error).replace(str(file), file.name)
                continue
            spec, _, failed = _open(file, layer.part)
            if not failed:
                return file, spec, layer, names
            why = why or f"{file.name}: {failed}"
        raise footage_error(
            f"No picture of the sequence in {next(iter(self._files.values())).parent} can be read: {why}.",
            "Open one in Blender to check whether it is damaged.",
        )

    def plates(self, known: Known) -> PlateReader:
        """See `Source.plates`."""
        return self

    def plate(self, number: int) -> NDArray[Any]:
        """See `PlateReader.plate`."""
        if number not in self._files:
            raise footage_error(f"Frame {number} of the sequence is missing.", "Put it back.")
        rgb = self._stored_pixels(self._files[number], _Findings())
        if self.info.extended:
            return self._light(rgb)
        if self.info.deep:
            rgb = np.rint(np.clip(rgb, 0.0, 1.0) * np.float32(65535.0)).astype(np.uint16)
        return plate_encoding.resize_plate(np.ascontiguousarray(rgb), self.info.width, self.info.height)

    def _light(self, rgb: NDArray[np.float32]) -> NDArray[Any]:
        """A plate [H, W, 3] float16 of light, from stored pixels."""
        plate = plate_encoding.half_of(rgb, self._space)
        return plate_encoding.resize_plate(plate, self.info.width, self.info.height)

    def close(self) -> None:
        """See `PlateReader.close`. Does nothing, because no files stay open."""

    def _read(self, file: Path, findings: _Findings) -> NDArray[Any]:
        """A picture [H, W, 3]: uint8 or uint16 sRGB, or float16 light. Raises OSError if unreadable."""
        rgb = self._stored_pixels(file, findings)
        if self._space.is_light:
            return self._light(rgb)
        if self.info.deep:
            rgb = np.rint(self._space.to_srgb(rgb) * np.float32(65535.0)).astype(np.uint16)
        return resize(np.ascontiguousarray(rgb), self.info.width, self.info.height)

    def _stored_pixels(self, file: Path, findings: _Findings) -> NDArray[Any]:
        """Straight colour [h, w, 3] of the layer, in the file's colour space and size: uint8, or float32 if deep."""
        (spec, buffer, failed), layer = _open(file, self._layer.part), self._layer
        if channel_names(spec) != self._channels:
            layer = self._same_layer(file)
            spec, buffer, failed = _open(file, layer.part)
        if failed:
            raise OSError(f"{file}: {failed}")
        size = spec.full_width, spec.full_height
        orientation = orientation_of_picture(spec) or UPRIGHT
        if orientation != self._orientation:
            # No rule is safe here. Some cameras change the tag during a take without turning the picture, and some
            # programs turn the pixels of a few files. So neither each file's tag nor the first tag is reliable.
            words = [one.words or "stored upright" for one in (orientation, self._orientation)]
            raise footage_error(
                f"{file.name} is {words[0]} according to its header, but the sequence starts with pictures that are "
                f"{words[1]}.",
                "All pictures of a sequence need the same orientation: export them upright, or choose a range with "
                "one orientation.",
            )
        if size != self._stored:
            raise footage_error(
                f"{file.name} is {size[0]}x{size[1]}, but the sequence starts with "
                f"{self._stored[0]}x{self._stored[1]}.",
                "All pictures of a sequence need the same size.",
            )
        channels = [*layer.channels] if layer.alpha is None else [*layer.channels, layer.alpha]
        first, beyond = min(channels), max(channels) + 1
        x, y = spec.full_x, spec.full_y
        roi = oiio.ROI(x, x + size[0], y, y + size[1], 0, 1, first, beyond)
        kind = oiio.FLOAT if self.info.deep else oiio.UINT8
        pixels = buffer.get_pixels(kind, roi)
        if pixels is None or buffer.has_error:
            raise OSError(f"{file}: {error_of(buffer)}")
        pixels = np.asarray(pixels)
        rgb = pixels[..., [c - first for c in layer.channels]]
        inner = _data_window(spec)
        findings.cropped |= inner != (slice(0, size[1]), slice(0, size[0]))
        if layer.alpha is not None:
            alpha = pixels[..., layer.alpha - first]
            opaque = 1.0 if self.info.deep else 255
            findings.transparent |= bool((alpha[inner] < opaque).any())
            if not spec.get_int_attribute("oiio:UnassociatedAlpha"):
                rgb = straight_colour(rgb, alpha, opaque)
        return orientation.upright(rgb)

    def _same_layer(self, file: Path) -> Layer:
        """Location of the sequence's layer in a file with other channels than the first file."""
        layer = find_layer(file, self._layer.name)[0]
        if layer.name != self._layer.name:
            raise footage_error(
                f"{file.name} has no layer {shown(self._layer.name)}, which the first picture of the sequence has.",
                "All pictures of a sequence need the same layers.",
            )
        return layer


@dataclass
class _Findings:
    """Properties of the pictures read so far that need a warning."""

    transparent: bool = False
    cropped: bool = False


AS_STORED = oiio.ImageSpec()
AS_STORED.attribute("oiio:UnassociatedAlpha", 1)
"""Read option: OpenImageIO must not multiply unassociated colour by alpha."""


def _open(file: Path, part: int) -> tuple[oiio.ImageSpec, oiio.ImageBuf, str]:
    """(header, pixels, error message or "")."""
    buffer = oiio.ImageBuf(regular_file(file), part, 0, AS_STORED)
    spec = buffer.spec()
    check_size(file.name, spec)
    return spec, buffer, (error_of(buffer) or "it is damaged") if buffer.has_error else ""


def _mismatch(spec: oiio.ImageSpec, layers: int, aspect: Fraction, orientation: Orientation) -> str:
    """Why other programs show such pictures differently, see `SourceInfo.mismatch`."""
    if orientation != UPRIGHT:  # Blender ignores the orientation tag, up to 5.2
        return f"its pictures are {orientation.words} according to their header"
    if aspect != 1:
        return "its pixels are not square"
    if layers > 1:
        return "its pictures have several layers"
    if _data_window(spec) != (slice(0, spec.full_height), slice(0, spec.full_width)) or spec.full_x or spec.full_y:
        return "its pictures fill only a part of their frame"
    return "" if (spec.width, spec.height) == (spec.full_width, spec.full_height) else "its pictures exceed their frame"


def _name_mismatch(name: str, files: dict[int, Path]) -> str:
    """Result of `_mismatch` from the file names: Blender opens one file, and derives the names of the others."""
    if Path(name).suffix.lower() not in _IN_BLENDER:
        return f"Blender does not show {Path(name).suffix} pictures as they are"
    if all(file.name == file_as_blender_counts(name, number) for number, file in files.items()):
        return ""
    return "Blender reads another number in its files' names"


def _former_name(sequence: PictureSequence) -> str:
    """Name of a sequence without gaps in the keys of earlier versions: `shot.1001-1010#.exr`."""
    numbers = list(sequence.files)
    hashes = re.search(r"#+", sequence.pattern)
    if hashes is None or sequence.numbered.has_second_number:
        return sequence.pattern
    width = len(hashes[0])
    pad = "#" * (width // 4) if width % 4 == 0 else "@" * width
    return f"{sequence.pattern[: hashes.start()]}{numbers[0]}-{numbers[-1]}{pad}{sequence.pattern[hashes.end() :]}"


def _rate(spec: oiio.ImageSpec) -> float:
    """Frames per second from a picture's header; 0 if missing or implausible."""
    rate = attribute(spec, "framesPerSecond") or attribute(spec, "FramesPerSecond")
    if isinstance(rate, tuple):  # a rational, as OpenEXR stores it
        rate = rate[0] / rate[1] if rate[1] else 0.0
    return float(rate) if isinstance(rate, (int, float)) and SLOWEST_FPS <= rate <= FASTEST_FPS else 0.0


def _data_window(spec: oiio.ImageSpec) -> tuple[slice, slice]:
    """(rows, columns) of the data window within the display window."""
    left, top = spec.x - spec.full_x, spec.y - spec.full_y
    rows = slice(min(max(0, top), spec.full_height), max(0, min(spec.full_height, top + spec.height)))
    return rows, slice(min(max(0, left), spec.full_width), max(0, min(spec.full_width, left + spec.width)))


def straight_colour(rgb: NDArray[Any], alpha: NDArray[Any], opaque: float) -> NDArray[Any]:
    """Unpremultiplies colour [H, W, 3] by alpha [H, W]. Colour with alpha 0 (pure light) stays unchanged."""
    covered = (alpha > 0) & (alpha < opaque)
    if not covered.any():
        return rgb
    weight = np.where(covered, alpha / np.float32(opaque), np.float32(1.0)).astype(np.float32)[..., None]
    colour = rgb / weight
    return colour if rgb.dtype == np.float32 else np.rint(np.clip(colour, 0, opaque)).astype(rgb.dtype)


def _pixel_aspect(spec: oiio.ImageSpec) -> Fraction | None:
    """Width of a pixel over its height; None if the file does not store it."""
    value = spec.getattribute("PixelAspectRatio")
    if not isinstance(value, (int, float)) or not np.isfinite(value) or value <= 0:
        return None
    if abs(value - 1.0) < 1e-3:
        return Fraction(1)
    return Fraction(value).limit_denominator(10_000)


def _input_space(file: Path, spec: oiio.ImageSpec, colours: Colours, warnings: list[tuple[str, str]]) -> InputSpace:
    """Colour space of a picture: from the options, its file or a rule of $OCIO, else the usual one of its format."""
    chosen = colours.space()
    if chosen is not None:
        return chosen
    suffix, name = file.suffix.lower(), str(spec.getattribute("oiio:ColorSpace") or "")
    if suffix in (".dpx", ".cin"):
        return colours.by_rules(file) or _film_space(suffix, str(spec.getattribute("dpx:Transfer") or ""), warnings)
    named = named_space(name)
    primaries = attribute(spec, "chromaticities")
    if isinstance(primaries, tuple) and len(primaries) == 8 and (named is None or named.transfer == "lin"):
        try:
            return space_of_chromaticities(primaries)
        except ValueError:
            warnings.append((f"The chromaticities in {file.name} are impossible: Rec.709 is assumed.", ""))
    profile = str(spec.getattribute("ICCProfile:profile_description") or "")
    if profile and not any(word in profile.lower() for word in ("srgb", "709", "gray", "grey")):
        warnings.append(
            (f"The pictures carry the colour profile {profile!r}, which is not applied.", "Convert them to sRGB.")
        )
    if named is not None:
        return named
    known = _known_to_ocio(file, name, colours)
    if known is not None:
        return known
    is_light = str(spec.format) in ("half", "float", "double") or suffix in (".exr", ".hdr")
    assumed = InputSpace("lin" if is_light or "lin" in name.lower() else "srgb", declared=False)
    if name and name.lower() not in ("unknown", "data"):
        warnings.append(
            (
                f"The pictures' colour space {name!r} is unknown: read as {assumed.name}.",
                "Set their colour space (--colour-space) if the picture looks wrong.",
            )
        )
    return assumed


def _known_to_ocio(file: Path, name: str, colours: Colours) -> InputSpace | None:
    """The OCIO space with the name stored in a file, or the space from the configuration's file rules."""
    found = colours.known(name) if name and name.lower() != "unknown" else None
    return found or colours.by_rules(file)


def _film_space(suffix: str, transfer: str, warnings: list[tuple[str, str]]) -> InputSpace:
    """Colour space of DPX and Cineon files, which hold anything from film scans to video."""
    if suffix == ".cin" or transfer in ("Printing density", "Logarithmic"):
        warnings.append(
            (
                "The pictures are Cineon log: read with black at code 95, white at 685 and Rec.709 primaries.",
                "Set their colour space (--colour-space), such as ADX10, if they are another log.",
            )
        )
        return InputSpace("cineon")
    if transfer == "Linear":
        return InputSpace("lin")
    if transfer.startswith(("SMPTE", "ITU", "Composite")):
        return InputSpace("g24")
    warnings.append(
        (
            "The pictures do not say how their colour is encoded: read as Rec.709 video, not as log.",
            "Set their colour space (--colour-space) if they look flat.",
        )
    )
    return InputSpace("g24", declared=False)
