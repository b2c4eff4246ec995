"""What moves by itself in a clip whose cameras are known: dense matches between frames against one point in space.

A pixel of a key frame is matched with key frames around it, near and far in time. Where one point that stands still
explains all of the matches, the surface stands still; its depth is found on the way, so motion along an epipolar line
is seen as well wherever three views or more tell of it. Where nothing is matched, the pictures are compared where the
point would be seen if it stood still. All is computed on a grid of half the pictures' pixels.

Pure functions on numpy arrays, and a store of matches; `motion.py` reads and writes the files. Positions are in pixels
of the pictures that are matched ("flow pixels"), centres at +0.5, as a pair of planes x and y.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Map = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class FlowConfig:
    """What counts as motion. Lengths are in pixels of a picture 640 wide."""

    baselines: tuple[int, ...] = (1, 2, 4, 8)
    """A key frame is matched with those this many key frames before and after; each is double the one before."""
    links: int = 4
    """Matches over the longest baseline are chained this often: 4 links of 8 key frames reach 3 seconds."""
    tolerance: float = 1.5
    """A match this far from where the still point is seen tells of motion: flow and solve err by 0.5 to 1 each."""
    per_link: float = 0.35
    """So much more for each further link of a chain."""
    noise: float = 2.5
    """The tolerance of a pair is at least this many times the median distance in it: blur, shutter, a poor pose."""
    round_trip: float = 1.2
    """Greatest distance between a pixel and where the flow there and back ends; above it the pixel is hidden there."""
    contrast: float = 4.0
    """A match off its place tells of motion if the picture changes over that distance by so many of 255 steps."""
    likeness: float = 8.0
    """Pictures that differ by less, in 255 steps and over a few pixels, show the same."""


class Matches:
    """Dense matches between key frames, on a grid of half the pictures' pixels. Each pair is computed once."""

    def __init__(self, picture: Callable[[int], NDArray[np.uint8]], config: FlowConfig, unit: float) -> None:
        """`picture` gives key k as [H, W] uint8, even sides; `unit` is how many of its pixels 1/640 of a width is."""
        self._picture, self._config, self._unit = picture, config, unit
        self._dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
        self._flows: dict[tuple[int, int], NDArray[np.float16]] = {}
        self._found: dict[tuple[int, int], Mask] = {}
        height, width = picture(0).shape
        self.size = width // 2, height // 2
        x, y = np.meshgrid(np.arange(1, width, 2), np.arange(1, height, 2))
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
                start = np.stack([first[i] + sample(rest[i], at) for i in (0, 1)], -1)
                start = cv2.resize(start, one.shape[::-1], interpolation=cv2.INTER_LINEAR)
            found = self._dis.calc(one, two, start)  # type: ignore[call-overload]
            small = cv2.resize(found, self.size, interpolation=cv2.INTER_AREA)
            self._flows[a, b] = np.ascontiguousarray(small.transpose(2, 0, 1)).astype(np.float16)
        return self._flows[a, b]

    def match(self, a: int, b: int) -> tuple[Map, Map, Mask]:
        """Positions x, y in b of a's points, and which are found: inside, and back again."""
        there = self.flow(a, b).astype(np.float32)
        at = self.grid[0] + there[0], self.grid[1] + there[1]
        if (a, b) not in self._found:
            back = self.flow(b, a)
            gap = (there[0] + sample(back[0], at)) ** 2 + (there[1] + sample(back[1], at)) ** 2
            self._found[a, b] = self.inside(at) & (gap <= (self._config.round_trip * self._unit) ** 2)
        return *at, self._found[a, b]

    def loose(self, one: NDArray[np.uint8], two: NDArray[np.uint8]) -> tuple[tuple[Map, Map], Mask]:
        """Positions in `two` of `one`'s points, and which are found, of pictures that are no keys; nothing is kept."""
        flows = [
            cv2.resize(self._dis.calc(a, b, None), self.size, interpolation=cv2.INTER_AREA)  # type: ignore[call-overload]
            for a, b in ((one, two), (two, one))
        ]
        (x, y), (back_x, back_y) = (tuple(np.ascontiguousarray(f.transpose(2, 0, 1))) for f in flows)
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


def sample(values: NDArray, at: tuple[Map, Map]) -> Map:
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


class Ray:
    """Where points on a key frame's rays are seen in another one, by their inverse depth."""

    def __init__(self, grid: tuple[Map, Map], views: tuple[NDArray, NDArray], Ks: tuple[NDArray, NDArray]) -> None:
        """`views` [4, 4] and `Ks` [3, 3] of the key frame and of the other one."""
        motion = views[1].astype(np.float64) @ np.linalg.inv(views[0].astype(np.float64))
        turn = (Ks[1] @ motion[:3, :3] @ np.linalg.inv(Ks[0])).astype(np.float32)
        self._far = [row[0] * grid[0] + (row[1] * grid[1] + row[2]) for row in turn]
        self._shift = (Ks[1] @ motion[:3, 3]).astype(np.float32)

    def project(self, inverse: Map) -> tuple[tuple[Map, Map], Map]:
        """Positions in the other view of points at inverse depths, and 1 / depth there (before it: at least 1/20)."""
        over = 1.0 / np.maximum(self._far[2] + inverse * self._shift[2], np.float32(0.05))
        x, y = ((self._far[i] + inverse * self._shift[i]) * over for i in (0, 1))
        return (x, y), over

    def slope(self, at: tuple[Map, Map], over: Map) -> tuple[Map, Map]:
        """How fast such a position moves with the inverse depth."""
        return (self._shift[0] - at[0] * self._shift[2]) * over, (self._shift[1] - at[1] * self._shift[2]) * over


@dataclass
class Evidence:
    """What the matches of one key frame say, [h, w] float32."""

    on: Map
    """How many of a point's matches lie where a still point is seen."""
    off: Map
    """How many lie elsewhere, by more than flow and picture leave open."""
    inverse: Map
    """Inverse depth of the still point in 1 / solve units; at least 0."""


def still_points(
    rays: list[Ray], seen: list[Seen], limits: list[float], depth: float, unit: float, turns: int = 4
) -> Map:
    """Inverse depth [h, w] of the still point that explains the matches best, those far off hardly counting."""
    inverse = np.full(seen[0].found.shape, 1.0 / depth, np.float32)
    stiff = np.float32((0.3 * unit * depth) ** 2)
    for turn in range(turns):
        top, bottom = stiff * (np.float32(1.0 / depth) - inverse), np.full_like(inverse, stiff)
        for ray, s, limit in zip(rays, seen, limits, strict=True):
            at, over = ray.project(inverse)
            slope = ray.slope(at, over)
            x, y = s.at[0] - at[0], s.at[1] - at[1]
            weight = s.found * np.float32(1.0 / limit**2)
            if turn:
                weight /= np.square(1.0 + (x * x + y * y) * np.float32(1.0 / limit**2))
            top += weight * (x * slope[0] + y * slope[1])
            bottom += weight * (slope[0] * slope[0] + slope[1] * slope[1])
        inverse = np.maximum(inverse + top / bottom, 0.0)
    return inverse


class Look:
    """A key's picture prepared for comparison: a pixel may look like anything within one pixel of where it should be."""

    def __init__(self, picture: NDArray[np.uint8]) -> None:
        smooth = cv2.GaussianBlur(picture, (0, 0), 1.0)
        block = np.ones((3, 3), np.uint8)
        self.low, self.high = cv2.erode(smooth, block), cv2.dilate(smooth, block)
        half = picture.shape[1] // 2, picture.shape[0] // 2
        self.grid = cv2.resize(smooth, half, interpolation=cv2.INTER_AREA).astype(np.float32)
        """[h, w] at the grid's points."""

    def unlike(self, values: Map, at: tuple[Map, Map], gain: tuple[float, float]) -> Map:
        """Mean square difference around each point between `values` and this picture, times and plus `gain`, there."""
        x, y = at[0] - np.float32(0.5), at[1] - np.float32(0.5)
        low, high = (cv2.remap(p, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for p in (self.low, self.high))
        beyond = np.maximum(values - (high * np.float32(gain[0]) + np.float32(gain[1])), 0.0)
        beyond += np.maximum((low * np.float32(gain[0]) + np.float32(gain[1])) - values, 0.0)
        return cv2.blur(beyond * beyond, (5, 5))


def _gain(values: Map, others: Map, found: Mask) -> tuple[float, float]:
    """Factor and offset that make `others` look like `values` where they are `found`: exposure drifts in a clip."""
    a, b = values[::4, ::4][found[::4, ::4]], others[::4, ::4][found[::4, ::4]]
    if len(a) < 50:
        return 1.0, 0.0
    spread = float(b.var())
    factor = float(np.clip(((a - a.mean()) * (b - b.mean())).mean() / max(spread, 1.0), 0.5, 2.0)) if spread > 25 else 1.0
    return factor, float(np.median(a - factor * b))


def _surroundings(inverse: Map, sure: Mask) -> list[Map]:
    """Depths that a point may have: its own, or that of what is behind or before it nearby, [h, w] each.

    Flow smears the motion of what is in front over what is behind it.
    """
    own = np.where(sure, cv2.medianBlur(inverse, 5), 0.0).astype(np.float32)
    total, weight = own, sure.astype(np.float32)
    filled, certain = np.zeros_like(own), np.zeros_like(own)
    for radius in (2, 6, 18, 54):  # the nearest that are sure count most
        size = (2 * radius + 1, 2 * radius + 1)
        share = (1.0 - certain) * np.minimum(1.0, cv2.blur(weight, size) * radius)
        filled += share * cv2.blur(total, size) / np.maximum(cv2.blur(weight, size), 1e-6)
        certain += share
    filled = np.where(certain > 1e-3, filled / np.maximum(certain, 1e-3), inverse).astype(np.float32)
    filled[sure] = own[sure]
    block = np.ones((17, 17), np.uint8)
    return [filled, cv2.erode(filled, block), cv2.dilate(filled, block)]


@dataclass
class Scene:
    """What the test of a key frame needs to know."""

    look: Callable[[int], Look]
    """Of any key."""
    viewmats: NDArray
    """[K, 4, 4] world-to-camera of the keys, solve units."""
    Ks: NDArray
    """[K, 3, 3] in flow pixels."""
    grid: tuple[Map, Map]
    """Positions of the grid's points."""
    unit: float
    """Flow pixels in one pixel of a picture 640 wide."""


def evidence(scene: Scene, key: int, seen: list[Seen], depth: float, config: FlowConfig) -> Evidence:
    """Tests the matches `seen` of a key frame against one still point per grid point.

    `depth` is the typical depth in this view, solve units.
    """
    unit, look = scene.unit, scene.look(key)
    rays = [Ray(scene.grid, (scene.viewmats[key], scene.viewmats[s.key]), (scene.Ks[key], scene.Ks[s.key])) for s in seen]
    limits = [unit * (config.tolerance + config.per_link * (s.links - 1)) for s in seen]
    inverse = still_points(rays, seen, limits, depth, unit)
    on = np.zeros_like(inverse)
    gains = []
    for n, (ray, s) in enumerate(zip(rays, seen, strict=True)):
        at, _ = ray.project(inverse)
        length = np.hypot(s.at[0] - at[0], s.at[1] - at[1])
        if s.found.any():
            limits[n] = max(limits[n], config.noise * float(np.median(length[s.found])))
        on += s.found & (length <= limits[n])
        gains.append(_gain(look.grid, sample(scene.look(s.key).grid, s.at), s.found))
    inverse = _best_depth(scene, look, rays, seen, gains, _surroundings(inverse, on >= 3))
    xx, xy, yy = _tensor(look.grid)
    on, off = np.zeros_like(inverse), np.zeros_like(inverse)
    gone: dict[int, Mask] = {}
    for ray, s, limit, gain in zip(rays, seen, limits, gains, strict=True):
        at, _ = ray.project(inverse)
        x, y = s.at[0] - at[0], s.at[1] - at[1]
        length = np.hypot(x, y)
        there = scene.look(s.key)
        unlike = there.unlike(look.grid, at, gain)
        inside = _inside(at, look.grid.shape)
        usual = float(np.median(unlike[s.found])) if s.found.any() else 0.0
        alike = inside & (unlike < max(config.likeness**2, config.noise**2 * usual))
        away = s.found & (length > limit)
        shorter = np.square(np.minimum(1.0, 3.0 * unit / np.maximum(length, 1e-6)))
        change = shorter * (xx * x * x + 2 * xy * x * y + yy * y * y)
        told = away & (change > config.contrast**2) & ~alike
        off += told
        on += s.found & ~away
        on += 0.5 * (alike & (away | ~s.found))
        gone[s.key - key] = inside & ~s.found & ~alike
    for step in config.baselines[:2]:
        if step in gone and -step in gone:
            off += gone[step] & gone[-step]
    return Evidence(on, off, inverse)


def _best_depth(
    scene: Scene, look: Look, rays: list[Ray], seen: list[Seen], gains: list[tuple[float, float]], depths: list[Map]
) -> Map:
    """Of the inverse depths, for each point the one at which it looks the same in the most neighbours."""
    best, least = depths[0], None
    for number, inverse in enumerate(depths):
        cost, count = np.zeros_like(inverse), np.full_like(inverse, 1e-6)
        for ray, s, gain in zip(rays, seen, gains, strict=True):
            if s.links > 1:
                continue
            at, _ = ray.project(inverse)
            inside = _inside(at, inverse.shape)
            cost += inside * np.minimum(scene.look(s.key).unlike(look.grid, at, gain), 400.0)
            count += inside
        cost = cost / count + (4.0 if number else 0.0)
        if least is None:
            least = cost
        else:
            better = cost < least
            best, least = np.where(better, inverse, best), np.where(better, cost, least)
    return best


def _inside(at: tuple[Map, Map], shape: tuple[int, ...]) -> Mask:
    return (at[0] >= 0) & (at[1] >= 0) & (at[0] < 2 * shape[1]) & (at[1] < 2 * shape[0])


def _tensor(picture: Map) -> tuple[Map, Map, Map]:
    """Mean of gx gx, gx gy, gy gy around each point of a grid [h, w], of steps per flow pixel."""
    gx, gy = cv2.Sobel(picture, cv2.CV_32F, 1, 0, scale=0.0625), cv2.Sobel(picture, cv2.CV_32F, 0, 1, scale=0.0625)
    return cv2.boxFilter(gx * gx, -1, (5, 5)), cv2.boxFilter(gx * gy, -1, (5, 5)), cv2.boxFilter(gy * gy, -1, (5, 5))


def fused(own: tuple[Map, Map], others: Iterable[tuple[Seen, Map, Map]]) -> tuple[Map, Map]:
    """Score and weight of a key frame with those of its neighbours followed to it: a surface has one label."""
    total, weight = own[0] * own[1] * 2.0, own[1] * 2.0
    for seen, score, sure in others:
        w = sample(sure, seen.at) * seen.found
        total = total + w * sample(score, seen.at)
        weight = weight + w
    return total / np.maximum(weight, 1e-6), weight


class Guide:
    """Spreads values within the areas of a picture, stopping at its edges: a guided filter (He 2010), grey."""

    def __init__(self, picture: Map, radius: int, edge: float) -> None:
        """`picture` [h, w] 0 to 255; differences below `edge` are none."""
        self._size = (2 * radius + 1, 2 * radius + 1)
        self._picture = picture
        self._mean = self._blur(picture)
        self._variance = self._blur(picture * picture) - self._mean**2 + np.float32(edge * edge)

    def _blur(self, values: Map) -> Map:
        return cv2.blur(values, self._size, borderType=cv2.BORDER_REFLECT)

    def __call__(self, values: Map) -> Map:
        """[h, w] to the same."""
        mean = self._blur(values)
        slope = (self._blur(values * self._picture) - mean * self._mean) / self._variance
        level = mean - slope * self._mean
        return self._blur(slope) * self._picture + self._blur(level)
