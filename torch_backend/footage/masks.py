"""Reads masks from the artist: the covered pixels of each frame, at the size of the working frames.

A mask is one picture for all frames, a numbered sequence, a video, or the footage's own alpha. Pixels of at least half
brightness are covered. If a mask has an alpha that is partly transparent, the alpha is the mask, unless the colour is
black and white. Pictures are assigned to frames by number (`pairing`).
"""

from __future__ import annotations

import functools
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from ..contract import MASK_ALPHA, MASK_KINDS, JobError, Reporter, is_pattern, regular_file
from ..shot import Shot, content_key
from . import plate_encoding
from .images import check_size, error_of
from .importing import FootageConfig, load_frames, source_places
from .layers import find_layer
from .opening import open_video, opens_as_video
from .orientation import UPRIGHT, Orientation, orientation_of_picture
from .pairing import counted_of, pair, pairing_words
from .sequence import AS_STORED, SequenceSource, straight_colour
from .sequence_files import find_sequence, sequence_of_file
from .sources import footage_error, frame_words
from .video import VideoSource

_HALF = 0.5
# Relative tolerance of a mask's aspect ratio, because sizes are rounded.
_SHAPE = 0.01
# Maximum number of pixels of a mask that is larger than the footage. As floats, it takes 0.5 GB.
_MOST_PIXELS = 1 << 25
# Largest covered share of the picture at which a solve is possible.
_ALL = 0.98
# A colour is a matte itself if the share `_MATTE` of its pixels is within `_BLACK` of black or white, with some of
# both.
_BLACK, _MATTE = 0.1, 0.95
_BRIGHTNESS, _ALPHA, _BOTH = "brightness", "alpha", "both"
"""Channels that define the mask."""
_Picture = tuple[int | None, NDArray[np.float32], NDArray[np.float32] | None]
"""Frame (None: all), colour [h, w, C], alpha [h, w], in 0..1."""
WORDS = {"ignore": "what is ignored", "people": "what may move"}
"""Kind of mask -> phrase for messages."""


@dataclass
class Mask:
    """One mask for every frame of a shot."""

    kind: str
    """One of `MASK_KINDS`."""
    size: tuple[int, int]
    """Width and height of the working frames in pixels."""
    packed: dict[int, bytes] = field(default_factory=dict[int, bytes])
    """Frame number -> compressed bits. A mask takes about a thousandth of its pixels."""
    share: float = 0.0
    """Covered share of all frames' pixels."""

    def add(self, frame: int, covered: NDArray[np.bool_]) -> None:
        """Stores the covered pixels of a frame, bool [H, W]."""
        self.packed[frame] = zlib.compress(np.packbits(covered).tobytes(), 1)

    def of(self, frame: int) -> NDArray[np.bool_]:
        """The covered pixels of a frame, bool [H, W], in the original (distorted) frame."""
        width, height = self.size
        bits = np.frombuffer(zlib.decompress(self.packed[frame]), np.uint8)
        return np.unpackbits(bits, count=width * height).reshape(height, width).astype(bool)

    @property
    def key(self) -> str:
        """Key that depends only on the kind, the size and the covered pixels."""
        return content_key(self.kind, self.size, [[frame, zlib.crc32(bits)] for frame, bits in self.packed.items()])


def read_masks(shot: Shot, sources: dict[str, str], report: Reporter) -> dict[str, Mask]:
    """The masks of an imported shot, by kind. `sources` holds a path or `MASK_ALPHA` for each requested kind.

    Raises JobError (FOOTAGE) for a mask that is unreadable, has another aspect ratio, lacks frames or covers nothing,
    and for masks that together cover nearly everything.
    """
    requested = {kind: source for kind, source in sources.items() if source}
    if not requested:
        return {}
    frames = load_frames(shot)
    masks = {kind: _Reading(shot, frames, kind, source, report).mask() for kind, source in requested.items()}
    covered = 0.0
    for number in masks[next(iter(masks))].packed:
        covered += float(np.logical_or.reduce([mask.of(number) for mask in masks.values()]).mean())
    covered /= max(1, len(frames["frames"]))
    if covered > _ALL:
        words = " and ".join(WORDS[kind] for kind in masks)
        raise footage_error(
            f"The mask of {words} covers {100 * covered:.0f} % of the picture: too little is left to solve the camera.",
            "White is masked: invert the mask if it was made the other way round.",
        )
    return masks


class _Reading:
    """Reader of one mask."""

    def __init__(self, shot: Shot, frames: dict[str, Any], kind: str, source: str, report: Reporter) -> None:
        self.shot, self.frames, self.kind, self.source, self.report = shot, frames, kind, source, report
        self.size = int(frames["width"]), int(frames["height"])
        self.counted = counted_of(frames)
        self.numbers = self.counted.frames
        self.name = f"The mask {source}" if source != MASK_ALPHA else "The footage's alpha"

    def mask(self) -> Mask:
        """Reads all pictures of the source into one mask."""
        result = Mask(self.kind, self.size)
        pictures = self._alpha() if self.source == MASK_ALPHA else self._pictures()
        total = 0.0
        for done, (number, grey) in enumerate(pictures, start=1):
            self.report.check_cancelled()
            covered = self._covered(grey)
            for frame in [number] if number is not None else self.numbers:
                result.add(frame, covered)
                total += float(covered.mean())
            self.report.progress("solve: masks", done, len(self.numbers), WORDS[self.kind])
        result.share = total / max(1, len(self.numbers))
        if total == 0.0:
            hint = "White is masked, from 50 % grey upwards."
            if self.source == MASK_ALPHA:
                hint = "Transparent areas are ignored; opaque areas may move."
            raise footage_error(f"{self.name} covers nothing in any frame.", hint)
        return result

    def _covered(self, grey: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Covered pixels [H, W] bool at the working size of a picture [h, w] in 0..1. Raises as `_check_shape` does."""
        h, w = grey.shape
        self._check_shape(w, h)
        small = cv2.resize(grey, self.size, interpolation=cv2.INTER_AREA if w > self.size[0] else cv2.INTER_LINEAR)
        return np.asarray(small) >= _HALF

    def _check_shape(self, w: int, h: int) -> None:
        """Raises JobError for a picture with another aspect ratio than the footage, or with far more pixels."""
        full = self.frames.get("source_size") or self.size
        if w * h > max(full[0] * full[1], _MOST_PIXELS):
            raise footage_error(
                f"{self.name} is {w}x{h}, the footage {full[0]}x{full[1]}: it has far more pixels than needed.",
                "Render the mask at the footage's size, or a fraction of it.",
            )
        aspect = float(self.frames.get("reading", {}).get("pixel_aspect", 1.0))
        shape = w / h
        # A mask of anamorphic footage has square pixels, or the pixels of the footage.
        if all(abs(shape / (full[0] / full[1] / stretch) - 1.0) > _SHAPE for stretch in (1.0, aspect)):
            raise footage_error(
                f"{self.name} is {w}x{h}, the footage {full[0]}x{full[1]}: their aspect ratios differ.",
                "Render the mask at the footage's size, or a fraction of it.",
            )

    # ------------------------------------------------------------------------------------------------- from files

    def _pictures(self) -> Iterator[tuple[int | None, NDArray[np.float32]]]:
        """(frame, [h, w] in 0..1) of each picture. A frame of None means all frames."""
        path = Path(self.source)
        if not path.exists() and not is_pattern(path.name):
            raise footage_error(f"{self.name} does not exist.", "Check the path.")
        if path.is_file() and opens_as_video(path):
            pictures = self._of_mask_video(path)
        else:
            files = self._files(path)
            if None not in files:
                matched = self._matched(sorted(n for n in files if n is not None))
                files = dict[int | None, Path]({frame: files[number] for frame, number in matched.items()})
            pictures = functools.partial(self._of_mask_files, files)
        way = self._way(pictures(with_alpha=True))
        for frame, colour, alpha in pictures():
            grey = colour.mean(2)
            if alpha is not None and way != _BRIGHTNESS:
                grey = alpha if way == _ALPHA else grey * alpha
            yield frame, grey

    def _way(self, pictures: Iterator[_Picture]) -> str:
        """The channels that define the mask, decided from the pictures with an alpha. Tells the artist."""
        low, high, opaque = 1.0, 0.0, None
        for _, colour, alpha in pictures:
            if alpha is None:
                continue
            low, high = min(low, float(alpha.min())), max(high, float(alpha.max()))
            if opaque is None and high >= _HALF:
                opaque = colour[alpha >= _HALF]
            if opaque is not None and low < _HALF:
                break
        if opaque is None or low >= _HALF:  # opaque everywhere, or nowhere
            return _BRIGHTNESS
        black, white = float((opaque.max(1) < _BLACK).mean()), float((opaque.min(1) > 1.0 - _BLACK).mean())
        if black + white >= _MATTE and min(black, white) >= 1.0 - _MATTE:
            self.report.warning(f"{self.name} is black and white with an alpha: white is masked where it is opaque.")
            return _BOTH
        self.report.warning(f"{self.name} has an alpha channel: opaque areas are masked, and its colour is ignored.")
        return _ALPHA

    def _files(self, path: Path) -> dict[int | None, Path]:
        """Number -> file; the number is None for a single picture."""
        if path.is_file():
            sequence = sequence_of_file(path)
            return {None: path} if sequence is None else {**sequence.files}
        return {**find_sequence(path).files}

    def _matched(self, pictures: list[int]) -> dict[int, int]:
        """Frame -> number of the mask's picture. Raises JobError, which lists the frames without a picture."""
        paired = pair(pictures, self.counted, needs_all=True)
        missing = sorted(set(self.numbers) - set(paired.numbers))
        if missing:
            raise footage_error(
                f"{self.name} has no picture for {frame_words(missing)}, of {len(self.numbers)} frames.",
                "Number it like the clip's frames, or use one picture without a number in its name for all of them.",
            )
        words = pairing_words(self.name, pictures, paired)
        if words is not None:
            self.report.warning(*words)
        return paired.numbers

    def _of_mask_files(self, files: dict[int | None, Path], with_alpha: bool = False) -> Iterator[_Picture]:
        """The pictures of a mask from files; `with_alpha`: only pictures that have an alpha."""
        for frame, file in files.items():
            buffer, orientation = _opened(file)
            spec = buffer.spec()
            self._check_shape(*orientation.size(spec.full_width, spec.full_height))
            if with_alpha and spec.alpha_channel < 0:
                continue
            pixels, alpha = _pixels(file, buffer, orientation)
            colours = [n for n in range(pixels.shape[2]) if n != alpha] or [0]
            yield frame, pixels[..., colours[:3]], None if alpha is None else pixels[..., alpha]

    def _of_mask_video(self, path: Path) -> Callable[..., Iterator[_Picture]]:
        """A function that yields the pictures of a mask from a video, with the parameters of `_of_mask_files`."""
        video = open_video(path)
        self._check_shape(video.info.width, video.info.height)
        count = sum(1 for _ in video.frames(None, None))
        frame_of = {picture: frame for frame, picture in self._matched(list(range(1, count + 1))).items()}

        def pictures(with_alpha: bool = False) -> Iterator[_Picture]:
            if with_alpha and not video.has_alpha:
                return
            last = max(frame_of)
            alphas = video.alphas(last) if video.has_alpha else iter(())
            number, alpha = next(alphas, (0, None))
            for one in video.frames(None, last):
                while alpha is not None and number < one.number:
                    number, alpha = next(alphas, (0, None))
                if one.number in frame_of:
                    if video.has_alpha and number != one.number:
                        raise footage_error(
                            f"The alpha of {frame_words([one.number])} of {path.name} can no longer be read.",
                            "The file is damaged: export it again.",
                        )
                    colour = plate_encoding.display(one.pixels)
                    if alpha is not None and alpha.shape != colour.shape[:2]:
                        size = colour.shape[1], colour.shape[0]
                        alpha = np.asarray(cv2.resize(alpha, size, interpolation=cv2.INTER_LINEAR), np.float32)
                    yield frame_of[one.number], colour, alpha

        return pictures

    # ------------------------------------------------------------------------------------------------- from alpha

    def _alpha(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """(frame, mask [h, w]) from the footage's alpha: transparent pixels for "ignore", opaque ones for "people"."""
        footage = self._footage()
        alphas = self._of_video(footage) if isinstance(footage, VideoSource) else self._of_files(*footage)
        for number, alpha in alphas:
            yield number, 1.0 - alpha if self.kind == MASK_KINDS[0] else alpha

    def _of_files(self, files: dict[int, Path], layer: str) -> Iterator[tuple[int, NDArray[np.float32]]]:
        for number in self.numbers:
            file = files[number]
            found = find_layer(file, layer)[0]
            if found.alpha is None:
                raise footage_error(
                    f"{file.name} has no alpha channel to use as a mask.", "Provide the mask as separate pictures."
                )
            yield number, _read(file, found.part)[0][..., found.alpha]

    def _of_video(self, video: VideoSource) -> Iterator[tuple[int, NDArray[np.float32]]]:
        if not video.has_alpha:
            raise footage_error(
                f"{video.path.name} has no alpha channel to use as a mask.",
                "Provide the mask as separate pictures, or as a video.",
            )
        missing = set(self.numbers)
        for footage_number, alpha in video.alphas(self.numbers[-1] - self.counted.shift):
            number = footage_number + self.counted.shift
            if number in missing:
                missing.remove(number)
                yield number, alpha
        if missing:
            raise footage_error(
                f"The alpha of {frame_words(sorted(missing))} of {video.path.name} can no longer be read.",
                "The file has changed or is damaged: import the clip again.",
            )

    def _footage(self) -> tuple[dict[int, Path], str] | VideoSource:
        """The footage: a video, or (files by frame, name of the imported layer). Raises JobError if it is missing."""
        config = self.frames.get("config", {})
        settings = FootageConfig(fps=float(config.get("fps", 0.0)), layer=str(config.get("layer", "")))
        for place in source_places(self.shot, self.frames):
            path = Path(place)
            try:
                if path.is_file() and opens_as_video(path):
                    return VideoSource(path, layer=settings.layer)
                sequence = find_sequence(path)
                SequenceSource(sequence, settings.fps, settings.layer)
            except (JobError, OSError):
                continue
            available = sequence.files
            if available.keys() >= {number - self.counted.shift for number in self.numbers}:
                files = {number: available[number - self.counted.shift] for number in self.numbers}
                return files, settings.layer
        raise footage_error(
            f"The footage {self.shot.info().source} can no longer be read, so its alpha is unknown.",
            "Move it back to this path, or provide the mask as separate pictures.",
        )


def _read(file: Path, part: int = 0) -> tuple[NDArray[np.float32], int | None]:
    """(picture [h, w, C], upright, with straight colour; index of the alpha channel or None)."""
    return _pixels(file, *_opened(file, part))


def _opened(file: Path, part: int = 0) -> tuple[oiio.ImageBuf, Orientation]:
    """Opens a picture and reads only its header. Raises JobError if the header is unreadable or the size too large."""
    buffer = oiio.ImageBuf(regular_file(file), part, 0, AS_STORED)
    spec = buffer.spec()
    if buffer.has_error:
        raise footage_error(f"The mask {file} cannot be read: {error_of(buffer)}.", "Export it again.")
    check_size(file.name, spec)
    return buffer, orientation_of_picture(spec) or UPRIGHT


def _pixels(file: Path, buffer: oiio.ImageBuf, orientation: Orientation) -> tuple[NDArray[np.float32], int | None]:
    """Result of `_read` for a picture opened by `_opened`."""
    spec = buffer.spec()
    x, y = spec.full_x, spec.full_y
    roi = oiio.ROI(x, x + spec.full_width, y, y + spec.full_height, 0, 1, 0, spec.nchannels)
    pixels = buffer.get_pixels(oiio.FLOAT, roi)
    if pixels is None or buffer.has_error:
        raise footage_error(f"The mask {file} cannot be read: {error_of(buffer)}.", "Export it again.")
    upright = orientation.upright(np.asarray(pixels, np.float32))
    alpha = spec.alpha_channel if spec.alpha_channel >= 0 else None
    if alpha is not None and not spec.get_int_attribute("oiio:UnassociatedAlpha"):
        colours = [n for n in range(upright.shape[2]) if n != alpha]
        upright[..., colours] = straight_colour(upright[..., colours], upright[..., alpha], 1.0)
    return upright, alpha
