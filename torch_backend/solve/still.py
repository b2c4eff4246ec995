"""Whether a point that stands still explains what is seen of a surface: its depth, and how many matches say no.

Where nothing is matched, or where flow smears the motion of what is in front over what is behind it, pictures are
compared where the point would be seen if it stood still. Maps are on the grid of `flow`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .flow import FlowConfig, Map, Mask, Seen, sample


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
    """A key's picture prepared for comparison."""

    def __init__(self, picture: NDArray[np.uint8]) -> None:
        self._smooth = cv2.GaussianBlur(picture, (0, 0), 1.0)
        half = picture.shape[1] // 2, picture.shape[0] // 2
        self.grid = cv2.resize(self._smooth, half, interpolation=cv2.INTER_AREA).astype(np.float32)
        """[h, w] at the grid's points."""

    def unlike(self, values: Map, at: tuple[Map, Map], gain: tuple[float, float]) -> Map:
        """Mean square difference around each point between `values` and this picture, times and plus `gain`, there."""
        half = np.float32(0.5)
        there = cv2.remap(self._smooth, at[0] - half, at[1] - half, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        beyond = values - np.float32(gain[1]) - there * np.float32(gain[0])
        return cv2.blur(beyond * beyond, (5, 5))


def _gain(values: Map, others: Map, found: Mask) -> tuple[float, float]:
    """Factor and offset that make `others` look like `values` where they are `found`: exposure drifts in a clip."""
    a, b = values[::4, ::4][found[::4, ::4]], others[::4, ::4][found[::4, ::4]]
    if len(a) < 50:
        return 1.0, 0.0
    spread = float(b.var())
    factor = (
        float(np.clip(((a - a.mean()) * (b - b.mean())).mean() / max(spread, 1.0), 0.5, 2.0)) if spread > 25 else 1.0
    )
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
class StillTest:
    """What the test of a key frame stands on."""

    look: Callable[[int], Look]
    """Of any key."""
    viewmats: NDArray
    """[K, 4, 4] world-to-camera of the keys, solve units."""
    Ks: NDArray
    """[K, 3, 3] in flow pixels."""
    guessed: list[bool]
    """Keys whose pose was not solved."""
    grid: tuple[Map, Map]
    """Positions of the grid's points."""
    unit: float
    """Flow pixels in one pixel of a picture 640 wide."""


def evidence(test: StillTest, key: int, seen: list[Seen], depth: float, config: FlowConfig) -> tuple[Map, Map]:
    """Tests the matches `seen` of a key frame against one still point per grid point.

    `depth` is the typical depth in this view, solve units.
    """
    unit, look = test.unit, test.look(key)
    xx, xy, yy = _tensor(look.grid)
    nearly = 0.5 * (xx + yy) * unit**2  # what a pixel aside makes
    telling = nearly * config.tolerance**2 > config.contrast**2
    rays = [Ray(test.grid, (test.viewmats[key], test.viewmats[s.key]), (test.Ks[key], test.Ks[s.key])) for s in seen]
    limits = [unit * (config.tolerance + config.per_link * (s.links - 1)) for s in seen]
    gains, unlikes, rights = [], [], []
    for s in seen:
        there = test.look(s.key)
        gains.append(_gain(look.grid, sample(there.grid, s.at), s.found))
        unlikes.append(there.unlike(look.grid, s.at, gains[-1]))
        rights.append(unlikes[-1] - nearly < _like(unlikes[-1], s.found & telling, config))
    inverse = still_points(rays, seen, limits, depth, unit)
    on = np.zeros_like(inverse)
    for n, (ray, s) in enumerate(zip(rays, seen, strict=True)):
        at, _ = ray.project(inverse)
        length = np.hypot(_smoothed(s.at[0] - at[0], s.found), _smoothed(s.at[1] - at[1], s.found))
        told = s.found & telling
        if np.count_nonzero(told) > 50:
            usual = config.noise * float(np.median(length[told]))
            most = np.inf if test.guessed[key] or test.guessed[s.key] else config.most_noise * limits[n]
            limits[n] = max(limits[n], min(usual, most))
        on += s.found & (length <= limits[n])
    inverse = _best_depth(test, look, rays, seen, gains, _surroundings(inverse, on >= 3))
    on, off = np.zeros_like(inverse), np.zeros_like(inverse)
    gone: dict[int, Mask] = {}
    for ray, s, limit, gain, at_match, right in zip(rays, seen, limits, gains, unlikes, rights, strict=True):
        at, _ = ray.project(inverse)
        x, y = _smoothed(s.at[0] - at[0], s.found), _smoothed(s.at[1] - at[1], s.found)
        length = np.hypot(x, y)
        unlike = test.look(s.key).unlike(look.grid, at, gain)
        inside = _inside(at, look.grid.shape)
        away = s.found & (length > limit)
        alike = inside & (unlike - nearly < _like(unlike, s.found & ~away & telling, config))
        shorter = np.square(np.minimum(1.0, 3.0 * unit / np.maximum(length, 1e-6)))
        change = shorter * (xx * x * x + 2 * xy * x * y + yy * y * y)
        better = right & (unlike > config.better * at_match + config.contrast**2)
        off += away & (change > config.contrast**2) & better
        # The nearer in time, the less it says that something has not moved yet.
        weight = min(1.0, abs(s.key - key) / config.baselines[-1]) ** config.haste
        on += weight * ((s.found & ~away) + 0.5 * ((away & ~better) | (alike & ~s.found)))
        gone[s.key - key] = inside & ~s.found & ~alike
    for step in config.baselines[:2]:
        if step in gone and -step in gone:
            off += gone[step] & gone[-step]
    return on, off


def _smoothed(values: Map, found: Mask) -> Map:
    """Mean of what is found around each point: a surface moves as one, flow errs here and there."""
    weight = found.astype(np.float32)
    return cv2.blur(values * weight, (5, 5)) / np.maximum(cv2.blur(weight, (5, 5)), 1e-3)


def _like(unlike: Map, still: Mask, config: FlowConfig) -> float:
    """Below how much pictures show the same: what is `still` tells how unlike a sharp and a blurred one are."""
    usual = float(np.median(unlike[still])) if np.count_nonzero(still) > 50 else 0.0
    return max(config.likeness**2, config.noise**2 * usual)


def _best_depth(
    test: StillTest, look: Look, rays: list[Ray], seen: list[Seen], gains: list[tuple[float, float]], depths: list[Map]
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
            cost += inside * np.minimum(test.look(s.key).unlike(look.grid, at, gain), 400.0)
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
