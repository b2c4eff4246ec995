"""Finds what is burnt into a clip: a logo, a caption. It stays in place while the scene moves, and smears a frozen
frame.

Edges of the world are elsewhere in every frame once the camera moves; the median of a pixel's gradient over the clip is
then next to nothing. Where most frames have that very median, the edge belongs to the picture and not to the scene.
Black bars are none: how strong their edge is depends on what is based on.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

WIDTH = 640
"""Largest width of the pictures that are used."""
FRAMES = 48
"""Largest number of pictures that are used, evenly over the clip."""
_LEAST_FRAMES, _LEAST_WIDTH = 12, 160
"""Of fewer, or smaller ones, nothing is said."""
_EDGE = 2.0
"""Steps of 255 per pixel of the median gradient: less is no edge."""
_ALIKE, _OFTEN = 0.5, 0.75
"""A frame has an edge if its gradient differs from the median by less than this share of it; this share of them must.
On three clips and five synthetic ones 0.5 at most of the frames agree on any edge of the world, 1.0 on a logo's."""
_SCENE_OFTEN = 0.35
"""Largest number of frames that may agree on half of the scene's edges: above it the camera hardly moves, and no mark
can be found."""
_CLOSE = 13
"""Pixels of a picture 640 wide between edges that belong together."""
_LEAST, _MOST = 60, 0.25
"""Square pixels of a picture 640 wide, and share of it: what is smaller is noise, what is larger the scene."""
_RIM = 8
"""Pixels of a picture 640 wide from its border: what lies wholly there is a camera's own rim, and does little harm."""
_GROW = 2
"""Pixels of a picture 640 wide around it that are part of it: edges are blurred."""


def looked_at(count: int) -> list[int]:
    """Which of `count` pictures `find_mark` is to see, ascending."""
    return sorted({*np.linspace(0, count - 1, min(count, FRAMES)).round().astype(int).tolist()}) if count else []


def find_mark(pictures: Sequence[NDArray[np.uint8]]) -> NDArray[np.bool_] | None:
    """bool [H, W]: what is burnt into grey pictures [H, W] spread over a clip.

    None if nothing is, or if it cannot be decided.
    It cannot where the camera hardly moves, or where pictures are few or small.
    """
    if len(pictures) < _LEAST_FRAMES or pictures[0].shape[1] < _LEAST_WIDTH:
        return None
    height, width = pictures[0].shape
    size = (min(width, WIDTH), max(1, round(height * min(width, WIDTH) / width)))
    unit = size[0] / 640.0
    gradients = np.stack([_gradient(picture, size) for picture in pictures])
    middle = np.median(gradients, axis=0).astype(np.float32)
    length = np.hypot(*middle)
    alike = np.zeros_like(length)
    usual = np.zeros_like(length)
    for gradient in gradients:  # one at a time: all of them in float32 would be a hundred megabytes
        x, y = gradient.astype(np.float32)
        alike += np.hypot(x - middle[0], y - middle[1]) < _ALIKE * length
        usual += np.hypot(x, y)
    alike, usual = alike / len(gradients), usual / len(gradients)
    edges = (length > _EDGE) & (alike > _OFTEN)
    if not edges.any():
        return None
    mark = _whole(edges, unit)
    world = (usual > _EDGE) & ~mark
    moves = world.sum() > 2 * edges.sum() and np.median(alike[world]) < _SCENE_OFTEN
    if not moves or not mark.any() or mark.mean() > _MOST:
        return None
    large = cv2.resize(mark.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    return np.asarray(large > 0)


def _gradient(picture: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.float16]:
    """[2, h, w] x and y, in steps of 255 per pixel of a picture of that size."""
    small = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.float32)
    smooth = cv2.GaussianBlur(small, (0, 0), 1.0)
    parts = [cv2.Sobel(smooth, cv2.CV_32F, *way, scale=0.125) for way in ((1, 0), (0, 1))]
    return np.stack(parts).astype(np.float16)


def _whole(edges: NDArray[np.bool_], unit: float) -> NDArray[np.bool_]:
    """[h, w]: what edges outline: closed, with what they enclose, less what is too small."""
    closed = np.asarray(cv2.morphologyEx(edges.astype(np.uint8), cv2.MORPH_CLOSE, _disc(_CLOSE * unit)), np.uint8)
    numbers, areas = _parts(closed)
    rim, inner = max(1, round(_RIM * unit)), np.zeros(len(areas), bool)
    inner[np.unique(numbers[rim:-rim, rim:-rim])] = True
    keep = inner & (areas >= _LEAST * unit**2)
    keep[0] = False
    closed = keep[numbers].astype(np.uint8)
    if not closed.any():
        return np.zeros_like(edges)
    numbers, areas = _parts(1 - closed)
    areas[0] = 0  # the edges themselves
    scene = numbers == int(areas.argmax())
    return np.asarray(cv2.dilate((~scene).astype(np.uint8), _disc(2 * _GROW * unit))) > 0


def _disc(across: float) -> NDArray[np.uint8]:
    """An odd number of pixels, at least 3."""
    side = max(3, round(across) | 1)
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), np.uint8)


def _parts(mask: NDArray[np.uint8]) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Number of the part that each pixel [h, w] of a mask belongs to, 0 outside, and the parts' areas."""
    _, numbers, about, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
    return np.asarray(numbers, np.int32), np.asarray(about, np.int64)[:, cv2.CC_STAT_AREA]
