"""What PyAV's types say otherwise than it is."""

from typing import Any, cast

import av


def seconds_of(frame: av.VideoFrame) -> float | None:
    """When a frame is shown, on its stream's clock; None if the container does not say, which the types leave out."""
    return cast(Any, frame).time
