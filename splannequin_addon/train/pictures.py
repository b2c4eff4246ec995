"""Small images on the panel: the training's preview, and its error over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy.utils.previews
import numpy as np

_PLOT = (256, 128)
_KEPT = 16
_collection: Any = None


def icon_of(path: Path) -> int:
    """Icon of an image file; 0 if it does not exist. It is loaded once: call `forget` after the file is rewritten."""
    if _collection is None:
        return 0
    name = str(path)
    if name not in _collection:
        if not path.is_file():
            return 0
        _make_room()
        _collection.load(name, name, "IMAGE")
    return int(_collection[name].icon_id)


def plot(points: Sequence[tuple[float, float]]) -> int:
    """Icon of a curve through (seconds, dB); 0 for fewer than two points."""
    if _collection is None or len(points) < 2:
        return 0
    name = f"plot {len(points)} {points[0]} {points[-1]}"
    if name not in _collection:
        _make_room()
        picture = _collection.new(name)
        picture.image_size = _PLOT
        picture.image_pixels_float.foreach_set(curve(points, _PLOT).ravel())
    return int(_collection[name].icon_id)


def curve(points: Sequence[tuple[float, float]], size: tuple[int, int]) -> np.ndarray:
    """[H, W, 4] float32, last row on top: a polyline through the points, scaled to the image, on a dark background."""
    width, height = size
    picture = np.zeros((height, width, 4), np.float32)
    picture[...] = (0.11, 0.11, 0.11, 1.0)
    places = np.array(points, dtype=np.float64)
    x, y = places[:, 0], places[:, 1]
    spread = [max(float(np.ptp(v)), 1e-6) for v in (x, y)]
    at = np.linspace(0, width - 1, 4 * width)
    level = np.asarray(np.interp(at / (width - 1) * spread[0] + x.min(), x, y), dtype=np.float64)
    rows = 4 + (height - 9) * (level - y.min()) / spread[1]
    for share in (0.25, 0.5, 0.75):
        picture[int(share * height), :, :3] = 0.2
    columns = at.round().astype(int)
    for offset in (-1, 0, 1):
        picture[np.clip(rows.round().astype(int) + offset, 0, height - 1), columns, :3] = (0.95, 0.6, 0.15)
    return picture


def forget() -> None:
    """Removes all images. A repeated training writes new ones under the same names."""
    if _collection is not None:
        _collection.clear()


def _make_room() -> None:
    """Removes all images if there are too many."""
    if len(_collection) >= _KEPT:  # a long training would keep hundreds
        _collection.clear()


def register() -> None:
    """Creates the collection, except in background mode."""
    global _collection
    if not bpy.app.background:
        # Previews, so that the artist's file contains no image data-blocks of them.
        _collection = bpy.utils.previews.new()


def unregister() -> None:
    """Removes the collection."""
    global _collection
    if _collection is not None:
        bpy.utils.previews.remove(_collection)
        _collection = None
