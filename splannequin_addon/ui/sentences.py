"""Draws sentences with line breaks, and rows of tables."""

from __future__ import annotations

import re
import textwrap
from typing import TYPE_CHECKING

from ..access import Icon
from ..translations import tr

if TYPE_CHECKING:
    import bpy

# Average width of a letter in pixels, at a user interface scale of 1.
_LETTER = 6.2
_UNIT = re.compile(r"(?<=\d) (?=(%|px|dB|fps|s|min|h|[KMG]B)(?!\w))")
_BOUND = "\N{NO-BREAK SPACE}"


def wrap(
    layout: bpy.types.UILayout,
    context: bpy.types.Context,
    text: str,
    icon: Icon = "NONE",
    margin: int = 50,
    width: int = 0,
) -> None:
    """Draws a sentence in the interface's language, wrapped to the available width.

    Args:
        layout: layout to draw in.
        context: context with the region.
        text: the sentence in English.
        icon: icon before the first line.
        margin: horizontal space in pixels that is not available.
        width: total width in pixels, for a dialog; 0: the region's width.
    """
    room = (width or context.region.width / context.preferences.system.ui_scale) - margin
    room -= 25 if icon != "NONE" else 0
    column = layout.column(align=True)
    column.scale_y = 0.8
    # A label has no line breaks of its own: Blender truncates a long one.
    for number, line in enumerate(lines(tr(text), max(int(room / _LETTER), 16))):
        column.label(text=line, translate=False, icon=icon if number == 0 else ("BLANK1" if icon != "NONE" else "NONE"))


def lines(text: str, letters: int) -> list[str]:
    """Lines of a text with at most this many letters, at least one line. A number stays with its unit."""
    found = textwrap.wrap(_UNIT.sub(_BOUND, text), letters) or [""]
    return [line.replace(_BOUND, " ") for line in found]


def cells(line: bpy.types.UILayout, widths: tuple[float, ...]) -> list[bpy.types.UILayout]:
    """Parts of a row with relative widths, which sum to 1."""
    parts: list[bpy.types.UILayout] = []
    left = 1.0
    for width in widths[:-1]:
        line = line.split(factor=width / left, align=True)
        parts.append(line.row(align=True))
        left -= width
    return [*parts, line.row(align=True)]
