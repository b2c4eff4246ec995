"""The contact sheet of a take: plates above, frozen frames below, to check a freeze at a glance."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from ...footage.images import read_png, resize, write_png

COLUMNS = 8
"""Largest number of frames shown."""
CELL = 256
"""Longest side of a picture on the sheet, in pixels."""

_MARGIN, _GAP, _FRAME = 32, 12, 3
_TITLE_SIZE, _LABEL_SIZE = 28, 18
_GROUND = (30, 30, 30)
_TEXT, _QUIET, _ACCENT = (0.93, 0.93, 0.93), (0.62, 0.62, 0.62), (0.98, 0.76, 0.30)
_ALARM = (226, 74, 51)
_FLAG = 22
"""Side in pixels of the corner that marks a frame whose freeze is unreliable."""
_FONT, _BOLD = "DroidSans", "DroidSans-Bold"


def write_contact_sheet(
    path: str | Path,
    plates: Sequence[Path] | None,
    frozen: Sequence[Path],
    frames: Sequence[int],
    title: str,
    *,
    mark: int | None = None,
    columns: int = COLUMNS,
    note: str = "",
    unsure: Collection[int] = (),
) -> Path:
    """Writes the sheet as 8-bit PNG, atomically.

    `plates` and `frozen` are display-referred PNGs, one per number in `frames`. `plates` None (as for a new camera
    path) omits that row. At most `columns` evenly spaced frames are shown, including the first and the last. `mark`,
    the frame number of t*, is always shown if it is in `frames`, and is outlined. `note` is printed under the title.
    Frozen frames whose numbers are in `unsure` get a red corner.

    ValueError if the lists differ in length or are empty; FileNotFoundError or ValueError for a picture that is
    missing or damaged; OSError if the sheet cannot be written.
    """
    rows = {"Plate": plates, "Frozen": frozen} if plates is not None else {"Frozen": frozen}
    if not len(frames) or any(len(pictures) != len(frames) for pictures in rows.values()):
        counts = ", ".join(f"{len(pictures)} {name.lower()}" for name, pictures in rows.items())
        raise ValueError(
            f"plates and frozen should be as many as frames ({len(frames)}) and at least one, got {counts}"
        )
    picked = pick_columns(frames, columns, mark)
    cells = {name: _thumbnails([pictures[i] for i in picked]) for name, pictures in rows.items()}
    size = (
        max(t.shape[1] for row in cells.values() for t in row),
        max(t.shape[0] for row in cells.values() for t in row),
    )
    labels = [str(frames[i]) for i in picked]
    marked = [mark is not None and frames[i] == mark for i in picked]
    for column, index in enumerate(picked):
        if frames[index] in unsure:
            _flag(cells["Frozen"][column])
    write_png(path, _compose(cells, size, labels, marked, title, note))
    return Path(path)


def pick_columns(frames: Sequence[int], columns: int = COLUMNS, mark: int | None = None) -> list[int]:
    """Indices of at most `columns` evenly spaced `frames`, including the first, the last and `mark`."""
    if columns < 1:
        raise ValueError(f"columns should be at least 1, got {columns}")
    picked = [round(x) for x in np.linspace(0, len(frames) - 1, min(columns, len(frames)))]
    if mark is not None and mark in frames:
        at = list(frames).index(mark)
        # A middle column is replaced, if possible, so that first and last stay.
        inner = (
            range(1, len(picked) - 1) if len(picked) > 2 and at not in (picked[0], picked[-1]) else range(len(picked))
        )
        picked[min(inner, key=lambda column: abs(picked[column] - at))] = at
    return picked


def _thumbnails(paths: Sequence[Path]) -> list[NDArray[np.uint8]]:
    """Pictures [h,w,3] uint8 with a longest side of `CELL` pixels."""
    thumbnails: list[NDArray[np.uint8]] = []
    for path in paths:
        picture = read_png(path)
        if picture.dtype == np.uint16:
            picture = ((picture.astype(np.uint32) + 128) // 257).astype(np.uint8)
        scale = CELL / max(picture.shape[:2])
        height, width = (max(1, round(side * scale)) for side in picture.shape[:2])
        thumbnails.append(resize(picture, width, height))
    return thumbnails


def _compose(
    cells: dict[str, list[NDArray[np.uint8]]],
    size: tuple[int, int],
    labels: list[str],
    marked: list[bool],
    title: str,
    note: str,
) -> NDArray[np.uint8]:
    """The sheet [H,W,3] uint8: title, note, one row per entry of `cells`, and frame numbers under the last row."""
    width, height = size
    left = _MARGIN + max(oiio.ImageBufAlgo.text_size(name, _LABEL_SIZE, _FONT).xend for name in cells) + 2 * _GAP
    columns = len(labels)
    title_end = _MARGIN + oiio.ImageBufAlgo.text_size(title, _TITLE_SIZE, _BOLD).xend
    sheet_width = max(left + columns * (width + _GAP) - _GAP, title_end) + _MARGIN
    lines = _wrapped(note, sheet_width - 2 * _MARGIN)
    below = _MARGIN + _TITLE_SIZE + _GAP
    top = below + len(lines) * (_LABEL_SIZE + _GAP // 2) + _GAP
    sheet_height = top + len(cells) * (height + _GAP) + _LABEL_SIZE + _MARGIN
    sheet = np.full((sheet_height, sheet_width, 3), _GROUND, dtype=np.uint8)
    for row, thumbnails in enumerate(cells.values()):
        for column, thumbnail in enumerate(thumbnails):
            y = top + row * (height + _GAP) + (height - thumbnail.shape[0]) // 2
            x = left + column * (width + _GAP) + (width - thumbnail.shape[1]) // 2
            if marked[column]:
                _block(sheet, y, x, thumbnail.shape, _FRAME)[:] = np.round(np.multiply(_ACCENT, 255))
            _block(sheet, y, x, thumbnail.shape, 0)[:] = thumbnail
    image = oiio.ImageBuf(sheet)
    _write(image, title, _MARGIN, _MARGIN, _TITLE_SIZE, _BOLD, _TEXT, "left", "top")
    for number, line in enumerate(lines):
        y = below + number * (_LABEL_SIZE + _GAP // 2)
        _write(image, line, _MARGIN, y, _LABEL_SIZE, _FONT, _QUIET, "left", "top")
    for row, name in enumerate(cells):
        middle = top + row * (height + _GAP) + height // 2
        _write(image, name, _MARGIN, middle, _LABEL_SIZE, _FONT, _QUIET, "left", "center")
    for column, label in enumerate(labels):
        text, colour = (f"{label}  t*", _ACCENT) if marked[column] else (label, _TEXT)
        x = left + column * (width + _GAP) + width // 2
        _write(image, text, x, top + len(cells) * (height + _GAP), _LABEL_SIZE, _FONT, colour, "center", "top")
    return np.asarray(image.get_pixels(oiio.UINT8))


def _wrapped(text: str, width: int) -> list[str]:
    """`text` wrapped into lines of at most `width` pixels; a longer word gets its own line."""
    lines: list[str] = []
    for word in text.split():
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and oiio.ImageBufAlgo.text_size(longer, _LABEL_SIZE, _FONT).xend <= width:
            lines[-1] = longer
        else:
            lines.append(word)
    return lines


def _flag(picture: NDArray[np.uint8]) -> None:
    """Marks the upper right corner of a picture [h,w,3] in place."""
    height, width = picture.shape[:2]
    rows, columns = np.mgrid[0:height, 0:width]
    picture[columns - rows >= width - _FLAG] = _ALARM


def _block(sheet: NDArray[np.uint8], y: int, x: int, shape: tuple[int, ...], border: int) -> NDArray[np.uint8]:
    return sheet[y - border : y + shape[0] + border, x - border : x + shape[1] + border]


def _write(
    image: oiio.ImageBuf,
    text: str,
    x: int,
    y: int,
    size: int,
    font: str,
    colour: tuple[float, float, float],
    across: str,
    down: str,
) -> None:
    """Draws one line of text with a font that ships with OpenImageIO."""
    if not oiio.ImageBufAlgo.render_text(image, x, y, text, size, font, colour, alignx=across, aligny=down):
        raise OSError(f"cannot draw text on the contact sheet: {image.geterror()}")
