"""Reads single frames of a video in any order, by the frame numbers of the import.

The import numbers frames by counting the decoder's output, which is impossible after a seek. Therefore the reader finds
a frame by the time that the import recorded, and compares it with its working frame. If that fails, or frames have no
times, the reader counts from the beginning of the file, as the import did.
"""

from __future__ import annotations

import os
from bisect import bisect_left
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

import av
from av.error import FFmpegError
from numpy.typing import NDArray

from .av_types import seconds_of
from .sources import Known, footage_error

# Number of decoder threads. Each holds its own frames.
_THREADS = 2
# Number of decoded frames kept: the next request is usually for a neighbour, forwards or backwards.
_KEPT = 4
# Distance in frames up to which further decoding is faster than a seek: key frames are usually farther apart.
_MAX_SKIP = 32
# Offsets in seconds before a frame at which to search for a key frame, in this order.
_EARLIER = (0.0, 1.0, 5.0, 20.0)
# Minimum gap in seconds to distinguish frames by time: the import rounds times to 1e-6.
_LEAST_GAP = 1e-5


class DecodedVideo(Protocol):
    """Interface of a video for `VideoReader`, implemented by `VideoSource`."""

    path: Path

    def open(self, threads: int) -> tuple[Any, Any]:
        """(container, video stream) at the beginning, with this number of decoder threads."""
        ...

    def decode(self, container: Any, stream: Any) -> Iterator[Any]:
        """Frames from the container's position, with an FFmpegError in the place of each undecodable packet."""
        ...

    def plate_of(self, frame: av.VideoFrame) -> NDArray[Any]:
        """A decoded frame as a plate."""
        ...

    @property
    def run_up(self) -> float:
        """Seconds before a frame at which decoding must start to reproduce the same picture."""
        ...


class VideoReader:
    """A `sources.PlateReader` of a video. Caches `_KEPT` decoded frames, at most 25 MB each (3840 x 2160, 10 bit)."""

    def __init__(self, source: DecodedVideo, known: Known) -> None:
        self._source, self._known, self._start = source, known, known.start
        self._listed = sorted(known.seconds)
        self._seconds = [known.seconds[number] for number in self._listed]
        gap = min((b - a for a, b in zip(self._seconds, self._seconds[1:], strict=False)), default=1.0)
        self._can_seek = gap > _LEAST_GAP
        self._slack = max(0.25 * gap, 0.25 * _LEAST_GAP)
        self._kept: deque[tuple[int, av.VideoFrame]] = deque(maxlen=_KEPT)
        self._container: Any = None
        self._stream: Any = None
        self._decoder: Iterator[Any] = iter(())
        self._counted: int | None = None
        """Number of frames decoded since the beginning; None after a seek, when frames are identified by time."""
        self._at = 0
        """Number of the last decoded frame."""

    def plate(self, number: int) -> NDArray[Any]:
        """See `PlateReader.plate`."""
        frame = next((frame for n, frame in self._kept if n == number), None)
        if frame is not None:
            return self._source.plate_of(frame)
        if self._container is None:
            self._reopen()
        far = not self._at < number <= self._at + _MAX_SKIP
        if far and self._can_seek and self._start is not None:
            plate = self._sought(number)
            if plate is not None:
                return plate
        if not self._at < number or (self._counted is None and not self._can_seek):
            self._reopen()
        frame = self._forward(number)
        if frame is None and self._counted is None:
            self._reopen()
            frame = self._forward(number)
        if frame is None:
            raise footage_error(
                f"Frame {number} of {self._source.path.name} can no longer be decoded.",
                "The file has changed or is damaged: import the clip again.",
            )
        return self._source.plate_of(frame)

    def close(self) -> None:
        """See `PlateReader.close`."""
        self._kept.clear()
        self._decoder = iter(())
        if self._container is not None:
            self._container.close()
            self._container = None

    def _reopen(self) -> None:
        """Opens the file again at the beginning, and starts counting."""
        self.close()
        self._container, self._stream = self._source.open(min(_THREADS, os.cpu_count() or 1))
        self._decoder = self._source.decode(self._container, self._stream)
        self._counted, self._at = 0, 0

    def _sought(self, number: int) -> NDArray[Any] | None:
        """The plate by a seek to the key frame before it. If that fails, returns None and disables further seeks."""
        for earlier in _EARLIER:
            if not self._jump(self._time_of(number) - earlier - self._source.run_up):
                break
            frame = self._forward(number)
            if frame is not None:
                plate = self._source.plate_of(frame)
                if not self._known.agrees(number, plate):
                    break
                return plate
        self._can_seek = False
        self._reopen()
        return None

    def _jump(self, seconds: float) -> bool:
        """Seeks to the key frame before a time on the container's clock. Returns False on failure."""
        self._kept.clear()
        self._counted, self._at = None, self._listed[0] - 1
        try:
            self._container.seek(int(seconds / self._stream.time_base), stream=self._stream, backward=True)
        except (FFmpegError, OverflowError):
            return False
        self._decoder = self._source.decode(self._container, self._stream)
        return True

    def _forward(self, number: int) -> av.VideoFrame | None:
        """Decodes up to frame `number`, and caches the frames on the way. Returns None if the frame is missing."""
        for frame in self._decoder:
            if self._counted is not None:
                self._counted += 1
                found: int | None = self._counted
            else:
                found = None if isinstance(frame, FFmpegError) else self._number_at(frame)
            if found is None:
                if not isinstance(frame, FFmpegError) and self._is_past(frame, number):
                    return None
                continue
            self._at = found
            if isinstance(frame, FFmpegError):
                continue
            if found == self._listed[0] and self._start is None:
                self._start = seconds_of(frame)
                self._can_seek &= self._start is not None
            self._kept.append((found, frame))
            if found >= number:
                return frame if found == number else None
        return None

    def _time_of(self, number: int) -> float:
        assert self._start is not None
        return self._start + self._known.seconds[number]

    def _number_at(self, frame: av.VideoFrame) -> int | None:
        """Number of a frame by its time; None if the import recorded no frame at that time."""
        seconds = seconds_of(frame)
        if seconds is None or self._start is None:
            return None
        since = seconds - self._start
        at = bisect_left(self._seconds, since - self._slack)
        near = at < len(self._seconds) and abs(self._seconds[at] - since) <= self._slack
        return self._listed[at] if near else None

    def _is_past(self, frame: av.VideoFrame, number: int) -> bool:
        """True if a frame without a number comes after `number` or has no time."""
        seconds = seconds_of(frame)
        return seconds is None or seconds > self._time_of(number) + self._slack
