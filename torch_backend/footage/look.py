"""Looks of cameras: a .cube table (1D or 3D) that makes a picture for a display of what a camera recorded.

OpenImageIO's OpenColorIO reads and applies it. Its output counts as display-referred sRGB, as players and editors show
it: working frames, plates and all that leaves are made of that, so they agree. Light beyond white is cut by most
tables.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from ..contract import open_regular
from .color import Curve, InputSpace, linear_to_srgb, srgb_to_linear
from .images import error_of
from .sources import footage_error

_CONFIG = "ocio://default"
"""A table needs no configuration, but OpenImageIO reads one: this takes half the time of the studio's."""
_MOST_BYTES = 64 << 20
"""Of a file: a cube of 129 steps, the largest that OpenColorIO reads, takes about that."""


@dataclass(frozen=True)
class LookSpace(InputSpace):
    """What the numbers in a picture mean: what a table makes of them is for a display."""

    file: str = ""
    """The table."""
    digest: str = ""
    """Of its content."""

    @property
    def name(self) -> str:
        """As people read it."""
        return f"by the look {Path(self.file).name}"

    @property
    def as_it_stands(self) -> bool:
        """False: every picture goes through the table."""
        return False

    @property
    def origin(self) -> dict[str, str]:
        """The table, by its content."""
        return {"look": self.digest}

    @property
    def rows(self) -> int:
        """Many: each call has a cost of its own."""
        return 1024

    def _light(self, pixels: NDArray[np.float32]) -> tuple[NDArray[np.float32], Curve]:
        return srgb_to_linear(_through(pixels, self.file)), linear_to_srgb


def look_space(file: str) -> LookSpace:
    """The space of pictures that are seen through a .cube file. JobError if it is invalid, or cannot be read."""
    path = Path(file)
    hint = "Choose a 1D or 3D look as .cube."
    if path.suffix.lower() != ".cube":
        raise footage_error(f"{path.name} is no .cube file.", hint)
    try:
        with open_regular(path) as handle:
            content = handle.read(_MOST_BYTES + 1)
    except OSError as error:
        raise footage_error(f"The look {file} cannot be read: {error.strerror or error}.", hint) from error
    if len(content) > _MOST_BYTES:
        raise footage_error(f"The look {path.name} is larger than {_MOST_BYTES >> 20} MB.", "Export it smaller: 65.")
    space = LookSpace("srgb", file=str(path.absolute()), digest=hashlib.sha256(content).hexdigest()[:16])
    shown = _through(np.linspace(0.0, 1.0, 12, dtype=np.float32).reshape(1, 4, 3), space.file)
    if not np.isfinite(shown).all():
        raise footage_error(f"The look {path.name} holds values that are no numbers.", "Export it again.")
    return space


def _through(pixels: NDArray[np.float32], file: str) -> NDArray[np.float32]:
    """[H, W, 3] through a table. JobError if it cannot be read."""
    source = oiio.ImageBuf(np.ascontiguousarray(pixels, np.float32))
    shown = oiio.ImageBufAlgo.ociofiletransform(source, file, False, False, _CONFIG)
    values = None if shown.has_error else shown.get_pixels(oiio.FLOAT)
    if values is None:
        error_of(shown)  # OpenColorIO's own words are about its formats
        raise footage_error(
            f"The look {Path(file).name} is damaged, or no .cube table: it cannot be read.",
            "Export it again as a 1D or 3D .cube.",
        )
    return np.asarray(values, np.float32)
