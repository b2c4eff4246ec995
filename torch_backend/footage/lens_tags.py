"""Reads the focal length from file metadata, as the 35 mm equivalent that phones write."""

from __future__ import annotations

import math
from typing import Any

import OpenImageIO as oiio

from .oiio_types import attribute

FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
"""Diagonal of 35 mm film. The equivalent focal length has the same diagonal angle of view (CIPA DCG-001)."""
FOCAL_LIMITS_MM = (5.0, 2000.0)
"""Range of valid focal lengths. Cameras write 0 for an unknown value."""
_QUICKTIME = "com.apple.quicktime.camera.focal_length.35mm_equivalent"


def focal_of_picture(spec: oiio.ImageSpec) -> float | None:
    """35 mm equivalent focal length in mm from a picture's Exif; None if missing."""
    return _believable(attribute(spec, "Exif:FocalLengthIn35mmFilm"))


def focal_of_video(container: Any, stream: Any) -> float | None:
    """35 mm equivalent focal length in mm from the QuickTime keys of a video; None if missing."""
    tables = [stream.metadata, container.metadata]
    values = (_believable(table[key]) for table in tables for key in table if key.lower() == _QUICKTIME)
    return next((focal for focal in values if focal is not None), None)


def focal_px(focal_mm: float, width: int, height: int) -> float:
    """Focal length in pixels for frames of a size, from the 35 mm equivalent in mm."""
    return focal_mm / FILM_DIAGONAL_MM * math.hypot(width, height)


def _believable(value: object) -> float | None:
    if not isinstance(value, (int, float, str)):
        return None
    try:
        focal = float(value)
    except ValueError:
        return None
    return focal if FOCAL_LIMITS_MM[0] <= focal <= FOCAL_LIMITS_MM[1] else None
