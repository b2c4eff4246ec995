"""The display encoding of working frames, in which splats blend: maps light to values from 0 to 1.

Footage made for a display stays sRGB. For footage that holds light, sRGB would clip everything above white. Its
encoding adds a shoulder to the extended sRGB curve s, from 0.8 on:

    bent(s) = 0.8 + r ln(1 + (s - 0.8) / r)        s = 0.8 + r (exp((bent - 0.8) / r) - 1)

The slope at 0.8 is continuous, and light 64 lies just below 1. Between light 0.6 and 64, half a step of 16 bits is at
most 4e-4 of the light; half a step of 8 bits is up to a tenth of it.

Code that resamples such pictures (resizing, undistortion) does so in extended sRGB, as for plates.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..contract import SHOULDER, SHOULDER_FROM, SHOULDER_ROLL
from . import plate_encoding
from .color import linear_to_srgb, on_straight_colour, srgb_to_linear
from .sources import footage_error

MOST_LIGHT = 64.0
"""Light that a display with a shoulder is designed to hold, in units of white. Clipping starts slightly above."""
_FROM, _ROLL = np.float32(SHOULDER_FROM), np.float32(SHOULDER_ROLL)
_LARGEST = np.float32(65535.0)
_HALF_MAX = np.float32(65504.0)


@dataclass(frozen=True)
class Display:
    """Conversion between light and the values of working frames."""

    bends: bool
    """True for a display with a shoulder, False for sRGB."""
    most: float = 1.0
    """Largest value in any working frame, if the import recorded it."""

    @property
    def name(self) -> str:
        """Name in the import's record; empty for sRGB."""
        return SHOULDER if self.bends else ""

    def bent(self, srgb: NDArray[np.float32]) -> NDArray[np.float32]:
        """Converts extended sRGB of any shape, float32, to the values of this display."""
        if not self.bends:
            return srgb
        above = np.maximum(srgb - _FROM, np.float32(0.0))
        return np.minimum(srgb, _FROM) + _ROLL * np.log1p(above / _ROLL)

    def straightened(self, shown: NDArray[np.float32]) -> NDArray[np.float32]:
        """The inverse of `bent`."""
        if not self.bends:
            return shown
        above = np.maximum(shown - _FROM, np.float32(0.0))
        with np.errstate(over="ignore"):
            return np.minimum(shown, _FROM) + _ROLL * np.expm1(above / _ROLL)

    def from_light(self, light: ArrayLike) -> NDArray[np.float32]:
        """Converts scene-linear Rec.709 of any shape to this display, float32, unclipped."""
        return self.bent(linear_to_srgb(light))

    def to_light(self, shown: ArrayLike) -> NDArray[np.float32]:
        """The inverse of `from_light`."""
        return srgb_to_linear(self.straightened(np.asarray(shown, np.float32)))

    def premultiplied_to_light(self, rgba: NDArray[np.float32]) -> NDArray[np.float32]:
        """Converts blended colour of this display [..., 4], premultiplied by alpha, to premultiplied scene-linear.

        The curve acts on the unpremultiplied colour, see `color.on_straight_colour`.
        """
        return on_straight_colour(rgba, self.to_light)

    def codes_of(self, plate: NDArray[np.float16], width: int, height: int) -> NDArray[np.uint16]:
        """Converts a plate of light [h, w, 3] (see `plate_encoding`) to a working frame [height, width, 3].

        Raises ValueError if this display has no shoulder, because sRGB would clip the light.
        """
        if not self.bends:
            raise ValueError("a display without a shoulder cannot show scene-linear light")
        # Resize before the shoulder: after it, a kernel that rings by a twentieth would triple the light of a lamp's
        # rim.
        small = plate_encoding.resize_plate(plate, width, height)
        out = np.empty(small.shape, np.uint16)
        for top in range(0, height, plate_encoding.ROWS):
            rows = slice(top, top + plate_encoding.ROWS)
            out[rows] = self.codes(plate_encoding.display(small[rows]))
        return out

    def codes(self, srgb: NDArray[np.float32]) -> NDArray[np.uint16]:
        """Converts extended sRGB of any shape to the codes of a 16-bit working frame."""
        return np.rint(np.clip(self.bent(srgb), 0.0, 1.0) * _LARGEST).astype(np.uint16)

    def srgb_of(self, codes: NDArray[Any]) -> NDArray[np.float32]:
        """Converts codes of a working frame, uint8 or uint16 of any shape, to extended sRGB."""
        return self.straightened(plate_encoding.display(codes))

    def light_of(self, codes: NDArray[Any]) -> NDArray[np.float16]:
        """Converts a working frame [H, W, 3] to a plate of light, see `plate_encoding`."""
        out = np.empty(codes.shape, np.float16)
        for top in range(0, len(codes), plate_encoding.ROWS):
            rows = slice(top, top + plate_encoding.ROWS)
            out[rows] = np.minimum(srgb_to_linear(self.srgb_of(codes[rows])), _HALF_MAX)
        return out


PLAIN = Display(bends=False)
"""sRGB: for footage made for a display, and for imports by versions without the shoulder."""
ROLLED = Display(bends=True)
"""Display with a shoulder: for footage that holds light."""


def clipped_share(plate: NDArray[np.float16]) -> float:
    """Share of the pixels of a plate of light [H, W, 3] above `MOST_LIGHT`."""
    # Non-negative half floats have the order of their bit patterns. Comparing integers is ten times faster.
    return float((plate.view(np.int16) > np.float16(MOST_LIGHT).view(np.int16)).any(axis=-1).mean())


def display_of(record: dict[str, Any]) -> Display:
    """The display of an import's working frames, from its frames.json. Raises JobError if this version lacks it."""
    name = str(record.get("display") or "")
    if name == PLAIN.name:
        return PLAIN
    if name == ROLLED.name:
        return Display(bends=True, most=float(record.get("brightest", 1.0)))
    raise footage_error(
        f"The working frames use a display encoding that this version does not know: {name!r}.",
        "Update Splannequin, or import the clip again.",
    )
