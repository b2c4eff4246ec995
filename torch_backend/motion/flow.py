"""Dense matches between key frames, with which `still.py` tests whether a surface stands still. Cameras are known.

Each pixel of a key frame is matched with earlier and later key frames, near and far in time. A surface stands still if
one fixed point in space explains all of its matches. The test estimates the depth of that point, so three or more views
also reveal motion along an epipolar line. Where no match is found, the test compares the pictures at the projection of
the still point. Everything is computed on a grid of half the pictures' resolution.

This module holds pure functions on numpy arrays and a cache of matches; `mattes.py` reads and writes the files.
Positions are in pixels of the matched pictures ("flow pixels"), centres at +0.5, as a pair of planes x and y.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from ..array_types import meshgrid

# Flow is clamped to end at most this many flow pixels outside the picture.
_OUTSIDE = 16.0
Map = NDArray[Any]
"""float32 [h, w] unless documented otherwise; untyped elements, as in OpenCV's stubs."""
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class FlowConfig:
    """Thresholds of motion detection. Lengths are in pixels of a picture 640 wide, differences in 8-bit steps."""

    baselines: tuple[int, ...] = (1, 2, 4, 8)
    """Distances, in key frames, over which a key frame is matched in both directions; each doubles the last."""
    links: int = 4
    """Number of matches over the longest baseline that are chained: 4 links of 8 key frames reach 3 seconds."""
    round_trip: float = 1.2
    """Largest distance between a pixel and the end of its flow there and back; beyond it the pixel is occluded."""
    tolerance: float = 0.9
    """Distance of a match from the projected still point above which it may show motion."""
    per_link: float = 0.2
    """Growth of `tolerance` with each further link of a chain."""
    noise: float = 2.0
    """Smallest tolerance of a pair, in multiples of its matches' median distance: covers blur, shutter and a poor pose.
    """
    most_noise: float = 4.0
    """Largest tolerance of a pair, in multiples of `tolerance`, because movers may fill the picture. Pairs with an
    interpolated pose have no limit."""
    contrast: float = 3.0
    """Smallest change of the picture over a match's distance at which it may show motion; below, flow is unreliable."""
    likeness: float = 8.0
    """Difference up to which two pictures show the same surface."""
    blurred: float = 0.25
    """Sharpness (mean square step) relative to the other picture below which a picture counts as blurred."""
    gone_far: float = 0.5
    """Weight, relative to a moving match, of a point that is lost both four key frames before and four after."""
    better: float = 1.5
    """A match counts as motion if the squared picture difference at the still point's pixel is more than this many
    times the difference at the match."""
    haste: float = 0.3
    """Exponent of a pair's distance in time in its weight as evidence of stillness: a swaying object also stands still
    for a moment."""
    doubt: float = 1.0
    """Number of moving matches that are attributed to errors."""
    outline: float = 1.0
    """Growth of `doubt` at outlines, where flow mixes two surfaces: `doubt` is multiplied by up to 1 + this."""
    share: float = 0.4
    """Share of a point's matches that must show motion for a score of 1."""
    sure: float = 4.0
    """Number of matches at which the confidence in a point reaches 1."""
    spans: tuple[int, ...] = (4, 8, 16)
    """Distances in key frames over which residual flow is computed."""
    least: float = 0.67
    """Smallest unit of residual flow; the unit grows with the noise of a pair (`unusual`)."""
    unusual: float = 3.0
    """Unit of residual flow as a multiple of its median in the pair."""
    most_left: float = 12.0
    """Largest unit of residual flow, in multiples of `least`, because movers may fill the picture."""
    most: float = 1.2
    """Residual flow, in units, at which evidence of motion saturates."""
    visible: tuple[float, float] = (2.0, 3.5)
    """Lower and upper limit of a pair's noise. Residual flow is visible if the picture changes by more than the noise
    along it."""
    bearing: float = 0.3
    """Relative increase of the picture difference from the match to the still point that fully confirms the match."""
    rim: float = 1.5
    """Growth of the unit at outlines: residual flow there is divided by up to 1 + this."""
    faint: float = 0.2
    """Largest residual flow, in units, with a score of 0."""
    clear: float = 0.8
    """Smallest residual flow, in units, with a score of 1."""
    reach: int = 2
    """Distance in time over which scores are averaged along a surface, in longest baselines."""
    radius: int = 4
    """Radius in grid points over which scores are spread, stopping at edges of the picture."""
    edge: float = 8.0
    """Difference between neighbouring pixels below which there is no edge."""
    seed: float = 0.4
    """Score that a moving area must reach at one point at least."""
    grow: float = 0.2
    """Score down to which a moving area extends."""
    blob: float = 10.0
    """Side in pixels of the smallest area that is kept, and of the smallest hole that is not filled."""


class Matches:
    """Dense matches between key frames, on a grid of half the pictures' pixels. Each pair is computed once."""

    def __init__(self, picture: Callable[[int], NDArray[np.uint8]], config: FlowConfig, unit: float) -> None:
        """`picture` returns key k as [H, W] uint8 with even sides; `unit` is 1/640 of its width in pixels."""
        self._picture, self._config, self._unit = picture, config, unit
        self._dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
        self._flows: dict[tuple[int, int], NDArray[np.float16]] = {}
        self._found: dict[tuple[int, int], Mask] = {}
        height, width = (int(side) for side in picture(0).shape)
        self.size = width // 2, height // 2
        x, y = meshgrid(np.arange(1, width, 2), np.arange(1, height, 2))
        self.grid: tuple[Map, Map] = x.astype(np.float32), y.astype(np.float32)
        """Positions x and y of the grid's points."""

    def flow(self, a: int, b: int) -> NDArray[np.float16]:
        """[2, h, w] displacements of a's points in b. The search over a long baseline starts from two half as long."""
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
        """Flow [2, h, w] on the grid, searched around `start` of the same shape; clamped to `_OUTSIDE`."""
        whole = None
        if start is not None:
            # Beyond the border DIS diverges, and with such values as a start it reads outside the picture's memory.
            start = np.stack([np.clip(start[i], -self.grid[i], 2 * self.size[i] - self.grid[i]) for i in (0, 1)], -1)
            whole = cv2.resize(start, one.shape[::-1], interpolation=cv2.INTER_LINEAR)
        found = dense_flow(self._dis, one, two, whole)
        small = np.nan_to_num(np.asarray(cv2.resize(found, self.size, interpolation=cv2.INTER_AREA), np.float32))
        ranges = [(-_OUTSIDE - self.grid[i], 2 * self.size[i] + _OUTSIDE - self.grid[i]) for i in (0, 1)]
        return np.stack([np.clip(small[..., i], *ranges[i]) for i in (0, 1)])

    def match(self, a: int, b: int) -> tuple[Map, Map, Mask]:
        """Positions x, y in b of a's points, and which are found: inside b and consistent with the flow back."""
        forth = self.flow(a, b).astype(np.float32)
        at = self.grid[0] + forth[0], self.grid[1] + forth[1]
        if (a, b) not in self._found:
            back = self.flow(b, a)
            gap = (forth[0] + sample(back[0], at)) ** 2 + (forth[1] + sample(back[1], at)) ** 2
            self._found[a, b] = self.inside(at) & (gap <= (self._config.round_trip * self._unit) ** 2)
        return *at, self._found[a, b]

    def loose(self, one: NDArray[np.uint8], two: NDArray[np.uint8]) -> tuple[tuple[Map, Map], Mask]:
        """Positions in `two` of `one`'s points, and which are found, for pictures that are not keys; not cached."""
        (x, y), (back_x, back_y) = self._computed(one, two), self._computed(two, one)
        at = self.grid[0] + x, self.grid[1] + y
        gap = (x + sample(back_x, at)) ** 2 + (y + sample(back_y, at)) ** 2
        return at, self.inside(at) & (gap <= (self._config.round_trip * self._unit) ** 2)

    def inside(self, at: tuple[Map, Map]) -> Mask:
        """Which positions lie in the picture."""
        x, y = at
        return (x >= 0) & (y >= 0) & (x < 2 * self.size[0]) & (y < 2 * self.size[1])

    def forget(self, before: int, long_before: int) -> None:
        """Drops cached pairs with a key below `before`; for the longest baseline, below `long_before`."""
        longest = self._config.baselines[-1]
        for store in (self._flows, self._found):
            for a, b in [*store]:
                if min(a, b) < (long_before if abs(a - b) == longest else before):
                    del store[a, b]


def dense_flow(
    dis: cv2.DISOpticalFlow, one: NDArray[np.uint8], two: NDArray[Any], start: NDArray[Any] | None = None
) -> Map:
    """Flow [H, W, 2] from each pixel of `one` to its position in `two`, searched around `start` if there is one."""
    return cast(Any, dis).calc(one, two, start)  # OpenCV's stubs require a start


def sample(values: NDArray[Any], at: tuple[Map, Map]) -> Map:
    """Values of the grid [h, w] at positions, bilinear; positions outside read the border's values."""
    half = np.float32(0.5)
    values = values.astype(np.float32, copy=False)
    x, y = at[0] * half - half, at[1] * half - half
    return cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


@dataclass
class Seen:
    """A key frame's points and their positions in another key frame."""

    key: int
    """The other key."""
    at: tuple[Map, Map]
    """Positions of the points in the other key."""
    found: Mask
    """[h, w], which points are found."""
    links: int
    """Number of matches in the chain to the other key."""


def neighbours(matches: Matches, key: int, count: int, config: FlowConfig) -> list[Seen]:
    """Where key frame `key`'s points lie in neighbouring key frames; key frames are numbered 0 to `count` - 1."""
    result: list[Seen] = []
    for side in (-1, 1):
        last = None
        for baseline in config.baselines:
            neighbour = key + side * baseline
            if 0 <= neighbour < count:
                x, y, found = matches.match(key, neighbour)
                last = Seen(neighbour, (x, y), found, 1)
                result.append(last)
            else:
                last = None
        while last is not None and last.links < config.links:
            neighbour = last.key + side * config.baselines[-1]
            if not 0 <= neighbour < count:
                break
            last = _chained(matches, last, neighbour)
            result.append(last)
    return result


def _chained(matches: Matches, seen: Seen, target: int) -> Seen:
    """Points of `seen` followed from its key to the key `target`."""
    *_, found = matches.match(seen.key, target)
    step = matches.flow(seen.key, target)
    at = seen.at[0] + sample(step[0], seen.at), seen.at[1] + sample(step[1], seen.at)
    found_both = seen.found & (sample(found, seen.at) > 0.7) & matches.inside(at)
    return Seen(target, at, found_both, seen.links + 1)
