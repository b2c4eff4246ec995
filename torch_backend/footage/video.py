"""Frames of a video file through PyAV: real timestamps, upright, square pixels, display-referred sRGB."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.error import FFmpegError
from av.video.reformatter import Colorspace, Interpolation
from numpy.typing import NDArray

from . import plate_encoding
from .av_types import seconds_of
from .color import DIFFUSE_WHITE_NITS, InputSpace
from .color import PRIMARIES as PRIMARIES_READ
from .images import resize
from .seeking import VideoReader
from .sources import (
    Known,
    PlateReader,
    SourceFrame,
    SourceInfo,
    believable_aspect,
    footage_error,
    frame_words,
    square_size,
)

NOT_VIDEO = {"tty", "bin", "xbin", "adf", "idf", "image2", "image2pipe", "hls", "concat", "rawvideo"}
"""FFmpeg opens plain text as a terminal recording and follows playlists elsewhere: no clip is meant by either."""

# Code points of ITU-T H.273, as stored in the stream.
UNSAID = (0, 2, 3)
"""Of primaries and transfer functions: reserved, or not known to the one who wrote the file."""
TRANSFERS = {
    1: "g24", 4: "g22", 5: "g24", 6: "g24", 7: "g24", 8: "lin", 11: "g24", 12: "g24", 13: "srgb", 14: "g24",
    15: "g24", 16: "pq", 18: "hlg",
}  # fmt: skip
"""Transfer functions, as `color.InputSpace` names them."""
PRIMARIES = {1: "rec709", 9: "rec2020", 10: "ciexyzd65", 11: "p3dci", 12: "p3d65"}
NEAR_REC709 = {4: "BT.470 M", 5: "BT.601 625", 6: "BT.601 525", 7: "SMPTE 240M", 22: "EBU 3213"}
"""Primaries of standard definition: taken as Rec.709's, as editors and Blender do; the difference is small."""
MATRICES = {1: 1, 4: 4, 5: 5, 6: 5, 7: 7, 9: 9, 10: 9}
"""YCbCr matrix of the stream -> FFmpeg's scaler's. BT.2020's constant luminance is taken as the other, nearly it."""
LUMA = {1: (0.2126, 0.0722), 5: (0.299, 0.114), 7: (0.212, 0.087), 9: (0.2627, 0.0593)}
"""Shares of red and blue in luma, by matrix."""
BT709, BT601, RGB, FULL_RANGE = 1, 5, 0, 2


class VideoSource:
    """A video file. Frame numbers count from 1 in presentation order; an undecodable one keeps its number.

    A file that ends before what it announces, and a picture that changes its size midway, are told by name.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.warnings: list[tuple[str, str]] = []
        with self._open() as container:
            stream = _best_stream(container, path)
            frame = _first_frame(container, stream, path)
            self._quarter_turns = round(_rotation(frame) / 90.0) % 4
            self._aspect = believable_aspect(_pixel_aspect(stream), self.warnings)
            self._space = _input_space(frame, self.warnings)
            self._deep = max(c.bits for c in frame.format.components) > 8 or self._space.is_light
            width, height = square_size(frame.width, frame.height, self._aspect)
            if self._quarter_turns % 2:
                width, height = height, width
            rate = stream.average_rate or stream.guessed_rate or Fraction(24)
            count = stream.frames or _count_from_duration(container, stream, rate)
            self._warn_about(frame)
            self._size = frame.width, frame.height
            self._promise = _promise(container, stream, rate)
            matrix = RGB if frame.format.is_rgb else int(frame.colorspace)
            reading = {
                "colour": self._space.name,
                "colour_told": self._space.declared,
                "primaries": NEAR_REC709.get(int(frame.color_primaries), PRIMARIES_READ[self._space.primaries][0]),
                "matrix": Colorspace(_matrix(frame)).name if matrix != RGB else "RGB",
                "matrix_told": matrix in MATRICES or matrix == RGB,
                "range": "full" if int(frame.color_range) == FULL_RANGE else "video",
                "range_told": int(frame.color_range) in (1, FULL_RANGE),
                "pixel_aspect": float(self._aspect),
                "bits": max(c.bits for c in frame.format.components),
            }
        stat = path.stat()
        self.info = SourceInfo(
            width=width,
            height=height,
            fps=float(rate),
            first=1,
            last=count or None,
            deep=self._deep,
            extended=not self._space.as_it_stands,
            colour="linear" if self._space.is_light else "srgb",
            # What is read otherwise than it used to be is imported again; all else keeps its key.
            key=[path.name, stat.st_size, stat.st_mtime_ns, *([] if self._space.as_it_stands else [self._space.name])],
            reading=reading,
        )

    def frames(self, first: int | None, last: int | None) -> Iterator[SourceFrame]:
        """See `Source.frames`."""
        begin = 1 if first is None else first
        number, got, seen = 0, 0, _Seen()
        lost: list[int] = []
        with self._open() as container:
            stream = _best_stream(container, self.path)
            stream.thread_type = "AUTO"
            for frame in _decoded(container, stream, seen.damaged):
                number += 1
                if last is not None and number > last:
                    break
                if isinstance(frame, FFmpegError):
                    lost.append(number)
                    continue
                if (frame.width, frame.height) != self._size:
                    self._stop_at_change(number, got, frame)
                    break
                at = seconds_of(frame)
                seconds = float(at) if at is not None else (number - 1) / self.info.fps
                seen.add(number, seconds)
                if number >= begin:
                    got += 1
                    corrupt = bool(frame.is_corrupt) or frame.pts in seen.damaged
                    pixels, clipped = self._upright(frame)
                    yield SourceFrame(number, seconds, pixels, corrupt, clipped)
            else:
                self._check_promise(seen, begin, last)
        lost = [n for n in lost if begin <= n < seen.number]
        if lost:
            words = frame_words(lost).capitalize()
            self.warnings.append(
                (
                    f"{words} cannot be decoded: left out of the shot.",
                    "The file is damaged there: copy or export it again.",
                )
            )

    def plates(self, known: Known) -> PlateReader:
        """See `Source.plates`."""
        return VideoReader(self, known)

    def plate_of(self, frame: av.VideoFrame) -> NDArray[Any]:
        """A decoded frame as a plate, see `plate_encoding`. JobError if its size is not the clip's."""
        if (frame.width, frame.height) != self._size:
            raise footage_error(f"{self.path.name} is not the clip that was imported: its size changes.")
        if self._space.as_it_stands:
            pixels = _rgb(frame, "rgb48le" if self._deep else "rgb24")
        else:
            pixels = plate_encoding.half_of(_exact_rgb(frame), self._space)
        pixels = plate_encoding.resize_plate(pixels, *square_size(frame.width, frame.height, self._aspect))
        return np.ascontiguousarray(np.rot90(pixels, self._quarter_turns))

    def decode(self, container: Any, stream: Any) -> Iterator[Any]:
        """Frames from where a container of `open` stands, and errors in the place of what cannot be decoded."""
        return _decoded(container, stream)

    def open(self, threads: int) -> tuple[Any, Any]:
        """The container and its stream, to be decoded by at most so many threads. JobError if it cannot be opened."""
        container = self._open()
        stream = _best_stream(container, self.path)
        stream.thread_type = "AUTO"
        stream.codec_context.thread_count = threads
        return container, stream

    def _stop_at_change(self, number: int, got: int, frame: av.VideoFrame) -> None:
        """A stream may change its size midway; the shot has one, and ends there."""
        sizes = f"{frame.width}x{frame.height} pixels instead of {self._size[0]}x{self._size[1]}"
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
        """Says so if the file ended before what it announces; JobError if less than half of what was asked came."""
        count, end = self._promise
        # Both: a clip that was trimmed without encoding it again holds frames that are never shown.
        short = count - seen.number > 1 and end - seen.seconds > 1.5 / self.info.fps + seen.gap
        promised = count if last is None else min(last, count)
        if not short or seen.number >= promised:
            return
        message = f"{self.path.name} breaks off after frame {seen.number}: it announces {count}."
        hint = "It is damaged or was not copied whole: copy or export it again."
        if 2 * (seen.number - begin + 1) < promised - begin + 1:
            remedy = f" To use what is there, set the last frame to {seen.number}." if seen.number > 7 else ""
            raise footage_error(message, hint + remedy)
        self.warnings.append((message, hint))

    def _open(self) -> Any:
        try:
            # Only plain files: a playlist in disguise must not make the decoder fetch anything.
            return av.open(str(self.path), options={"protocol_whitelist": "file"}, metadata_errors="ignore")
        except FFmpegError as error:
            raise _no_video(self.path) from error

    def _upright(self, frame: av.VideoFrame) -> tuple[NDArray[Any], float]:
        """[H, W, 3] uint8 or uint16 sRGB, and the share of clipped pixels."""
        if self._space.as_it_stands:
            pixels, clipped = _rgb(frame, "rgb48le" if self._deep else "rgb24"), 0.0
        else:
            values, clipped = self._space.to_srgb(_exact_rgb(frame))
            values = np.rint(values * np.float32(65535.0 if self._deep else 255.0))
            pixels = values.astype(np.uint16 if self._deep else np.uint8)
        width, height = square_size(frame.width, frame.height, self._aspect)
        pixels = resize(pixels, width, height)
        return np.ascontiguousarray(np.rot90(pixels, self._quarter_turns)), clipped

    def _warn_about(self, frame: av.VideoFrame) -> None:
        space = self._space
        if space.transfer in ("pq", "hlg"):
            self.warnings.append(
                (
                    f"The clip is HDR ({space.name}): light above white ({DIFFUSE_WHITE_NITS:.0f} cd/m2) is cut.",
                    "Deliver it graded for SDR, or as scene-linear EXR, if it should look otherwise.",
                )
            )
        elif not space.as_it_stands:
            self.warnings.append((f"The clip is {space.name}: converted to Rec.709.", ""))
        if frame.interlaced_frame:
            self.warnings.append(
                ("The clip is interlaced: its fields are not separated.", "Deinterlace it before import.")
            )


@dataclass
class _Seen:
    """What was decoded of the file so far."""

    number: int = 0
    """Of the last frame that could be decoded; 0: none yet."""
    seconds: float = 0.0
    """Its time."""
    gap: float = 0.0
    """Longest time between two frames, beyond the second: rates may vary."""
    damaged: set[int | None] = field(default_factory=set[int | None])
    """Time stamps of packets that the container knows to be incomplete."""

    def add(self, number: int, seconds: float) -> None:
        if self.number:
            self.gap = max(self.gap, seconds - self.seconds)
        self.number, self.seconds = number, seconds


def _no_video(path: Path) -> Exception:
    return footage_error(
        f"{path.name} is not a video that can be read.",
        "Choose a video file (MP4, MOV, MKV) or a numbered image sequence.",
    )


def _best_stream(container: Any, path: Path) -> Any:
    names = set(container.format.name.split(","))
    streams = [s for s in container.streams.video if not (s.disposition & s.disposition.attached_pic)]
    if names & NOT_VIDEO or not streams:
        raise _no_video(path)
    streams = [s for s in streams if s.codec_context is not None]
    if not streams:
        raise footage_error(
            f"{path.name} is encoded in a way that cannot be decoded here, or its header is damaged.",
            "Export it as H.264 or ProRes, or as an image sequence.",
        )
    return max(streams, key=lambda s: (s.codec_context.width or 0) * (s.codec_context.height or 0))


def _first_frame(container: Any, stream: Any, path: Path) -> av.VideoFrame:
    for frame in _decoded(container, stream):
        if not isinstance(frame, FFmpegError):
            return frame
    raise _no_video(path)


def _decoded(container: Any, stream: Any, damaged: set[int | None] | None = None) -> Iterator[Any]:
    """Frames, and in the place of a packet that cannot be decoded its error. Ends where the file breaks off.

    `damaged` receives the time stamps of packets that are decoded although they are not whole.
    """
    for packet in _packets(container, stream):
        if isinstance(packet, FFmpegError):
            yield packet
            continue
        if damaged is not None and packet.is_corrupt and packet.pts is not None:
            damaged.add(packet.pts)
        try:
            yield from packet.decode()
        except FFmpegError as error:
            yield error


def _packets(container: Any, stream: Any) -> Iterator[Any]:
    """Packets, the last of them empty: it asks the decoder for what it still holds. An error ends the file early.

    The packet in the middle of which a file ends is left out: it would be half a picture, and its error would cost
    those that the decoder has not given out yet.
    """
    packets: Iterator[Any] = container.demux(stream)
    held: Any = None
    while True:
        error = None
        try:
            packet = next(packets, None)
        except FFmpegError as failure:
            packet, error = None, failure
        if packet is not None and not packet.size and packet.dts is not None:
            continue  # a repeat of the frame before, in an AVI: to a decoder it means the end
        at_end = packet is None or not packet.size
        if held is not None and not (at_end and held.is_corrupt):
            yield held
        if at_end:
            if error is not None:
                yield error
            elif packet is not None:
                yield packet
            return
        held = packet


def _rotation(frame: Any) -> float:
    """Counterclockwise angle in degrees that the container asks players to turn the picture by."""
    return float(getattr(frame, "rotation", 0) or 0)


def _pixel_aspect(stream: Any) -> Fraction:
    aspect = stream.sample_aspect_ratio
    return Fraction(aspect) if aspect and aspect > 0 else Fraction(1)


def _rgb(frame: av.VideoFrame, kind: str) -> NDArray[Any]:
    """R'G'B' [H, W, 3] as FFmpeg's scaler makes it: quick, and up to 1 of 255 off."""
    return frame.reformat(format=kind, src_colorspace=_matrix(frame), interpolation=Interpolation.BICUBIC).to_ndarray()


def _exact_rgb(frame: av.VideoFrame) -> NDArray[np.float32]:
    """R'G'B' [H, W, 3], white 1, as steep curves need it; values beyond 0 and 1 are kept."""
    luma = LUMA.get(int(_matrix(frame)))
    if frame.format.is_rgb or luma is None:
        return _rgb(frame, "rgb48le").astype(np.float32) * np.float32(1.0 / 65535.0)
    even = frame.reformat(format="yuv444p16le", interpolation=Interpolation.BICUBIC)
    planes: Any = even.planes
    y, cb, cr = (
        np.frombuffer(plane, np.uint16).reshape(plane.height, -1)[:, : plane.width].astype(np.float32)
        for plane in planes
    )
    if int(frame.color_range) == FULL_RANGE:
        y, cb, cr = y / 65535, (cb - 32768) / 65535, (cr - 32768) / 65535
    else:
        y, cb, cr = (y / 256 - 16) / 219, (cb / 256 - 128) / 224, (cr / 256 - 128) / 224
    kr, kb = luma
    red, blue = y + 2 * (1 - kr) * cr, y + 2 * (1 - kb) * cb
    green = (y - kr * red - kb * blue) / (1 - kr - kb)
    return np.stack([red, green, blue], axis=-1).astype(np.float32, copy=False)


def _input_space(frame: av.VideoFrame, warnings: list[tuple[str, str]]) -> InputSpace:
    """What the numbers of a frame mean, as the stream says or, if it does not, as players assume."""
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
                    f"The clip's {what} (number {code} of ITU-T H.273) is not known here: taken as {assumed_as}.",
                    "Convert the clip to Rec.709 if the picture looks wrong.",
                )
            )
    declared = transfer in TRANSFERS and primaries not in UNSAID
    # HDR without primaries is BT.2020 in every standard that knows it.
    assumed = "rec2020" if transfer in (16, 18) else "rec709"
    gamut = PRIMARIES.get(primaries, assumed if primaries in UNSAID else "rec709")
    return InputSpace(TRANSFERS.get(transfer, "g24"), gamut, declared=declared)


def _matrix(frame: av.VideoFrame) -> Colorspace:
    """YCbCr matrix: as tagged, else what players assume: BT.709 from 720 lines on, BT.601 below."""
    assumed = BT709 if max(frame.width, frame.height) >= 1280 else BT601
    return Colorspace(MATRICES.get(int(frame.colorspace), assumed))


def _promise(container: Any, stream: Any, rate: Fraction) -> tuple[int, float]:
    """Frames that the file announces, and when the last of them ends, in seconds on the stream's clock.

    (0, 0) where it announces nothing for this stream: with sound, the container's length may be the sound's.
    """
    start = float(stream.start_time * stream.time_base) if stream.start_time else 0.0
    if stream.duration and stream.time_base:
        end = start + float(stream.duration * stream.time_base)
    elif stream.metadata.get("DURATION"):  # Matroska: the end, not the length
        end = _clock(stream.metadata["DURATION"])
    elif container.duration and len(container.streams) == 1:
        end = start + container.duration / av.time_base
    else:
        return 0, 0.0
    return stream.frames or round((end - start) * rate), end


def _clock(text: str) -> float:
    """Seconds of "00:00:01.958000000"; 0 if it is something else."""
    try:
        hours, minutes, seconds = (float(part) for part in text.split(":"))
    except ValueError:
        return 0.0
    return 3600.0 * hours + 60.0 * minutes + seconds


def _count_from_duration(container: Any, stream: Any, rate: Fraction) -> int:
    if stream.duration and stream.time_base:
        return round(float(stream.duration * stream.time_base * rate))
    return round(container.duration / av.time_base * float(rate)) if container.duration else 0
