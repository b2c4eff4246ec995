"""What files say of the lens: the focal length that gives the same view on 35 mm film, as phones write it."""

from __future__ import annotations

import math
from typing import Any

import OpenImageIO as oiio

from .oiio_types import attribute

FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
"""The equivalent focal length is for the same angle over the diagonal (CIPA DCG-001)."""
FOCAL_LIMITS_MM = (5.0, 2000.0)
"""What is outside is no focal length: cameras write 0 where they do not know."""
_QUICKTIME = "com.apple.quicktime.camera.focal_length.35mm_equivalent"


def focal_of_picture(spec: oiio.ImageSpec) -> float | None:
    """Millimetres on 35 mm film by a picture's Exif; None if it does not say."""
    return _believable(attribute(spec, "Exif:FocalLengthIn35mmFilm"))


def focal_of_video(container: Any, stream: Any) -> float | None:
    """Millimetres on 35 mm film by the QuickTime keys of a video; None if it does not say."""
    tables = [stream.metadata, container.metadata]
    values = (_believable(table[key]) for table in tables for key in table if key.lower() == _QUICKTIME)
    return next((focal for focal in values if focal is not None), None)


def focal_px(focal_mm: float, width: int, height: int) -> float:
    """Focal length in pixels of frames of a size, for one in millimetres on 35 mm film."""
    return focal_mm / FILM_DIAGONAL_MM * math.hypot(width, height)


def _believable(value: object) -> float | None:
    if not isinstance(value, (int, float, str)):
        return None
    try:
        focal = float(value)
    except ValueError:
        return None
    return focal if FOCAL_LIMITS_MM[0] <= focal <= FOCAL_LIMITS_MM[1] else None
