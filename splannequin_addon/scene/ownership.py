"""Names that mark our data-blocks, nodes and objects, and names of output files."""

from __future__ import annotations

TAG = "splannequin"
MATTE_SHOT = "splannequin_matte_shot"
"""Property of an image with a painted motion matte: the shot folder in the form stored in a .blend."""
BAKES = "bake"
"""Default folder of bakes inside a shot."""
DIGITS = "######"
"""File name pattern of baked images: the frame number."""
