"""Selects the video stream of a container, and reads its first frame, length and timecode."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import av
from av.error import FFmpegError

from ..contract import open_regular, parse_timecode
from .decoding import stored_frames
from .sources import (
    footage_error,
)

NOT_VIDEO = {"tty", "bin", "xbin", "adf", "idf", "image2", "image2pipe", "hls", "concat", "rawvideo"}
"""FFmpeg formats that are no clips: plain text opens as a terminal recording, and playlists refer to other files."""


# Top-level atoms of MP4 and QuickTime files, except the index (moov).
_ATOMS = {b"ftyp", b"mdat", b"free", b"skip", b"wide", b"uuid", b"pnot", b"moof", b"sidx", b"styp", b"meta"}


def _lacks_index(path: Path) -> bool:
    """True if a file is an MP4 or QuickTime file without its index (the moov atom), which recorders write last."""
    try:
        size = path.stat().st_size
        with open_regular(path) as file:
            at, count, head = 0, 0, b""
            while at + 8 <= size:
                file.seek(at)
                head = bytes(file.read(16))
                length, kind = int.from_bytes(head[:4], "big"), head[4:8]
                if length == 1:  # the size follows, in 64 bits
                    length = int.from_bytes(head[8:16], "big")
                if kind not in _ATOMS:
                    break
                count += 1
                at = at + length if length >= 8 else size  # 0: the atom extends to the end of the file
            is_blank = head[:8] == bytes(8)  # reserved space that was never filled
            return count > 0 and (at >= size - 8 or is_blank)
    except OSError:
        return False


def no_video(path: Path) -> Exception:
    """The error for a file without a readable video."""
    if _lacks_index(path):
        return footage_error(
            f"{path.name} was not finished: its index (the moov atom) is missing, so that no player can read it.",
            "Copy it again. If the recording itself broke off, the camera or a repair program can rebuild the index.",
        )
    return footage_error(
        f"{path.name} is not a video that can be read.",
        "Choose a video file (MP4, MOV, MKV) or a numbered image sequence.",
    )


def stream_of(container: Any, path: Path, layer: str) -> Any:
    """The video stream with the number `layer` (from 1); by default the largest. Raises JobError if there is none."""
    streams = streams_of(container, path)
    if not layer or len(streams) == 1:
        return max(streams, key=lambda s: (s.codec_context.width or 0) * (s.codec_context.height or 0))
    numbered = {str(number): stream for number, stream in enumerate(streams, start=1)}
    if layer not in numbered:
        raise footage_error(f"{path.name} has no video stream {layer!r}.", f"It has: {listed(streams)}.")
    return numbered[layer]


def size_words(stream: Any) -> str:
    """Width and height of a stream in pixels, for messages."""
    return f"{stream.codec_context.width}x{stream.codec_context.height}"


def listed(streams: list[Any]) -> str:
    """Numbers and sizes of streams, for messages."""
    return ", ".join(f"{number} ({size_words(one)})" for number, one in enumerate(streams, start=1))


def streams_of(container: Any, path: Path) -> list[Any]:
    """Decodable video streams, in the file's order. Raises JobError if there are none."""
    names = set(container.format.name.split(","))
    streams = [s for s in container.streams.video if not (s.disposition & s.disposition.attached_pic)]
    if names & NOT_VIDEO or not streams:
        raise no_video(path)
    streams = [s for s in streams if s.codec_context is not None]
    if not streams:
        raise footage_error(
            f"{path.name} is encoded in a way that cannot be decoded here, or its header is damaged.",
            "Export it as H.264 or ProRes, or as an image sequence.",
        )
    return streams


def alpha_decoder_of(stream: Any) -> str:
    """Name of a special decoder for the alpha of a clip; empty if the default decoder suffices, or without alpha."""
    marked = {key.lower(): str(value) for key, value in stream.metadata.items()}.get("alpha_mode") == "1"
    # VP8 and VP9 store alpha as a second picture, which only Google's libvpx decoder combines with the first.
    decoder = {"vp8": "libvpx", "vp9": "libvpx-vp9"}.get(stream.codec_context.name, "")
    return decoder if marked and decoder in av.codecs_available else ""


def first_frame(container: Any, stream: Any, path: Path) -> av.VideoFrame:
    """The first decodable frame. Raises JobError (FOOTAGE) if there is none."""
    for frame in stored_frames(container, stream):
        if not isinstance(frame, FFmpegError):
            return frame
    raise no_video(path)


def pixel_aspect(stream: Any) -> Fraction | None:
    """Width of a pixel over its height; None if the file does not store it."""
    aspect = stream.sample_aspect_ratio
    return Fraction(aspect) if aspect and aspect > 0 else None


def timecode(container: Any, stream: Any) -> str:
    """Timecode of the first frame; empty if the file stores none."""
    tables = [stream.metadata, container.metadata, *(one.metadata for one in container.streams)]
    timecodes = (
        parse_timecode(str(value)) for table in tables for key, value in table.items() if key.lower() == "timecode"
    )
    return next((code for code in timecodes if code), "")


def promise(container: Any, stream: Any, rate: Fraction) -> tuple[int, float]:
    """(number of frames, end of the last frame in seconds on the stream's clock), as announced by the file.

    (0, 0) if the file announces nothing for this stream.
    """
    start = float(stream.start_time * stream.time_base) if stream.start_time else 0.0
    if stream.duration and stream.time_base:
        end = start + float(stream.duration * stream.time_base)
    elif stream.metadata.get("DURATION"):  # Matroska stores the end, not the length
        end = _clock(stream.metadata["DURATION"])
    elif container.duration and len(container.streams) == 1:  # with several streams, it may be the sound's length
        end = start + container.duration / av.time_base
    else:
        return 0, 0.0
    return stream.frames or round((end - start) * rate), end


def _clock(text: str) -> float:
    """Seconds from a text such as "00:00:01.958000000"; 0 for another format."""
    try:
        hours, minutes, seconds = (float(part) for part in text.split(":"))
    except ValueError:
        return 0.0
    return 3600.0 * hours + 60.0 * minutes + seconds


def count_from_duration(container: Any, stream: Any, rate: Fraction) -> int:
    """Number of frames from the duration of the stream, else of the container; 0 if both are unknown."""
    if stream.duration and stream.time_base:
        return round(float(stream.duration * stream.time_base * rate))
    return round(container.duration / av.time_base * float(rate)) if container.duration else 0
