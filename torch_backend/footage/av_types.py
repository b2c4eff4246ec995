"""What PyAV's types say otherwise than it is."""

from typing import Any, cast

import av


def seconds_of(frame: av.VideoFrame) -> float | None:
    """When a frame is shown, on its stream's clock; None if the container does not say, which the types leave out."""
    return cast(Any, frame).time


def side_data(frame: av.VideoFrame, kind: object) -> bytes:
    """What a frame carries of one kind beside its picture; empty if nothing."""
    every: Any = frame.side_data
    return next((bytes(one) for one in every if one.type == kind), b"")
