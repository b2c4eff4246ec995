"""The display in which working frames are kept and splats blend: light on one side, 0 to 1 on the other.

Footage that was made for a display stays as it stands, sRGB. Of footage that holds light sRGB would lose all above
white; there a shoulder bends sRGB's own curve, which goes on above 1, from 0.8 on:

    bent(s) = 0.8 + r ln(1 + (s - 0.8) / r)        s = 0.8 + r (exp((bent - 0.8) / r) - 1)

with the same slope at 0.8, and light 64 just below 1. Half a step of 16 bits is at most 4e-4 of the light anywhere
between 0.6 and 64, half a step of 8 bits up to a tenth of it.

Whatever resamples such pictures (smaller, without the lens) does so on sRGB's own curve, as it does with plates: a
kernel that rings by a twentieth would make a lamp's rim three times as bright on the bent one.
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
"""Light that a display with a shoulder is made to hold, in units of white; a little more is not cut yet."""
_FROM, _ROLL = np.float32(SHOULDER_FROM), np.float32(SHOULDER_ROLL)
_LARGEST = np.float32(65535.0)
_HALF_MAX = np.float32(65504.0)


@dataclass(frozen=True)
class Display:
    """How light and the numbers of working frames become each other."""

    bends: bool
    """True if there is a shoulder, False for sRGB."""
    most: float = 1.0
    """The largest number in any working frame, if the import noted it."""

    @property
    def name(self) -> str:
        """As the record of an import has it; empty for sRGB."""
        return SHOULDER if self.bends else ""

    def bent(self, srgb: NDArray[np.float32]) -> NDArray[np.float32]:
        """Extended sRGB of any shape, float32, to this display's numbers; itself if it is sRGB."""
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
        """Scene-linear Rec.709 of any shape to this display, float32, nothing cut."""
        return self.bent(linear_to_srgb(light))

    def to_light(self, shown: ArrayLike) -> NDArray[np.float32]:
        """The inverse of `from_light`."""
        return srgb_to_linear(self.straightened(np.asarray(shown, np.float32)))

    def premultiplied_to_light(self, rgba: NDArray[np.float32]) -> NDArray[np.float32]:
        """[..., 4] colour premultiplied by alpha, as splats blend it here, to scene-linear, premultiplied by alpha.

        The display acts on the colour that is seen, see `color.on_straight_colour`.
        """
        return on_straight_colour(rgba, self.to_light)

    def codes_of(self, plate: NDArray[np.float16], width: int, height: int) -> NDArray[np.uint16]:
        """A plate of light [h, w, 3], as `plate_encoding` has it, as the working frame [height, width, 3] of that size.

        ValueError if this display has no shoulder: light is not kept without one.
        """
        if not self.bends:
            raise ValueError("a display without a shoulder does not hold light")
        small = plate_encoding.resize_plate(plate, width, height)
        out = np.empty(small.shape, np.uint16)
        for top in range(0, height, plate_encoding.ROWS):
            rows = slice(top, top + plate_encoding.ROWS)
            out[rows] = self.codes(plate_encoding.display(small[rows]))
        return out

    def codes(self, srgb: NDArray[np.float32]) -> NDArray[np.uint16]:
        """Extended sRGB of any shape to what a working frame of 16 bits stores of it."""
        return np.rint(np.clip(self.bent(srgb), 0.0, 1.0) * _LARGEST).astype(np.uint16)

    def srgb_of(self, codes: NDArray[Any]) -> NDArray[np.float32]:
        """What a working frame stores, uint8 or uint16 of any shape, to extended sRGB."""
        return self.straightened(plate_encoding.display(codes))

    def light_of(self, codes: NDArray[Any]) -> NDArray[np.float16]:
        """A working frame [H, W, 3] as a plate of light, see `plate_encoding`."""
        out = np.empty(codes.shape, np.float16)
        for top in range(0, len(codes), plate_encoding.ROWS):
            rows = slice(top, top + plate_encoding.ROWS)
            out[rows] = np.minimum(srgb_to_linear(self.srgb_of(codes[rows])), _HALF_MAX)
        return out


PLAIN = Display(bends=False)
"""sRGB: of footage made for a display, and of all that was imported before there was a shoulder."""
ROLLED = Display(bends=True)
"""Of footage that holds light."""


def clipped_share(plate: NDArray[np.float16]) -> float:
    """Share of the pixels of a plate of light [H, W, 3] with more than `MOST_LIGHT`."""
    # Halves that are not negative are ordered as their bits are: ten times as quick.
    return float((plate.view(np.int16) > np.float16(MOST_LIGHT).view(np.int16)).any(axis=-1).mean())


def display_of(record: dict[str, Any]) -> Display:
    """The display of an import's working frames, by its record (frames.json). JobError if it is not known here."""
    name = str(record.get("display") or "")
    if name == PLAIN.name:
        return PLAIN
    if name == ROLLED.name:
        return Display(bends=True, most=float(record.get("brightest", 1.0)))
    raise footage_error(
        f"The working frames are in a display that this version does not know: {name!r}.",
        "Update Splannequin, or import the clip again.",
    )
