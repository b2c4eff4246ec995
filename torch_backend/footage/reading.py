"""Sentences for the artist about the interpretation of footage."""

from __future__ import annotations

from .orientation import Orientation
from .sources import SourceInfo

_MATRICES = {"ITU709": "BT.709", "ITU601": "BT.601", "BT2020": "BT.2020", "SMPTE240M": "SMPTE 240M"}
_ASSUMED = {
    "fps_told": "rate", "pixel_aspect_told": "pixel aspect", "colour_told": "colour space", "matrix_told": "matrix",
    "range_told": "levels",
}  # fmt: skip
"""Key of a reading that is False if the property was assumed -> name of the property for messages."""


def read_as(info: SourceInfo, timecode: str = "") -> list[str]:
    """Sentences: how the footage is read, from which files, and which properties were assumed.

    `timecode` is that of the first imported frame.
    """
    reading = info.reading
    aspect = float(reading.get("pixel_aspect", 1.0))
    parts = [f"{info.width} x {info.height}", "square pixels" if aspect == 1 else f"pixels {aspect:.4g} times as wide"]
    parts += [f"{info.fps:.6g} fps"] + [f"{reading['bits']} bits"] * ("bits" in reading)
    parts += [str(reading.get("colour", ""))]
    matrix = reading.get("matrix", "RGB")
    if matrix != "RGB":
        parts += [f"matrix {_MATRICES.get(matrix, matrix)}", f"{reading.get('range')} levels"]
    if len(reading.get("layers", [])) > 1:
        parts.append(f"layer {reading['layer'] or 'RGB'}")
    parts.append("alpha left out" if reading.get("alpha") else "no alpha")
    if reading.get("interlaced"):
        parts.append("deinterlaced")
    if words := Orientation(int(reading.get("orientation", 1))).words:
        parts.append(words)
    if reading.get("focal_35mm"):
        parts.append(f"a lens of {reading['focal_35mm']:.4g} mm (on 35 mm film)")
    if timecode:
        parts.append(f"timecode {timecode}")
    assumed = [name for key, name in _ASSUMED.items() if not reading.get(key, True)]
    if matrix == "RGB":
        assumed = [name for name in assumed if name not in ("matrix", "levels")]
    sentences = [f"Read as {', '.join(part for part in parts if part)}."]
    if reading.get("files"):
        first, last = reading["numbers"]
        sentences.append(f"Frames {first} to {last} are read from {reading['files']}.")
    return sentences + [f"Assumed, because the footage does not state it: {', '.join(assumed)}."] * bool(assumed)
