"""A colour by which two programs find out that they mean the same colour space, whatever each calls it. No imports."""

from __future__ import annotations

PROBE = (0.78125, 0.390625, 0.1953125)
"""Red, green and blue as they stand in a file. A record says what linear Rec.709 light they mean; a program reads them
in one of its own colour spaces after the other until it sees that light."""
