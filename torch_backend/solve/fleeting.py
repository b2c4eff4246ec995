"""What no flow finds: a thing too small or too fast to be followed, that is elsewhere in every key frame around.

Dense flow smooths an apple on a thread away: at its place it tells the motion of the wall behind. But the pictures do
not agree: laid over a frame by the depth of still points, most of the key frames around show the wall there, and the
frame shows something else. Where one depth explains that, it is a thing that stands still and was given a wrong depth,
as at outlines; what is left moves. A picture is compared with all that another one shows within a point of the grid
(its least and greatest values there), so that matches may be off by that much.

Nor does flow find an arm that swings slowly before a wall, and the key frames around do not agree about it. A static
model of the whole clip knows the wall: what a frame shows and such a model cannot is likely to move, unless the key
frames around show the same at the still point's depth, where it is the model that is poor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .flow import FlowConfig, Map, Mask
from .still import Ray, fitted_brightness

_BLOCK = 8
"""Depths are tried for this many points of the grid a side together, as far as they hang together."""
_MOST = 0.1
"""If more of a frame than this is unlike, it is the frame (a flash, a wrong pose)."""
_SPARSE = 4
"""Every so manieth point tells how bright a picture is."""
_ROW = 1024
_AROUND = 5
"""Points a side over which it is asked together whether key frames bear out what a static model does not show."""
_HIDDEN = 1.15
"""A surface that is nearer by this factor hides what is behind it."""
_MOST_OF = 0.7
"""So much of a block is all of it."""
_NEAREST = 8.0
"""Inverse depths are tried from nothing to the typical one times this, evenly: so far apart are they on the picture."""


class Shades:
    """A colour picture on the grid, and the range of what it shows around each point."""

    def __init__(self, colors: NDArray[np.uint8]) -> None:
        """`colors` [h, w, 3]."""
        self.colors = colors
        block = np.ones((3, 3), np.uint8)
        self._least, self._greatest = cv2.erode(colors, block), cv2.dilate(colors, block)

    def apart(self, other: Shades) -> Map:
        """[h, w] uint8: how far each picture is out of the range that the other shows there, greatest channel."""
        below = [cv2.subtract(a._least, b.colors) for a, b in ((self, other), (other, self))]
        above = [cv2.subtract(a.colors, b._greatest) for a, b in ((self, other), (other, self))]
        most: Map = np.max([*below, *above], axis=(0, 3))
        return cv2.medianBlur(most, 3)

    def at(self, x: Map, y: Map) -> NDArray[np.float32]:
        """[..., 3] colours at positions [a, b] of the grid."""
        return _sampled(self.colors, x, y).astype(np.float32)

    def unlike(self, values: Map, x: Map, y: Map, gain: Map) -> Map:
        """How far `values` [..., 3] are out of the range shown at positions [a, b] of the grid, greatest channel.

        In steps of this picture; `gain` [2, 3] is times and plus what makes it as bright as they are.
        """
        mine = np.clip(np.rint((values - gain[1]) / gain[0]), 0.0, 255.0).astype(np.uint8)
        mine = np.ascontiguousarray(np.broadcast_to(mine, (*x.shape, 3)))
        below = cv2.subtract(_sampled(self._least, x, y), mine)  # not less than 0
        above = cv2.subtract(mine, _sampled(self._greatest, x, y))
        red, green, blue = np.moveaxis(np.maximum(below, above), -1, 0)
        return np.maximum(np.maximum(red, green), blue)


def _sampled(picture: NDArray[Any], x: Map, y: Map) -> NDArray[Any]:
    """[..., 3] colours of a picture at positions [a, b], bilinear, in rows that are short enough for OpenCV."""
    count = -(-x.size // _ROW)
    x_rows, y_rows = (np.resize(p, (count, _ROW)) for p in (x, y))  # the last row is filled up with whatever
    found = cv2.remap(picture, x_rows, y_rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found).reshape(count * _ROW, -1)[: x.size].reshape(*x.shape, -1)


@dataclass
class Sight:
    """A frame and its camera."""

    shades: Shades
    viewmat: NDArray[np.float64]
    """[4, 4] world-to-camera, solve units."""
    K: NDArray[np.float64]
    """[3, 3] in flow pixels."""


@dataclass
class Other:
    """A key frame near a frame."""

    side: int
    """-1: before the frame, 1: after."""
    step: int
    """How many keys away, a power of two."""
    sight: Sight
    inverse: Map
    """[h, w] inverse depths of still points there: what hides what."""
    gain: Map = field(default_factory=lambda: np.array([[1.0] * 3, [0.0] * 3], np.float32))
    """[2, 3] times and plus what makes it as bright as the frame."""


class Fleeting:
    """Finds what is elsewhere in the key frames around a frame."""

    def __init__(self, grid: tuple[Map, Map], unit: float, config: FlowConfig) -> None:
        """`grid` and `unit` as in `still.StillTest`."""
        self._grid, self._config = grid, config
        self._least = max(2, round((config.speck * unit / 2.0) ** 2))

    def masks(
        self, frame: Sight, others: Sequence[Other], inverse: Map, depth: float, static: Shades | None = None
    ) -> tuple[Mask, Mask]:
        """([h, w], [h, w]): what moves by itself in a frame, and what is likely to, since no static model shows it.

        `others` are key frames around it, `inverse` [h, w] the depths of its still points, `depth` the typical one,
        solve units; `static` is what a static model of the clip shows there, if there is one.
        """
        others = [self._fitted(frame, other, inverse) for other in others]
        chosen = self._first(others)
        nothing = np.zeros(inverse.shape, bool)
        if len(others) < 3 or not chosen:
            return nothing, nothing
        found = self._elsewhere(frame, others, chosen, inverse, depth)
        return found, nothing if static is None else self._unexplained(frame, others, inverse, static)

    def _unexplained(self, frame: Sight, others: Sequence[Other], inverse: Map, static: Shades) -> Mask:
        """[h, w]: what a frame shows and a static model does not, though the key frames around do not bear it out.

        The nearest do not count: what moves slowly is still there in them. Where too few of the others look at all, at
        the rim of a clip's view, the model had little to learn from, and is poor.
        """
        c, apart = self._config, frame.shades.apart(static)
        strong = _opened(apart > c.unexplained[1])
        weak = seeded(apart > c.unexplained[0], strong, self._least)
        if not weak.any() or weak.mean() > _MOST:
            return np.zeros(inverse.shape, bool)
        rows, columns = np.nonzero(weak)
        points, at = self._points(rows, columns), inverse[rows, columns][None]
        alike, seen, asked = (np.zeros(inverse.shape, np.float32) for _ in range(3))
        for other in (other for other in others if other.step > 1):
            asked[rows, columns] += self._projected(frame, other, points, at)[2][0]
            found, within = self._compared(frame, other, points, at, frame.shades.colors[rows, columns][None])
            alike[rows, columns] += ((found <= c.unlike) & within)[0]
            seen[rows, columns] += within[0]
        near = _AROUND, _AROUND
        weak &= asked >= c.asked
        weak &= (cv2.blur(alike, near) < c.borne_out * cv2.blur(seen, near)) | (cv2.blur(seen, near) == 0)
        return seeded(weak, weak & strong, self._least)

    def _elsewhere(
        self, frame: Sight, others: Sequence[Other], chosen: Sequence[Other], inverse: Map, depth: float
    ) -> Mask:
        """[h, w]: what is elsewhere in the key frames around, which agree about what is there instead."""
        c, shape = self._config, inverse.shape
        nothing = np.zeros(shape, bool)
        unlike = nothing.copy()
        for other in chosen:
            found, within = self._compared(frame, other, self._grid, inverse, frame.shades.colors)
            unlike |= (found > c.unlike) & within
        if not unlike.any():
            return nothing
        rows, columns = np.nonzero(unlike)
        share = self._share(frame, others, rows, columns, inverse)
        weak, strong = nothing.copy(), nothing.copy()
        weak[rows, columns], strong[rows, columns] = share >= c.fleeting[0], share >= c.fleeting[1]
        # Outlines are lines of one point: depths and pictures are off there.
        strong = _opened(strong)
        weak = seeded(weak, strong, self._least)
        if not weak.any() or weak.mean() > _MOST:
            return nothing
        weak &= ~self._explained(frame, others, weak, depth)
        return seeded(weak, weak & strong, self._least)

    def _share(
        self, frame: Sight, others: Sequence[Other], rows: NDArray[Any], columns: NDArray[Any], inverse: Map
    ) -> NDArray[Any]:
        """[N] share of the others that show the still points at rows and columns, and show something else there.

        They have to agree with each other, else it is they that are changing, as behind a head that passes. 0 if a
        point is seen by too few, and if there is none before or none after: what has just come out from behind
        something is like that. The nearest do not count: what moves slowly is still there in them.
        """
        points, inverse = self._points(rows, columns), inverse[rows, columns][None]
        places = [self._places(frame, other, points, inverse) for other in others]
        shown = np.stack(
            [
                np.where(within[..., None], other.sight.shades.at(x, y) * other.gain[0] + other.gain[1], np.nan)
                for other, (x, y, within) in zip(others, places, strict=True)
            ]
        )
        number = np.sum([within for _, _, within in places], axis=0)  # sorted, what is not seen comes last
        middle = np.maximum(number - 1, 0)[None, ..., None] // 2
        usual = np.nan_to_num(np.take_along_axis(np.sort(shown, axis=0), middle, axis=0)[0])
        values, limit = frame.shades.colors[rows, columns][None].astype(np.float32), self._config.unlike
        count, of = np.zeros(len(rows)), np.zeros(len(rows))
        sides = {side: np.zeros(len(rows), bool) for side in (-1, 1)}
        for other, (x, y, within) in zip(others, places, strict=True):
            shades, gain = other.sight.shades, other.gain
            agree = shades.unlike(usual, x, y, gain) <= limit
            unlike = (within & agree & (shades.unlike(values, x, y, gain) > limit))[0]
            sides[other.side] |= unlike
            if other.step > 1:
                count, of = count + unlike, of + within[0]
        return np.where((of >= self._config.need) & sides[-1] & sides[1], count / np.maximum(of, 1), 0.0)

    def _first(self, others: Sequence[Other]) -> list[Other]:
        """The two that tell the most at once: half a second before and after, or what there is."""
        far = [o for o in others if o.step == 4] or [o for o in others if o.step == 2]
        return far[:2]

    def _points(self, rows: NDArray[Any], columns: NDArray[Any]) -> tuple[Map, Map]:
        """Positions [1, N] of points of the grid."""
        return self._grid[0][rows, columns][None], self._grid[1][rows, columns][None]

    def _fitted(self, frame: Sight, other: Other, inverse: Map) -> Other:
        """Another one, made as bright as a frame."""
        few = self._grid[0][::_SPARSE, ::_SPARSE], self._grid[1][::_SPARSE, ::_SPARSE]
        x, y, within = self._places(frame, other, few, np.ascontiguousarray(inverse[::_SPARSE, ::_SPARSE]))
        mine, theirs = frame.shades.colors[::_SPARSE, ::_SPARSE].astype(np.float32), other.sight.shades.at(x, y)
        gains = [fitted_brightness(mine[..., c][within], theirs[..., c][within]) for c in range(3)]
        return replace(other, gain=np.array(gains, np.float32).T.copy())

    def _places(self, frame: Sight, other: Other, points: tuple[Map, Map], inverse: Map) -> tuple[Map, Map, Mask]:
        """Where still points are on another's grid, and whether they are in the picture and not hidden: [a, b] each."""
        x, y, inside, over = self._projected(frame, other, points, inverse)
        return x, y, inside & (_sampled(other.inverse, x, y)[..., 0] <= _HIDDEN * inverse * over)

    def _projected(
        self, frame: Sight, other: Other, points: tuple[Map, Map], inverse: Map
    ) -> tuple[Map, Map, Mask, Map]:
        """Where still points are on another's grid, whether that is in the picture, and how many times as near they are
        to it as to the frame: [a, b] each."""
        ray = Ray(points, (frame.viewmat, other.sight.viewmat), (frame.K, other.sight.K))
        at, over = ray.project(inverse)
        x, y = (np.clip(0.5 * p - 0.5, -1e4, 1e4).astype(np.float32) for p in at)
        height, width = self._grid[0].shape
        return x, y, (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1), over

    def _compared(
        self, frame: Sight, other: Other, points: tuple[Map, Map], inverse: Map, values: NDArray[np.uint8]
    ) -> tuple[Map, Mask]:
        """How unlike another one still points are, and whether they are in it."""
        x, y, within = self._places(frame, other, points, inverse)
        return other.sight.shades.unlike(values.astype(np.float32), x, y, other.gain), within

    def _explained(self, frame: Sight, others: Sequence[Other], mask: Mask, depth: float) -> Mask:
        """[h, w]: where some depth explains what is seen by a thing that stands still.

        It does if most of the key frames around show the same there, or the nearest on one side: a thing may come out
        from behind another one.
        """
        c = self._config
        rows, columns = np.nonzero(mask)
        _, areas = cv2.connectedComponents(mask.astype(np.uint8))
        number = (areas[rows, columns].astype(np.int64) << 32) + (rows // _BLOCK << 16) + columns // _BLOCK
        names, block, sizes = np.unique(number, return_inverse=True, return_counts=True)
        chosen = ((rows + columns) % 2 == 0) | (sizes[block] <= _BLOCK)  # of many, half say it as well
        every, whole = (rows, columns), block
        rows, columns, block = rows[chosen], columns[chosen], block[chosen]
        sizes = np.bincount(block, minlength=len(names))
        tried = np.linspace(0.0, _NEAREST / depth, c.depths).astype(np.float32)
        points, values = self._points(rows, columns), frame.shades.colors[rows, columns][None]
        inverse = np.repeat(tried[:, None], len(rows), 1)
        alike, seen = np.zeros((2, len(tried), len(names)))
        sides = {side: np.zeros((2, len(tried), len(names))) for side in (-1, 1)}
        cells = (np.arange(len(tried))[:, None] * len(names) + block[None]).ravel()
        for other in others:
            found, within = self._compared(frame, other, points, inverse, values)
            good, inside = (
                np.bincount(cells, weights=part.ravel(), minlength=alike.size).reshape(alike.shape) >= _MOST_OF * sizes
                for part in (((found <= c.unlike) & within), within)
            )
            alike, seen = alike + good, seen + inside
            if other.step <= 4:
                sides[other.side] += np.stack([good & inside, inside])
        explained = (seen >= 3) & (alike >= c.explained * seen)
        for good, of in sides.values():
            explained |= (of >= 2) & (good == of)
        result = np.zeros(mask.shape, bool)
        result[every] = np.any(explained, axis=0)[whole]
        return result


def _opened(mask: Mask) -> Mask:
    """A mask without lines of one point."""
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8)) > 0


def seeded(mask: Mask, seeds: Mask, least: int, connectivity: int = 8) -> Mask:
    """The connected areas of a mask that hold a seed and at least so many points."""
    count, numbers, about, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=connectivity)
    numbers = np.asarray(numbers, np.int32)
    keep = about[:, cv2.CC_STAT_AREA] >= least
    keep[0] = False
    held = np.zeros(count, bool)
    held[np.unique(numbers[seeds & mask])] = True
    return (keep & held)[numbers]
