"""What moves by itself in a clip whose cameras are known: dense matches between frames against one point in space.

A pixel of a key frame is matched with key frames around it, near and far in time. Where one point that stands still
explains all of the matches, the surface stands still; its depth is found on the way, so motion along an epipolar line
is seen as well wherever three views or more tell of it. Where nothing is matched, the pictures are compared where the
point would be seen if it stood still. All is computed on a grid of half the pictures' pixels.

Pure functions on numpy arrays, and a store of matches; `mattes.py` reads and writes the files. Positions are in pixels
of the pictures that are matched ("flow pixels"), centres at +0.5, as a pair of planes x and y.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from ..array_types import meshgrid

_OUTSIDE = 16.0
"""Flow leads at most this many flow pixels out of the picture."""
Map = NDArray[Any]
"""float32 [h, w], or as said; typed as loosely as OpenCV types what it returns."""
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class FlowConfig:
    """What counts as motion. Lengths are in pixels of a picture 640 wide, differences in steps of 255."""

    baselines: tuple[int, ...] = (1, 2, 4, 8)
    """A key frame is matched with those this many key frames before and after; each is double the one before."""
    links: int = 4
    """Number of matches over the longest baseline that are chained: 4 links of 8 key frames reach 3 seconds."""
    round_trip: float = 1.2
    """Largest distance between a pixel and the end of its flow there and back; beyond it the pixel is occluded."""
    tolerance: float = 0.9
    """Distance of a match from the projected still point above which it may show motion."""
    per_link: float = 0.2
    """Growth of `tolerance` with each further link of a chain."""
    noise: float = 2.0
    """Least tolerance of a pair, in median distances of its matches: it covers blur, shutter and a poor pose."""
    most_noise: float = 4.0
    """Largest tolerance of a pair, in multiples of its usual one: movers may fill the picture. No limit for guessed
    poses."""
    contrast: float = 3.0
    """Least change of the picture over the distance of a match for it to show motion; below it flow is unreliable."""
    likeness: float = 8.0
    """Difference up to which two pictures show the same surface."""
    blurred: float = 0.25
    """Sharpness (mean square step), relative to the other picture's, below which a picture counts as blurred."""
    gone_far: float = 0.5
    """Weight, relative to a moving match, of a point that is found neither four key frames before nor after."""
    better: float = 1.5
    """Factor by which the squared difference at the still point's pixel must exceed that at the match to count as
    motion."""
    haste: float = 0.3
    """Exponent of a pair's distance in time in its weight for stillness: also a sway is still for a moment."""
    doubt: float = 1.0
    """Number of moving matches that are attributed to errors."""
    outline: float = 1.0
    """Growth of `doubt` at outlines, where flow mixes two surfaces: it is multiplied by up to 1 + this."""
    share: float = 0.4
    """Share of a point's matches that must show motion for a score of 1."""
    sure: float = 4.0
    """Number of matches from which on the confidence in a point is 1."""
    spans: tuple[int, ...] = (4, 8, 16)
    """Distances in key frames over which residual flow is computed."""
    least: float = 0.67
    """Least unit of residual flow; the unit grows with the noise of a pair (`unusual`)."""
    unusual: float = 3.0
    """Unit of residual flow as a multiple of its median in the pair."""
    most_left: float = 12.0
    """Largest unit of residual flow, in multiples of `least`, as movers may fill the picture."""
    most: float = 1.2
    """Residual flow, in units, above which more is no further evidence."""
    visible: tuple[float, float] = (2.0, 3.5)
    """Range of the noise of a pair; a change of the picture over the residual flow must exceed it to be visible."""
    bearing: float = 0.3
    """Growth of the difference at the still point, relative to that at the match, that fully confirms a match."""
    rim: float = 1.5
    """Growth of the unit at outlines: residual flow there is divided by up to 1 + this."""
    faint: float = 0.2
    """Residual flow, in units, up to which the score is 0."""
    clear: float = 0.8
    """Residual flow, in units, from which on the score is 1."""
    reach: int = 2
    """Number of longest baselines over which scores are gathered along a surface."""
    radius: int = 4
    """Radius in grid points over which scores are spread, stopping at edges of the picture."""
    edge: float = 8.0
    """Difference between neighbouring pixels below which there is no edge."""
    seed: float = 0.4
    """Score that a moving area has to reach at one point at least."""
    grow: float = 0.2
    """Score down to which a moving area extends."""
    blob: float = 10.0
    """Side in pixels of the smallest area that is kept, and of the smallest hole that is not filled."""


class Matches:
    """Dense matches between key frames, on a grid of half the pictures' pixels. Each pair is computed once."""

    def __init__(self, picture: Callable[[int], NDArray[np.uint8]], config: FlowConfig, unit: float) -> None:
        """`picture` gives key k as [H, W] uint8, even sides; `unit` is how many of its pixels 1/640 of a width is."""
        self._picture, self._config, self._unit = picture, config, unit
        self._dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
        self._flows: dict[tuple[int, int], NDArray[np.float16]] = {}
        self._found: dict[tuple[int, int], Mask] = {}
        height, width = (int(side) for side in picture(0).shape)
        self.size = width // 2, height // 2
        x, y = meshgrid(np.arange(1, width, 2), np.arange(1, height, 2))
        self.grid: tuple[Map, Map] = x.astype(np.float32), y.astype(np.float32)
        """Positions of the grid's points."""

    def flow(self, a: int, b: int) -> NDArray[np.float16]:
        """[2, h, w] from points of a to their places in b, less the points. Long ones start from two half as long."""
        if (a, b) not in self._flows:
            one, two = self._picture(a), self._picture(b)
            start = None
            if abs(b - a) in self._config.baselines[1:]:
                middle = (a + b) // 2
                first = self.flow(a, middle).astype(np.float32)
                at = self.grid[0] + first[0], self.grid[1] + first[1]
                rest = self.flow(middle, b)
                start = np.stack([first[i] + sample(rest[i], at) for i in (0, 1)])
            self._flows[a, b] = self._computed(one, two, start).astype(np.float16)
        return self._flows[a, b]

    def _computed(self, one: NDArray[np.uint8], two: NDArray[np.uint8], start: Map | None = None) -> Map:
        """[2, h, w], from `start` of the same shape if there is one; nothing leads farther than just outside."""
        whole = None
        if start is not None:
            # Past the border DIS runs off to any number, and a start that is one reads what is not the picture's.
            start = np.stack([np.clip(start[i], -self.grid[i], 2 * self.size[i] - self.grid[i]) for i in (0, 1)], -1)
            whole = cv2.resize(start, one.shape[::-1], interpolation=cv2.INTER_LINEAR)
        found = dense_flow(self._dis, one, two, whole)
        small = np.nan_to_num(np.asarray(cv2.resize(found, self.size, interpolation=cv2.INTER_AREA), np.float32))
        ranges = [(-_OUTSIDE - self.grid[i], 2 * self.size[i] + _OUTSIDE - self.grid[i]) for i in (0, 1)]
        return np.stack([np.clip(small[..., i], *ranges[i]) for i in (0, 1)])

    def match(self, a: int, b: int) -> tuple[Map, Map, Mask]:
        """Positions x, y in b of a's points, and which are found: inside, and back again."""
        forth = self.flow(a, b).astype(np.float32)
        at = self.grid[0] + forth[0], self.grid[1] + forth[1]
        if (a, b) not in self._found:
            back = self.flow(b, a)
            gap = (forth[0] + sample(back[0], at)) ** 2 + (forth[1] + sample(back[1], at)) ** 2
            self._found[a, b] = self.inside(at) & (gap <= (self._config.round_trip * self._unit) ** 2)
        return *at, self._found[a, b]

    def loose(self, one: NDArray[np.uint8], two: NDArray[np.uint8]) -> tuple[tuple[Map, Map], Mask]:
        """Positions in `two` of `one`'s points, and which are found, of pictures that are no keys; nothing is kept."""
        (x, y), (back_x, back_y) = self._computed(one, two), self._computed(two, one)
        at = self.grid[0] + x, self.grid[1] + y
        gap = (x + sample(back_x, at)) ** 2 + (y + sample(back_y, at)) ** 2
        return at, self.inside(at) & (gap <= (self._config.round_trip * self._unit) ** 2)

    def inside(self, at: tuple[Map, Map]) -> Mask:
        """Which positions lie in the picture."""
        x, y = at
        return (x >= 0) & (y >= 0) & (x < 2 * self.size[0]) & (y < 2 * self.size[1])

    def forget(self, before: int, long_before: int) -> None:
        """Drops pairs with a key below `before`, those over the longest baseline below `long_before`."""
        longest = self._config.baselines[-1]
        for store in (self._flows, self._found):
            for a, b in [*store]:
                if min(a, b) < (long_before if abs(a - b) == longest else before):
                    del store[a, b]


def dense_flow(
    dis: cv2.DISOpticalFlow, one: NDArray[np.uint8], two: NDArray[Any], start: NDArray[Any] | None = None
) -> Map:
    """[H, W, 2] from each pixel of one picture to its place in another, looked for around `start` if there is one.

    OpenCV's types know nothing of a flow without a start.
    """
    return cast(Any, dis).calc(one, two, start)


def sample(values: NDArray[Any], at: tuple[Map, Map]) -> Map:
    """Values of the grid [h, w] at positions, bilinear; outside the border's."""
    half = np.float32(0.5)
    values = values.astype(np.float32, copy=False)
    x, y = at[0] * half - half, at[1] * half - half
    return cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


@dataclass
class Seen:
    """A key frame's points found again in another one."""

    key: int
    """The other key."""
    at: tuple[Map, Map]
    """Positions there."""
    found: Mask
    """[h, w]."""
    links: int
    """Of how many matches it is chained."""


def neighbours(matches: Matches, key: int, count: int, config: FlowConfig) -> list[Seen]:
    """Where points of `key` are found in other keys, of 0 to `count` - 1."""
    result: list[Seen] = []
    for side in (-1, 1):
        last = None
        for baseline in config.baselines:
            other = key + side * baseline
            if 0 <= other < count:
                x, y, found = matches.match(key, other)
                last = Seen(other, (x, y), found, 1)
                result.append(last)
            else:
                last = None
        while last is not None and last.links < config.links:
            other = last.key + side * config.baselines[-1]
            if not 0 <= other < count:
                break
            last = _chained(matches, last, other)
            result.append(last)
    return result


def _chained(matches: Matches, seen: Seen, other: int) -> Seen:
    """Points of `seen` followed from its key to another one."""
    *_, found = matches.match(seen.key, other)
    step = matches.flow(seen.key, other)
    at = seen.at[0] + sample(step[0], seen.at), seen.at[1] + sample(step[1], seen.at)
    both = seen.found & (sample(found, seen.at) > 0.7) & matches.inside(at)
    return Seen(other, at, both, seen.links + 1)
