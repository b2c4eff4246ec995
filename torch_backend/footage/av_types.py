"""Wrappers for PyAV calls whose type stubs are wrong."""

from typing import Any, cast

import av


def seconds_of(frame: av.VideoFrame) -> float | None:
    """Presentation time of a frame in seconds on the stream's clock; None if the container does not store it."""
    return cast(Any, frame).time


def side_data(frame: av.VideoFrame, kind: object) -> bytes:
    """Side data of one kind attached to a frame; empty if there is none."""
    entries: Any = frame.side_data
    return next((bytes(one) for one in entries if one.type == kind), b"")
