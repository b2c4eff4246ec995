"""Colour constants that two programs share: a probe of a colour space, and the display of light. No imports."""

from __future__ import annotations

PROBE = (0.78125, 0.390625, 0.1953125)
"""Red, green and blue in the colour space of a file. A record stores the linear Rec.709 light of this colour. A program
tries each of its colour spaces until one gives that light, and so finds the file's colour space."""

SHOULDER = "shoulder"
"""`display` in the record of an import whose working frames have a shoulder: sRGB up to `SHOULDER_FROM`, and above it
`SHOULDER_FROM + SHOULDER_ROLL * ln(1 + (sRGB - SHOULDER_FROM) / SHOULDER_ROLL)`. Imports without `display` are sRGB."""
SHOULDER_FROM = 0.8
"""sRGB value at which the shoulder begins. The sRGB curve itself continues above 1."""
SHOULDER_ROLL = 0.0414
"""Scale of the shoulder: light of 64 times white becomes 0.9997, and light of 64.9 times white becomes 1."""
