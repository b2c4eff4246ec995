"""Detects overlays burnt into a clip, such as logos and captions. They would smear over a frozen frame.

While the camera moves, edges of the scene change place, so that the median gradient of a pixel over the clip is near
zero. An edge with the same gradient in most frames belongs to an overlay. Black bars do not qualify: the strength of
their edge depends on the adjacent picture.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

WIDTH = 640
"""Maximum width of the analysed pictures."""
FRAMES = 48
"""Maximum number of analysed pictures, spread evenly over the clip."""
# Minimum number and width of the pictures for a decision.
_LEAST_FRAMES, _LEAST_WIDTH = 12, 160
# Minimum median gradient of an edge, in steps of 255 per pixel.
_EDGE = 2.0
# Largest relative difference of a frame's gradient from the median; minimum share of frames within it. Measured in
# three real and five synthetic clips: at most half of the frames agree on a scene edge, all on the edge of a logo.
_MAX_DEVIATION, _OFTEN = 0.5, 0.75
# Largest median share of frames that agree on a scene edge. Above it, the camera hardly moves, and an overlay cannot be
# detected.
_SCENE_OFTEN = 0.35
# Largest gap between edges of one overlay, in pixels of a picture 640 wide.
_CLOSE = 13
# Minimum area of an overlay in square pixels of a picture 640 wide; maximum area as a share of the picture.
_LEAST, _MOST = 60, 0.25
# Width of the border in pixels of a picture 640 wide. Parts entirely within it are dark camera borders: harmless.
_RIM = 8
# Dilation of the mask in pixels of a picture 640 wide, to cover blurred edges.
_GROW = 2


def looked_at(count: int) -> list[int]:
    """Indices of the pictures out of `count` that `find_mark` needs, ascending."""
    return sorted({*np.linspace(0, count - 1, min(count, FRAMES)).round().astype(int).tolist()}) if count else []


def find_mark(pictures: Sequence[NDArray[np.uint8]]) -> NDArray[np.bool_] | None:
    """Mask [H, W] bool of the overlay in grey pictures [H, W] spread over a clip.

    None if there is no overlay, or if the camera hardly moves, or if the pictures are too few or too small.
    """
    if len(pictures) < _LEAST_FRAMES or pictures[0].shape[1] < _LEAST_WIDTH:
        return None
    height, width = pictures[0].shape
    size = (min(width, WIDTH), max(1, round(height * min(width, WIDTH) / width)))
    unit = size[0] / 640.0
    gradients = np.stack([_gradient(picture, size) for picture in pictures])
    middle = np.median(gradients, axis=0).astype(np.float32)
    length = np.hypot(*middle)
    agreement = np.zeros_like(length)
    usual = np.zeros_like(length)
    for gradient in gradients:  # one at a time: all of them in float32 would be a hundred megabytes
        x, y = gradient.astype(np.float32)
        agreement += np.hypot(x - middle[0], y - middle[1]) < _MAX_DEVIATION * length
        usual += np.hypot(x, y)
    agreement, usual = agreement / len(gradients), usual / len(gradients)
    edges = (length > _EDGE) & (agreement > _OFTEN)
    if not edges.any():
        return None
    mark = _filled(edges, unit)
    world = (usual > _EDGE) & ~mark
    moves = world.sum() > 2 * edges.sum() and np.median(agreement[world]) < _SCENE_OFTEN
    if not moves or not mark.any() or mark.mean() > _MOST:
        return None
    large = cv2.resize(mark.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    return np.asarray(large > 0)


def _gradient(picture: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.float16]:
    """Gradient [2, h, w] along x and y of the picture resized to `size`, in steps of 255 per pixel."""
    small = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.float32)
    smooth = cv2.GaussianBlur(small, (0, 0), 1.0)
    parts = [cv2.Sobel(smooth, cv2.CV_32F, *way, scale=0.125) for way in ((1, 0), (0, 1))]
    return np.stack(parts).astype(np.float16)


def _filled(edges: NDArray[np.bool_], unit: float) -> NDArray[np.bool_]:
    """Mask [h, w] of the regions outlined by edges: gaps closed, holes filled, small parts removed."""
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
    """Elliptic structuring element, with a size rounded up to an odd number of at least 3."""
    side = max(3, round(across) | 1)
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), np.uint8)


def _parts(mask: NDArray[np.uint8]) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Connected components of a mask: label of each pixel [h, w], 0 outside, and the area of each component."""
    _, numbers, about, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
    return np.asarray(numbers, np.int32), np.asarray(about, np.int64)[:, cv2.CC_STAT_AREA]
