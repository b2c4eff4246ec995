"""Names that mark our data-blocks, nodes and objects, and names of output files."""

from __future__ import annotations

from pathlib import Path

TAG = "splannequin"
MATTE_SHOT = "splannequin_matte_shot"
"""Property of an image with a painted motion matte: the shot folder in the form stored in a .blend."""
BAKES = "bake"
"""Default folder of bakes inside a shot."""
DIGITS = "######"
"""File name pattern of baked images: the frame number."""


def rendered_of(path: Path) -> Path | None:
    """The shot of an output path of ours, given without escapes of braces; None for the artist's path."""
    ours = path.name == DIGITS and len(path.parents) > 2 and path.parents[1].name == BAKES
    return path.parents[2] if ours else None
