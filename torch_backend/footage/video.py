"""Frames of a video file through PyAV: real timestamps, upright, square pixels, display-referred sRGB."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.error import FFmpegError
from av.video.reformatter import Colorspace, Interpolation
from numpy.typing import NDArray

from .images import resize
from .sources import SourceFrame, SourceInfo, footage_error, frame_words

NOT_VIDEO = {"tty", "bin", "xbin", "adf", "idf", "image2", "image2pipe", "hls", "concat", "rawvideo"}
"""FFmpeg opens plain text as a terminal recording and follows playlists elsewhere: no clip is meant by either."""

HDR_TRANSFERS = {16: "PQ", 18: "HLG"}
BT709, BT601_BT470, BT601_SMPTE = 1, 5, 6
"""Matrix coefficients of ITU-T H.273, as stored in the stream."""


class VideoSource:
    """A video file. Frame numbers count from 1 in presentation order; an undecodable one keeps its number."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.warnings: list[tuple[str, str]] = []
        with self._open() as container:
            stream = _best_stream(container, path)
            frame = _first_frame(container, stream, path)
            self._quarter_turns = round(_rotation(frame) / 90.0) % 4
            self._aspect = _pixel_aspect(stream)
            self._deep = max(c.bits for c in frame.format.components) > 8
            width, height = self._square_size(frame.width, frame.height)
            if self._quarter_turns % 2:
                width, height = height, width
            rate = stream.average_rate or stream.guessed_rate or Fraction(24)
            count = stream.frames or _count_from_duration(container, stream, rate)
            self._warn_about(frame)
        stat = path.stat()
        self.info = SourceInfo(
            width=width,
            height=height,
            fps=float(rate),
            first=1,
            last=count or None,
            deep=self._deep,
            colour="srgb",
            key=[path.name, stat.st_size, stat.st_mtime_ns],
        )

    def frames(self, first: int | None, last: int | None) -> Iterator[SourceFrame]:
        """See `Source.frames`."""
        number, lost = 0, []
        with self._open() as container:
            stream = _best_stream(container, self.path)
            stream.thread_type = "AUTO"
            for frame in _decoded(container, stream):
                number += 1
                if isinstance(frame, FFmpegError):
                    lost.append(number)
                    continue
                if last is not None and number > last:
                    break
                if first is None or number >= first:
                    seconds = frame.time if frame.time is not None else (number - 1) / self.info.fps
                    yield SourceFrame(number, float(seconds), self._upright(frame), bool(frame.is_corrupt))
        lost = [n for n in lost if (first is None or n >= first) and (last is None or n <= last)]
        if lost:
            words = frame_words(lost).capitalize()
            self.warnings.append(
                (
                    f"{words} cannot be decoded: left out of the shot.",
                    "The file is damaged there: copy or export it again.",
                )
            )

    def _open(self) -> Any:
        try:
            # Only plain files: a playlist in disguise must not make the decoder fetch anything.
            return av.open(str(self.path), options={"protocol_whitelist": "file"}, metadata_errors="ignore")
        except FFmpegError as error:
            raise _no_video(self.path) from error

    def _square_size(self, width: int, height: int) -> tuple[int, int]:
        if self._aspect >= 1:
            return max(1, round(width * self._aspect)), height
        return width, max(1, round(height / self._aspect))

    def _upright(self, frame: av.VideoFrame) -> NDArray:
        kind = "rgb48le" if self._deep else "rgb24"
        rgb = frame.reformat(format=kind, src_colorspace=_matrix(frame), interpolation=Interpolation.BICUBIC)
        pixels = rgb.to_ndarray()
        width, height = self._square_size(frame.width, frame.height)
        pixels = resize(pixels, width, height)
        pixels = np.ascontiguousarray(np.rot90(pixels, self._quarter_turns))
        # A stream may change its size midway; the shot has one.
        return resize(pixels, self.info.width, self.info.height)

    def _warn_about(self, frame: av.VideoFrame) -> None:
        transfer = HDR_TRANSFERS.get(int(frame.color_trc))
        if transfer:
            self.warnings.append(
                (
                    f"The clip is HDR ({transfer}) and is taken as if it were sRGB.",
                    "Convert it to SDR or scene-linear EXR.",
                )
            )
        if frame.interlaced_frame:
            self.warnings.append(
                ("The clip is interlaced: its fields are not separated.", "Deinterlace it before import.")
            )


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
    return max(streams, key=lambda s: (s.codec_context.width or 0) * (s.codec_context.height or 0))


def _first_frame(container: Any, stream: Any, path: Path) -> av.VideoFrame:
    for frame in _decoded(container, stream):
        if not isinstance(frame, FFmpegError):
            return frame
    raise _no_video(path)


def _decoded(container: Any, stream: Any) -> Iterator[Any]:
    """Frames, and in the place of a packet that cannot be decoded its error. Ends where the file breaks off."""
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets)
        except StopIteration:
            return
        except FFmpegError as error:
            yield error
            return
        try:
            yield from packet.decode()
        except FFmpegError as error:
            yield error


def _rotation(frame: Any) -> float:
    """Counterclockwise angle in degrees that the container asks players to turn the picture by."""
    return float(getattr(frame, "rotation", 0) or 0)


def _pixel_aspect(stream: Any) -> Fraction:
    aspect = stream.sample_aspect_ratio
    return Fraction(aspect) if aspect and aspect > 0 else Fraction(1)


def _matrix(frame: av.VideoFrame) -> Colorspace:
    """YCbCr matrix: as tagged, else what players assume: BT.709 from 720 lines on, BT.601 below."""
    tagged = int(frame.colorspace)
    if tagged == BT709:
        return Colorspace.ITU709
    if tagged in (BT601_BT470, BT601_SMPTE):
        return Colorspace.ITU601
    if tagged in (9, 10):
        return Colorspace(9)
    return Colorspace.ITU709 if max(frame.width, frame.height) >= 1280 else Colorspace.ITU601


def _count_from_duration(container: Any, stream: Any, rate: Fraction) -> int:
    if stream.duration and stream.time_base:
        return round(float(stream.duration * stream.time_base * rate))
    return round(container.duration / av.time_base * float(rate)) if container.duration else 0
