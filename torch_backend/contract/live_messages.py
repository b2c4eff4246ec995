"""Messages between Blender and a live session over a pipe, and the request for a view."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, BinaryIO

from .files import is_json_object


@dataclass
class LiveView:
    """Request to a live session to draw one view of the frozen scene."""

    view: int
    """Number of a view in Blender. A newer request for the same view replaces an older one."""
    seq: int
    """Sequence number, which the answer repeats."""
    viewmat: list[float]
    """16 floats, world-to-camera, row-major, OpenCV axes, solve units."""
    K: list[float]
    """fx, fy, cx, cy in pixels of `width` x `height`."""
    width: int
    """Width in pixels."""
    height: int
    """Height in pixels."""
    t_star: float
    """Frame number of the clip at which time stands still."""
    exposed_like: float | None = None
    """Frame number whose exposure the view gets; None: that of t*."""
    show: str = "color"
    """color; guesses: colour, tinted where no frame near t* saw the surface; support or motion: this matte in grey."""
    detail: bool = False
    """Make the view of plates, as in a take. This takes longer, and other views go first. Only for `color`."""
    develop: bool = True
    """Show the developed instant, if there is one: see `FreezeParams.develop`."""

    def __post_init__(self) -> None:
        if len(self.viewmat) != 16 or len(self.K) != 4:
            raise ValueError("a live view needs 16 numbers of viewmat and 4 of K")
        if not all(math.isfinite(v) for v in (*self.viewmat, *self.K, self.t_star)):
            raise ValueError("a live view is not finite")
        if not (0 < self.width <= LIVE_LIMIT and 0 < self.height <= LIVE_LIMIT):
            raise ValueError(f"a live view is {self.width} x {self.height} pixels: 1 to {LIVE_LIMIT} can be drawn")
        if self.show not in LIVE_SHOWS:
            raise ValueError(f"show is {self.show!r}: it should be one of {', '.join(LIVE_SHOWS)}")


LIVE_LIMIT = 8192
"""Largest width and height of a live view in pixels."""
LIVE_SHOWS = {
    "color": ("Picture", "The frozen people and place"),
    "guesses": ("Guesses", "The picture, tinted where no frame near t* saw what is shown"),
    "support": ("Support", "White where frames near t* saw what is shown, black where it is a guess"),
    "motion": ("Motion", "White where something moves in the clip"),
}
"""Value of `LiveView.show` -> its name and tooltip on the panel."""
_MESSAGE = struct.Struct("<4sIQ")
"""Start of every message: a magic number, size of the header, size of the body, in bytes."""
_MARK = b"SPL1"
_LONGEST = (1 << 20, 1 << 31)


def write_message(stream: BinaryIO, header: Mapping[str, Any], body: bytes | memoryview = b"") -> None:
    """Writes one message of a live session: a JSON object, then raw bytes. Errors of the stream pass through."""
    text = json.dumps(header, allow_nan=False).encode()
    stream.write(_MESSAGE.pack(_MARK, len(text), len(body)) + text)
    stream.write(body)
    stream.flush()


def read_message(stream: BinaryIO) -> tuple[dict[str, Any], bytes] | None:
    """The next message of a live session, as (header, body); None at the end of the stream.

    Raises ValueError if the bytes are not a message; the stream is then unusable.
    """
    start = _read_exactly(stream, _MESSAGE.size)
    if start is None:
        return None
    mark, long, size = _MESSAGE.unpack(start)
    if mark != _MARK or long > _LONGEST[0] or size > _LONGEST[1]:
        raise ValueError("the live session's stream contains data that is not a message")
    text, body = _read_exactly(stream, long), _read_exactly(stream, size)
    if text is None or body is None:
        return None
    try:
        header = json.loads(text)
    except RecursionError as error:
        raise ValueError("a live message's header is nested too deeply") from error
    if not is_json_object(header):
        raise ValueError("a live message's header should be a JSON object")
    return header, body


def _read_exactly(stream: BinaryIO, count: int) -> bytes | None:
    parts: list[bytes] = []
    missing = count
    while missing:
        part = stream.read(missing)
        if not part:
            return None
        parts.append(part)
        missing -= len(part)
    return b"".join(parts)
