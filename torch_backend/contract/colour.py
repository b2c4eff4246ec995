"""What two programs have to mean alike by colours: a probe of a colour space, and the display of light. No imports."""

from __future__ import annotations

PROBE = (0.78125, 0.390625, 0.1953125)
"""Red, green and blue as they stand in a file. A record says what linear Rec.709 light they mean; a program reads them
in one of its own colour spaces after the other until it sees that light."""

SHOULDER = "shoulder"
"""`display` in the record of an import whose working frames have a shoulder: sRGB up to `SHOULDER_FROM`, and above it
`SHOULDER_FROM + SHOULDER_ROLL * ln(1 + (sRGB - SHOULDER_FROM) / SHOULDER_ROLL)`. Imports without one are sRGB."""
SHOULDER_FROM = 0.8
"""Value of sRGB, whose own curve goes on above 1, from which on it is bent."""
SHOULDER_ROLL = 0.0414
"""How slowly: light 64 times white becomes 0.9997, and 1 is light 64.9."""
