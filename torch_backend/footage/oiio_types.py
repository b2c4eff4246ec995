"""Typed wrappers for OpenImageIO calls without type stubs. Each function is one call and a cast."""

from pathlib import Path
from typing import Any, cast

import OpenImageIO as oiio

Attribute = int | float | str | tuple[int | float, ...] | None


def channel_names(spec: oiio.ImageSpec) -> tuple[str, ...]:
    """Channel names of a picture, in the file's order."""
    return cast(Any, spec).channelnames


def bits_of(spec: oiio.ImageSpec) -> int:
    """Bits per channel as stored in the file."""
    stored = attribute(spec, "oiio:BitsPerSample")
    return int(stored) if isinstance(stored, int) and stored > 0 else 8 * int(cast(Any, spec.format).basesize())


def open_output(output: oiio.ImageOutput, file: Path, spec: oiio.ImageSpec) -> bool:
    """Opens a file for writing one picture. Returns False on failure."""
    return cast(Any, output).open(str(file), spec)


def attribute(spec: oiio.ImageSpec, name: str) -> Attribute:
    """A metadata attribute of a file; None if missing."""
    return cast(Attribute, spec.getattribute(name))
