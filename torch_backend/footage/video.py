"""Reads a video file through PyAV: real timestamps, upright, square pixels, display-referred sRGB or light."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.error import FFmpegError
from numpy.typing import NDArray

from ..contract import MOST_PIXELS, regular_file
from . import plate_encoding
from .av_types import seconds_of
from .color import DIFFUSE_WHITE_NITS, InputSpace
from .color import PRIMARIES as PRIMARIES_READ
from .decoding import Noticed, decoded, stored_frames, time_of, unmarked_fields
from .frame_rgb import BT601, MATRICES, RGB, Coding, coding_of, depth_of, exact_rgb, rgb_codes
from .images import resize, resize_float, too_large
from .lens_tags import focal_of_video
from .look import LookSpace, look_space
from .ocio import Colours
from .orientation import UPRIGHT, Orientation, display_matrix, orientation_of_matrix
from .seeking import VideoReader
from .sources import (
    Known,
    Overrides,
    PlateReader,
    SourceFrame,
    SourceInfo,
    believable_aspect,
    content_key_of,
    footage_error,
    frame_words,
    square_size,
)
from .video_stream import (
    alpha_decoder_of,
    count_from_duration,
    first_frame,
    listed,
    no_video,
    pixel_aspect,
    promise,
    size_words,
    stream_of,
    streams_of,
    timecode,
)

# FFmpeg formats that other programs treat as still pictures.
_ANIMATED_PICTURES = {"apng", "gif"}

# Code points of ITU-T H.273, as stored in the stream.
UNSAID = (0, 2, 3)
"""Codes of primaries and transfer functions that mean reserved or unspecified."""
TRANSFERS = {
    1: "g24", 4: "g22", 5: "g24", 6: "g24", 7: "g24", 8: "lin", 11: "g24", 12: "g24", 13: "srgb", 14: "g24",
    15: "g24", 16: "pq", 18: "hlg",
}  # fmt: skip
"""Code -> name of the transfer function in `color.InputSpace`."""
PRIMARIES = {1: "rec709", 9: "rec2020", 10: "ciexyzd65", 11: "p3dci", 12: "p3d65"}
NEAR_REC709 = {4: "BT.470 M", 5: "BT.601 625", 6: "BT.601 525", 7: "SMPTE 240M", 22: "EBU 3213"}
"""Primaries of standard definition. They are read as Rec.709, as in editors and Blender: the difference is small."""


# Maximum height of interlaced pictures in any standard, in lines.
_MOST_INTERLACED = 1088
# (path, size, modification time) of a file -> its `decoding.unmarked_fields`.
_fields_of: dict[tuple[str, int, int], str] = {}
_NO_ORIENTATION = (
    "The clip's header asks to show the picture at an angle or stretched, but only quarter turns and mirroring are "
    "supported: frames are read as stored.",
    "Export the clip upright if its frames should look otherwise.",
)


class VideoSource:
    """A video file. Frame numbers count from 1 in presentation order, including undecodable frames.

    Warns if the file ends earlier than announced, or if the picture changes its size.
    """

    def __init__(
        self, path: Path, colours: Colours | None = None, overrides: Overrides | None = None, layer: str = ""
    ) -> None:
        """`layer`: number of the video stream to read, from 1; empty: the largest. Ignored for a single stream."""
        self.path, self.layer = path, layer
        self.warnings: list[tuple[str, str]] = []
        overrides = overrides or Overrides()
        with self._open() as container:
            stream = stream_of(container, path, layer)
            self._report_streams(container, stream)
            if stream.codec_context.width * stream.codec_context.height > MOST_PIXELS:
                raise too_large(path.name, stream.codec_context.width, stream.codec_context.height)
            frame = first_frame(container, stream, path)
            self._is_picture = container.format.name in _ANIMATED_PICTURES
            orientation = UPRIGHT if (matrix := display_matrix(frame)) is None else orientation_of_matrix(matrix)
            self._orientation, self._rotation = orientation or UPRIGHT, frame.rotation
            # FFmpeg's aspect of the stream includes the display matrix. If that is not applied, the codec's is right.
            aspect = overrides.pixel_aspect or pixel_aspect(stream if orientation else stream.codec_context)
            self._aspect = believable_aspect(aspect or Fraction(1), self.warnings)
            look = look_space(overrides.look) if overrides.look else None
            self._space = look or _chosen_space(path, colours or Colours()) or _input_space(frame, self.warnings)
            self._coding = coding_of(frame, overrides.matrix, overrides.levels)
            self._deep = depth_of(frame) > 8 or self._space.is_light
            self._size = width, height = self._shown_size(frame)
            rate = stream.average_rate or stream.guessed_rate
            is_rate_declared, rate = bool(rate), rate or Fraction(24)
            count = stream.frames or count_from_duration(container, stream, rate)
            self._fields = "" if frame.interlaced_frame else self._unmarked_fields(frame.height)
            self._interlaced = bool(frame.interlaced_frame or self._fields)
            self._promise = promise(container, stream, rate)
            self._alpha_decoder = alpha_decoder_of(stream)
            self.has_alpha = bool(self._alpha_decoder) or any(part.is_alpha for part in frame.format.components)
            """True if the clip has an alpha that `alphas` can read."""
            self._warn_about(frame)
            if orientation is None:
                self.warnings.append(_NO_ORIENTATION)
            reading = {
                **_reading(frame, self._space, self._coding),
                "fps_told": is_rate_declared,
                "pixel_aspect_told": aspect is not None,
                **self._reading_of(container, stream),
            }
        stat, reading_key = path.stat(), self._reading_key()
        self.info = SourceInfo(
            width=width,
            height=height,
            fps=float(rate),
            first=1,
            last=count or None,
            deep=self._deep,
            extended=not self._space.is_passthrough,
            colour="linear" if self._space.is_light else "srgb",
            # Clips that this version reads differently get a new key and are imported again.
            key=content_key_of({1: path}) + reading_key,
            former_key=[path.name, stat.st_size, stat.st_mtime_ns, *reading_key],
            reading=reading,
            file=str(path),
            probe=self._space.probe,
            mismatch=self._mismatch(frame, orientation),
        )

    def _reading_key(self) -> list[Any]:
        """Part of the clip's key about the interpretation of the pictures; empty for ordinary clips."""
        key: list[Any] = _reading_key(self._space) + (["deinterlaced"] if self._interlaced else [])
        return key + ([f"orientation {self._orientation.code}"] if self._orientation.is_mirrored else [])

    def _reading_of(self, container: Any, stream: Any) -> dict[str, Any]:
        """Interpretation of the stream, for frames.json."""
        return {
            "pixel_aspect": float(self._aspect),
            "alpha": self.has_alpha,
            "interlaced": self._interlaced,
            "timecode": timecode(container, stream),
            "orientation": self._orientation.code,
            **({"focal_35mm": lens} if (lens := focal_of_video(container, stream)) else {}),
        }

    def _mismatch(self, frame: av.VideoFrame, orientation: Orientation | None) -> str:
        """Why other programs show the clip differently, see `SourceInfo.mismatch`."""
        tagged = coding_of(frame)
        if self._is_picture:
            return "Blender shows an animated picture as a still"
        if self._aspect != 1:
            return "its pixels are not square"
        if orientation is None or orientation.is_mirrored:  # Blender 5 rotates instead of mirroring
            return f"its header says that it is {orientation.words if orientation else 'turned or stretched'}"
        if not self._is_first_stream:
            return "it has several video streams, and other programs show another one"
        if self._interlaced:
            return "it is interlaced, and frames are built from its fields"
        if (tagged.matrix, tagged.is_full) != (self._coding.matrix, self._coding.is_full):
            return "its matrix or levels were set by hand"
        if not tagged.is_matrix_declared and tagged.matrix != BT601:  # FFmpeg, and therefore Blender, assume BT.601
            return "it does not state its colour matrix"
        return ""

    def frames(self, first: int | None, last: int | None) -> Iterator[SourceFrame]:
        """See `Source.frames`."""
        begin = 1 if first is None else first
        number, got, seen, noticed = 0, 0, _Seen(), Noticed()
        lost: list[int] = []
        with self._open() as container:
            stream = stream_of(container, self.path, self.layer)
            stream.thread_type = "AUTO"
            for frame in decoded(container, stream, noticed, self._fields):
                number += 1
                if last is not None and number > last:
                    break
                if isinstance(frame, FFmpegError):
                    lost.append(number)
                    continue
                if self._shown_size(frame) != self._size:
                    self._stop_at_change(number, got, frame)
                    break
                at = seconds_of(frame)
                seconds = float(at) if at is not None else (number - 1) / self.info.fps
                seen.add(number, seconds)
                if number >= begin:
                    got += 1
                    corrupt = bool(frame.is_corrupt) or time_of(frame) in noticed.damaged
                    yield SourceFrame(number, seconds, self._upright(frame), corrupt)
            else:
                self._check_promise(seen, begin, last)
        if noticed.interlaced and not self._interlaced:
            self.warnings.append(_deinterlaced_words(f"{noticed.interlaced} frames of the clip are interlaced: each"))
        lost = [n for n in lost if begin <= n < seen.number]
        if lost:
            words = frame_words(lost).capitalize()
            self.warnings.append(
                (
                    f"{words} cannot be decoded: left out of the shot.",
                    "The file is damaged there: copy or export it again.",
                )
            )

    def alphas(self, last: int) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """(number, alpha) of the frames up to `last`, in order: [H, W] in 0..1, upright, pixels as stored or square.

        Omits undecodable frames. Raises JobError if the clip has no alpha, or changes its size.
        """
        if not self.has_alpha:
            raise footage_error(f"{self.path.name} has no alpha.", "Provide the mask as separate pictures.")
        with self._open() as container:
            stream = stream_of(container, self.path, self.layer)
            stream.thread_type = "AUTO"
            decoder = None
            if self._alpha_decoder:
                decoder = av.CodecContext.create(self._alpha_decoder, "r")
                decoder.extradata = stream.codec_context.extradata
            for number, frame in enumerate(stored_frames(container, stream, decoder=decoder), start=1):
                if number > last:
                    return
                if isinstance(frame, FFmpegError):
                    continue
                if self._shown_size(frame) != self._size:
                    raise footage_error(
                        f"{self.path.name} changes its size at frame {number}.", "Export it in one size."
                    )
                alpha = frame.reformat(format="rgba").to_ndarray()[..., 3].astype(np.float32) * np.float32(1 / 255)
                orientation = self._orientation_of(frame)
                if orientation.swaps_sides:  # a quarter turn would invert the pixel aspect: resample to square pixels
                    size = square_size(frame.width, frame.height, self._aspect)
                    alpha = resize_float(alpha[..., None], *size)[..., 0]
                yield number, orientation.upright(alpha)

    def plates(self, known: Known) -> PlateReader:
        """See `Source.plates`."""
        return VideoReader(self, known)

    def plate_of(self, frame: av.VideoFrame) -> NDArray[Any]:
        """A decoded frame as a plate, see `plate_encoding`. Raises JobError if its size differs from the clip's."""
        if self._shown_size(frame) != self._size:
            raise footage_error(f"{self.path.name} is not the clip that was imported: its size changes.")
        if self._space.is_passthrough:
            pixels = rgb_codes(frame, self._coding, deep=self._deep)
        else:
            pixels = plate_encoding.half_of(exact_rgb(frame, self._coding), self._space)
        pixels = plate_encoding.resize_plate(pixels, *square_size(frame.width, frame.height, self._aspect))
        return self._orientation_of(frame).upright(pixels)

    def decode(self, container: Any, stream: Any) -> Iterator[Any]:
        """See `DecodedVideo.decode`. `container` and `stream` come from `open`."""
        return decoded(container, stream, fields=self._fields)

    @property
    def run_up(self) -> float:
        """Seconds before a frame at which decoding must start: the deinterlacer also reads earlier frames."""
        return 1.5 / self.info.fps if self._interlaced else 0.0

    def open(self, threads: int) -> tuple[Any, Any]:
        """(container, video stream), with at most this many decoder threads. Raises JobError if opening fails."""
        container = self._open()
        stream = stream_of(container, self.path, self.layer)
        stream.thread_type = "AUTO"
        stream.codec_context.thread_count = threads
        return container, stream

    def _stop_at_change(self, number: int, got: int, frame: av.VideoFrame) -> None:
        """Ends the shot at a change of picture size, with a warning. Raises JobError if no frame came before it."""
        width, height = self._shown_size(frame)
        sizes = f"{width}x{height} pixels instead of {self._size[0]}x{self._size[1]}"
        if got < 1:
            raise footage_error(
                f"The clip changes its size before the range begins: from frame {number} on it is {sizes}.",
                "Choose a range before that frame, or export the clip in one size.",
            )
        self.warnings.append(
            (
                f"From frame {number} on the clip is {sizes}: the shot ends before it.",
                "Export the clip in one size if the rest is wanted.",
            )
        )

    def _check_promise(self, seen: _Seen, begin: int, last: int | None) -> None:
        """Warns if the file ended earlier than announced. Raises JobError if less than half of the range was read."""
        count, end = self._promise
        # Test frame count and end time: a clip trimmed without re-encoding holds frames that are never shown.
        short = count - seen.number > 1 and end - seen.seconds > 1.5 / self.info.fps + seen.gap
        promised = count if last is None else min(last, count)
        if not short or seen.number >= promised:
            return
        message = f"{self.path.name} ends after frame {seen.number}, but its header announces {count}."
        hint = "It is damaged or was not copied completely: copy or export it again."
        if 2 * (seen.number - begin + 1) < promised - begin + 1:
            remedy = f" To use the frames before that, set the last frame to {seen.number}." if seen.number > 7 else ""
            raise footage_error(message, hint + remedy)
        self.warnings.append((message, hint))

    def _report_streams(self, container: Any, stream: Any) -> None:
        """Warns about the choice if there are several video streams."""
        streams = streams_of(container, self.path)
        self.has_streams = len(streams) > 1
        """True if there are several video streams to select by `layer`."""
        # Blender shows the first stream.
        self._is_first_stream = stream.index == container.streams.video[0].index
        if self.has_streams and not self.layer:
            number = 1 + [one.index for one in streams].index(stream.index)
            self.warnings.append(
                (
                    f"The clip has {len(streams)} video streams: number {number} is used, {size_words(stream)}.",
                    f"Choose another by its number (--layer): {listed(streams)}.",
                )
            )

    def _unmarked_fields(self, height: int) -> str:
        """Result of `decoding.unmarked_fields` for this file, cached."""
        if height > _MOST_INTERLACED:
            return ""
        stat = self.path.stat()
        key = str(self.path), stat.st_size, stat.st_mtime_ns
        if key not in _fields_of:
            with self._open() as container:
                stream = stream_of(container, self.path, self.layer)
                stream.thread_type = "AUTO"
                _fields_of[key] = unmarked_fields(container, stream)
        return _fields_of[key]

    def _open(self) -> Any:
        try:
            # Only plain files: a playlist in disguise must not make the decoder fetch anything.
            return av.open(
                regular_file(self.path, None), options={"protocol_whitelist": "file"}, metadata_errors="ignore"
            )
        except FFmpegError as error:
            raise no_video(self.path) from error

    def _upright(self, frame: av.VideoFrame) -> NDArray[Any]:
        """A decoded frame, upright, [H, W, 3]: uint8 or uint16 sRGB, or float16 light."""
        if self._space.is_light:
            return self.plate_of(frame)
        if self._space.is_passthrough:
            pixels = rgb_codes(frame, self._coding, deep=self._deep)
        else:
            values = self._space.to_srgb(exact_rgb(frame, self._coding))
            values = np.rint(values * np.float32(65535.0 if self._deep else 255.0))
            pixels = values.astype(np.uint16 if self._deep else np.uint8)
        width, height = square_size(frame.width, frame.height, self._aspect)
        return self._orientation_of(frame).upright(resize(pixels, width, height))

    def _orientation_of(self, frame: av.VideoFrame) -> Orientation:
        """Orientation of one frame; that of the clip if the frame has none."""
        # Only read the matrix of a frame with another rotation: PyAV's side data and the frame refer to each other, so
        # that only the garbage collector frees their memory.
        if frame.rotation == self._rotation:
            return self._orientation
        matrix = display_matrix(frame)
        return (None if matrix is None else orientation_of_matrix(matrix)) or self._orientation

    def _shown_size(self, frame: av.VideoFrame) -> tuple[int, int]:
        """Width and height of a frame, upright and with square pixels."""
        return self._orientation_of(frame).size(*square_size(frame.width, frame.height, self._aspect))

    def _warn_about(self, frame: av.VideoFrame) -> None:
        space = self._space
        if space.transfer in ("pq", "hlg"):
            self.warnings.append(
                (
                    f"The clip is HDR ({space.name}): converted to scene-linear light, white at "
                    f"{DIFFUSE_WHITE_NITS:.0f} cd/m2.",
                    "Deliver it graded for SDR, or as scene-linear EXR, if it should look otherwise.",
                )
            )
        elif not space.is_passthrough and not isinstance(space, LookSpace):
            self.warnings.append((f"The clip is {space.name}: converted to Rec.709.", ""))
        if self._interlaced:
            unsaid = ", though it does not say so" if self._fields else ""
            self.warnings.append(_deinterlaced_words(f"The clip is interlaced{unsaid}: each frame"))
        if self.has_alpha:
            self.warnings.append(("The clip has alpha: its colour is used, its alpha is ignored.", ""))


@dataclass
class _Seen:
    """Progress of decoding a file."""

    number: int = 0
    """Number of the last decoded frame; 0: none yet."""
    seconds: float = 0.0
    """Time of the last decoded frame."""
    gap: float = 0.0
    """Longest time between two decoded frames, for variable frame rates."""

    def add(self, number: int, seconds: float) -> None:
        if self.number:
            self.gap = max(self.gap, seconds - self.seconds)
        self.number, self.seconds = number, seconds


def _deinterlaced_words(which: str) -> tuple[str, str]:
    message = f"{which} is built from its first field."
    return message, "Film progressive if you can: half of the lines are interpolated."


def _reading(frame: av.VideoFrame, space: InputSpace, coding: Coding) -> dict[str, Any]:
    """Interpretation of the colours of a clip, for the import's record."""
    return {
        "colour": space.name,
        "colour_told": space.declared,
        **space.origin,
        "primaries": _primaries_read(frame, space),
        "matrix": coding.matrix_name,
        "matrix_told": coding.is_matrix_declared,
        "range": coding.range_name,
        "range_told": coding.is_range_declared,
        "bits": depth_of(frame),
    }


def _chosen_space(path: Path, colours: Colours) -> InputSpace | None:
    """Colour space of a clip from the options, or from a rule of $OCIO for its path."""
    return colours.space() or colours.by_rules(path)


def _reading_key(space: InputSpace) -> list[str]:
    return [] if space.is_passthrough else [space.name, *space.origin.values()]


def _primaries_read(frame: av.VideoFrame, space: InputSpace) -> str:
    """Name of the primaries assumed for a frame's colours."""
    if not space.primaries:
        return space.name
    return NEAR_REC709.get(int(frame.color_primaries), PRIMARIES_READ[space.primaries][0])


def _input_space(frame: av.VideoFrame, warnings: list[tuple[str, str]]) -> InputSpace:
    """Colour space of a frame from the stream's tags; for missing tags, the assumptions of players."""
    transfer, primaries, matrix = int(frame.color_trc), int(frame.color_primaries), int(frame.colorspace)
    known = transfer in TRANSFERS or transfer in UNSAID
    known_primaries = primaries in PRIMARIES or primaries in NEAR_REC709 or primaries in UNSAID
    known_matrix = matrix in MATRICES or matrix == RGB or matrix in UNSAID
    for fine, what, code, assumed_as in (
        (known, "transfer function", transfer, "video"),
        (known_primaries, "primaries", primaries, "Rec.709"),
        (known_matrix, "matrix", matrix, "players take clips without one"),
    ):
        if not fine:
            warnings.append(
                (
                    f"The clip's {what} (number {code} of ITU-T H.273) is unknown: read as {assumed_as}.",
                    "Convert the clip to Rec.709 if the picture looks wrong.",
                )
            )
    declared = transfer in TRANSFERS and primaries not in UNSAID
    # HDR without primaries is BT.2020 in every HDR standard.
    assumed = "rec2020" if transfer in (16, 18) else "rec709"
    gamut = PRIMARIES.get(primaries, assumed if primaries in UNSAID else "rec709")
    return InputSpace(TRANSFERS.get(transfer, "g24"), gamut, declared=declared)
