"""Camera looks: a .cube table (1D or 3D) that converts recorded values to a picture for a display.

OpenImageIO's OpenColorIO reads and applies the table. Its output counts as display-referred sRGB, as in players and
editors. Working frames, plates and output all use it, so that they agree. Most tables clip light above white.
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

# Configuration for OpenImageIO, which loads one although a table needs none. It loads twice as fast as the studio
# configuration.
_CONFIG = "ocio://default"
# Maximum size of a file: about that of a cube of 129 steps, the largest that OpenColorIO reads.
_MOST_BYTES = 64 << 20


@dataclass(frozen=True)
class LookSpace(InputSpace):
    """Colour space of pictures that a table converts for a display."""

    file: str = ""
    """Path of the table."""
    digest: str = ""
    """Digest of the table's content."""

    @property
    def name(self) -> str:
        """Name for messages."""
        return f"by the look {Path(self.file).name}"

    @property
    def is_passthrough(self) -> bool:
        """False: every picture goes through the table."""
        return False

    @property
    def origin(self) -> dict[str, str]:
        """Digest of the table, for the import's record."""
        return {"look": self.digest}

    @property
    def rows(self) -> int:
        """Number of rows to convert at a time: many, because each call has a fixed cost."""
        return 1024

    def _light(self, pixels: NDArray[np.float32]) -> tuple[NDArray[np.float32], Curve]:
        return srgb_to_linear(_through(pixels, self.file)), linear_to_srgb


def look_space(file: str) -> LookSpace:
    """The colour space of pictures with the look of a .cube file. Raises JobError if the file is unusable."""
    path = Path(file)
    hint = "Choose a 1D or 3D look as .cube."
    if path.suffix.lower() != ".cube":
        raise footage_error(f"{path.name} is not a .cube file.", hint)
    try:
        with open_regular(path) as handle:
            content = handle.read(_MOST_BYTES + 1)
    except OSError as error:
        raise footage_error(f"The look {file} cannot be read: {error.strerror or error}.", hint) from error
    if len(content) > _MOST_BYTES:
        raise footage_error(
            f"The look {path.name} is larger than {_MOST_BYTES >> 20} MB.", "Export it with a smaller size, such as 65."
        )
    space = LookSpace("srgb", file=str(path.absolute()), digest=hashlib.sha256(content).hexdigest()[:16])
    shown = _through(np.linspace(0.0, 1.0, 12, dtype=np.float32).reshape(1, 4, 3), space.file)
    if not np.isfinite(shown).all():
        raise footage_error(f"The look {path.name} contains values that are not numbers.", "Export it again.")
    return space


def _through(pixels: NDArray[np.float32], file: str) -> NDArray[np.float32]:
    """Applies a table to [H, W, 3]. Raises JobError if the table cannot be read."""
    source = oiio.ImageBuf(np.ascontiguousarray(pixels, np.float32))
    shown = oiio.ImageBufAlgo.ociofiletransform(source, file, False, False, _CONFIG)
    values = None if shown.has_error else shown.get_pixels(oiio.FLOAT)
    if values is None:
        error_of(shown)  # clears the error; OpenColorIO's message is about file formats
        raise footage_error(
            f"The look {Path(file).name} cannot be read: it is damaged, or not a .cube table.",
            "Export it again as a 1D or 3D .cube.",
        )
    return np.asarray(values, np.float32)
