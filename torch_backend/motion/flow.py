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
"""Flow leads at most so many flow pixels out of the picture."""
Map = NDArray[Any]
"""float32 [h, w], or as said; typed as loosely as OpenCV types what it returns."""
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class FlowConfig:
    """What counts as motion. Lengths are in pixels of a picture 640 wide, differences in steps of 255."""

    baselines: tuple[int, ...] = (1, 2, 4, 8)
    """A key frame is matched with those this many key frames before and after; each is double the one before."""
    links: int = 4
    """Matches over the longest baseline are chained this often: 4 links of 8 key frames reach 3 seconds."""
    round_trip: float = 1.2
    """Greatest distance between a pixel and where the flow there and back ends; above it the pixel is hidden there."""
    tolerance: float = 0.9
    """A match this far from where the still point is seen may tell of motion."""
    per_link: float = 0.2
    """So much more for each further link of a chain."""
    noise: float = 2.0
    """The tolerance of a pair is at least this many times the median distance in it: blur, shutter, a poor pose."""
    most_noise: float = 4.0
    """But at most this many times what it is otherwise, unless a pose was guessed: what moves may fill the picture."""
    contrast: float = 3.0
    """Only where the picture changes by so much over that distance is it more than an error of the flow."""
    likeness: float = 8.0
    """Pictures that differ by less show the same."""
    blurred: float = 0.25
    """Share of another picture's sharpness (mean square step) below which a picture is blurred beside it."""
    gone_far: float = 0.5
    """Weight, relative to a moving match, of a point that is found neither four key frames before nor after."""
    better: float = 1.5
    """Factor by which the squared difference at the still point's pixel must exceed that at the match to count as
    motion."""
    haste: float = 0.3
    """Power of a pair's distance in time with which it counts for stillness: what sways is still for a moment."""
    doubt: float = 1.0
    """Number of moving matches that are attributed to errors."""
    outline: float = 1.0
    """So much more of that at outlines, where flow is a mixture of two surfaces."""
    share: float = 0.4
    """Share of a point's matches that must show motion for a score of 1."""
    sure: float = 4.0
    """Number of matches from which on the confidence in a point is 1."""
    spans: tuple[int, ...] = (4, 8, 16)
    """Key frames this far before and after are laid over one by its depths, to see what is left of motion."""
    least: float = 0.67
    """What is left counts in units of this length,"""
    unusual: float = 3.0
    """or of so many times its median where that is more, up to `most_left`."""
    most_left: float = 12.0
    """Of the least: what moves may fill the picture."""
    most: float = 1.2
    """More of these units than that tell no more."""
    visible: tuple[float, float] = (2.0, 3.5)
    """A picture that changes by so much over what is left shows it: by the noise of the pair, from the one to the
    other."""
    bearing: float = 0.3
    """By so much, of what it is at the match, the picture differs more where nothing moved, if it bears a match out."""
    rim: float = 1.5
    """At outlines these units count less by 1 + this."""
    faint: float = 0.2
    """So many of these units are nothing yet,"""
    clear: float = 0.8
    """and so many are motion for certain."""
    reach: int = 2
    """Over so many of the longest baselines a surface's scores are gathered along it."""
    radius: int = 4
    """Scores are spread over so many points of the grid, stopping at edges of the picture."""
    edge: float = 8.0
    """Smaller differences are no edges."""
    seed: float = 0.4
    """An area moves if a point in it has this score,"""
    grow: float = 0.2
    """and reaches as far as points have this one."""
    blob: float = 10.0
    """Areas of less than this squared are noise, and holes of less are filled."""


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
    """What is seen again of `key` in the keys 0 to `count` - 1 around it."""
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
