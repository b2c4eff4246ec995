"""Types for what OpenImageIO leaves without any: each function is that call and a cast."""

from pathlib import Path
from typing import Any, cast

import OpenImageIO as oiio

Attribute = int | float | str | tuple[int | float, ...] | None


def channel_names(spec: oiio.ImageSpec) -> tuple[str, ...]:
    """Channels of a picture, in its order."""
    return cast(Any, spec).channelnames


def bits_of(spec: oiio.ImageSpec) -> int:
    """Bits of a channel as the file stores it."""
    stored = attribute(spec, "oiio:BitsPerSample")
    return int(stored) if isinstance(stored, int) and stored > 0 else 8 * int(cast(Any, spec.format).basesize())


def open_output(output: oiio.ImageOutput, file: Path, spec: oiio.ImageSpec) -> bool:
    """Begins a file that holds one picture; False if that failed."""
    return cast(Any, output).open(str(file), spec)


def attribute(spec: oiio.ImageSpec, name: str) -> Attribute:
    """What a file says under a name; None if it says nothing."""
    return cast(Attribute, spec.getattribute(name))
