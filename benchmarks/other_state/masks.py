"""Reads the painted polygons and draws them as labels of a source frame or of its undistorted plate."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from torch_backend.contract import read_json

CLIPS = ("sitting", "kitchen", "hall")
"""Clips of shared/footage that have masks."""
SAME, CHANGED, UNSCORED = 0, 1, 2
"""Labels of a pixel: plate t* shows the same, another state, or it cannot be decided."""

Labels = NDArray[np.uint8]


@dataclass(frozen=True)
class Polygon:
    """One painted region of a frame."""

    points: NDArray[np.float64]
    """[N, 2] corners x, y in pixels of the source frame, pixel centres at +0.5."""
    shows: str
    """Content of the frame in the polygon."""
    label: int
    """CHANGED, or UNSCORED where the polygon is uncertain."""


@dataclass(frozen=True)
class Pair:
    """The truth of one frozen frame."""

    t_star: int
    """Frame number of the frozen instant, counted from 1."""
    frame: int
    """Frame number of the painted plate."""
    border_px: int
    """Unscored pixels on either side of an edge between labels: 2 for a sharp frame, 4 for a blurred one."""
    polygons: tuple[Polygon, ...]
    """Polygons in painting order; a later one replaces earlier ones."""


@dataclass(frozen=True)
class Painted:
    """The masks of one clip."""

    clip: str
    """Name of the video, without its ending."""
    sha256: str
    """Digest of the painted video file."""
    width: int
    """Width of a source frame in pixels."""
    height: int
    """Height of a source frame in pixels."""
    pairs: tuple[Pair, ...]
    """Ascending in t* and frame."""

    def labels(self, pair: Pair) -> Labels:
        """[height, width] labels of a source frame."""
        labels = np.full((self.height, self.width), SAME, np.uint8)
        for polygon in pair.polygons:
            fill_polygon(labels, polygon.points, polygon.label)
        size = 2 * pair.border_px + 1
        is_edge = ndimage.maximum_filter(labels, size) != ndimage.minimum_filter(labels, size)
        labels[is_edge] = UNSCORED
        return labels


def fill_polygon(labels: Labels, points: NDArray[np.float64], label: int) -> None:
    """Sets the pixels whose centres lie inside a polygon, by the even-odd rule.

    Args:
        labels: [H, W], changed in place.
        points: [N, 2] corners x, y in pixels; the polygon is closed automatically.
        label: Label of these pixels.
    """
    height, width = labels.shape
    low = np.clip(np.floor(points.min(0)).astype(int), 0, (width, height))
    high = np.clip(np.ceil(points.max(0)).astype(int), 0, (width, height))
    x, y = np.arange(low[0], high[0]) + 0.5, (np.arange(low[1], high[1]) + 0.5)[:, None]
    is_inside = np.zeros((high[1] - low[1], high[0] - low[0]), bool)
    for (ax, ay), (bx, by) in zip(points, np.roll(points, -1, axis=0), strict=True):
        if ay != by:
            is_inside ^= ((ay > y) != (by > y)) & (x < ax + (y - ay) * (bx - ax) / (by - ay))
    labels[low[1] : high[1], low[0] : high[0]][is_inside] = label


def plate_labels(labels: Labels, where: NDArray[np.float32]) -> Labels:
    """Labels of an undistorted plate.

    Args:
        labels: [H, W] labels of the source frame.
        where: [h, w, 2] position x, y in the source frame of each pixel of the plate, pixel centres at +0.5.

    Returns:
        [h, w] labels; UNSCORED for pixels outside the source frame.
    """
    height, width = labels.shape
    x, y = np.floor(where[..., 0]).astype(int), np.floor(where[..., 1]).astype(int)
    is_inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    found = labels[y.clip(0, height - 1), x.clip(0, width - 1)]
    return np.where(is_inside, found, np.uint8(UNSCORED))


def load_masks(clip: str, folder: Path | None = None) -> Painted:
    """The masks of a clip, from the JSON file of its name. ValueError without that file.

    Args:
        clip: One of CLIPS.
        folder: Folder of the JSON file; None for this module's folder.
    """
    path = (folder or Path(__file__).parent) / f"{clip}.json"
    if not path.is_file():
        raise ValueError(f"no masks were painted for {clip!r}: there are those of {', '.join(CLIPS)}")
    record: Any = read_json(path)
    pairs = sorted((_pair(row) for row in record["pairs"]), key=lambda pair: (pair.t_star, pair.frame))
    return Painted(record["clip"], record["sha256"], int(record["width"]), int(record["height"]), tuple(pairs))


def _pair(row: dict[str, Any]) -> Pair:
    polygons = (
        Polygon(np.array(p["points"], np.float64), str(p["shows"]), UNSCORED if p.get("uncertain") else CHANGED)
        for p in row["polygons"]
    )
    return Pair(int(row["t_star"]), int(row["frame"]), int(row["border_px"]), tuple(polygons))


def sha256_of(path: Path) -> str:
    """Digest of a file, as hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
