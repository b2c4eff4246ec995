"""Tests whether a still point explains the matches of a surface: estimates its depth and counts contradicting matches.

Flow may find no match, or smear the motion of a foreground object over the background. The test then compares the
pictures at the projection of the still point. Maps are on the grid of `flow`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .flow import FlowConfig, Map, Mask, Seen, sample

FEW = 50
"""Smallest number of points for statistics of a picture."""
_OUTLINE = 0.25
"""Relative difference of depths that makes a full outline between two surfaces."""
_NEAR = 2
"""Distance in key frames up to which pictures are comparable even if one is blurred."""
_AGREES = 1.5
"""Factor on the tolerance up to which a match agrees with a still point."""
# Squared picture differences: cap of a pair's cost (the point is hidden or gone), and cost added to every depth other
# than a point's own.
_MAX_DIFFERENCE, _DEPTH_PENALTY = 400.0, 4.0


class Ray:
    """Projection of points on a key frame's rays into another view, by inverse depth."""

    def __init__(
        self, grid: tuple[Map, Map], views: tuple[NDArray[Any], NDArray[Any]], Ks: tuple[NDArray[Any], NDArray[Any]]
    ) -> None:
        """`views` [4, 4] and `Ks` [3, 3] of the key frame and of the other frame."""
        motion = views[1].astype(np.float64) @ np.linalg.inv(views[0].astype(np.float64))
        turn = (Ks[1] @ motion[:3, :3] @ np.linalg.inv(Ks[0])).astype(np.float32)
        self._far = [row[0] * grid[0] + (row[1] * grid[1] + row[2]) for row in turn]
        self._shift = (Ks[1] @ motion[:3, 3]).astype(np.float32)

    def project(self, inverse: Map) -> tuple[tuple[Map, Map], Map]:
        """Positions in the other view of points at inverse depths, and the points' depth ratio.

        The ratio is the depth in the key frame over the depth in the other view; at most 20, also behind the camera.
        """
        over = 1.0 / np.maximum(self._far[2] + inverse * self._shift[2], np.float32(0.05))
        x, y = ((self._far[i] + inverse * self._shift[i]) * over for i in (0, 1))
        return (x, y), over

    def slope(self, at: tuple[Map, Map], over: Map) -> tuple[Map, Map]:
        """Derivative of the position, as returned by `project`, with respect to inverse depth."""
        return (self._shift[0] - at[0] * self._shift[2]) * over, (self._shift[1] - at[1] * self._shift[2]) * over


class Look:
    """A key's picture prepared for comparison."""

    def __init__(self, picture: NDArray[np.uint8]) -> None:
        self._smooth = cv2.GaussianBlur(picture, (0, 0), 1.0)
        half = picture.shape[1] // 2, picture.shape[0] // 2
        self.grid = cv2.resize(self._smooth, half, interpolation=cv2.INTER_AREA).astype(np.float32)
        """[h, w] smoothed picture at the grid's points."""
        steps = (np.diff(self.grid, axis=0), np.diff(self.grid, axis=1))
        self.sharpness = float(sum(np.mean(step * step) for step in steps))
        """Mean squared difference of neighbouring points."""

    def difference(self, values: Map, at: tuple[Map, Map], gain: tuple[float, float]) -> Map:
        """Mean squared difference around each point between `values` and this picture at `at`, after `gain` (factor,
        offset)."""
        half = np.float32(0.5)
        shown = cv2.remap(self._smooth, at[0] - half, at[1] - half, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        beyond = values - np.float32(gain[1]) - shown * np.float32(gain[0])
        return cv2.blur(beyond * beyond, (3, 3))


@dataclass
class StillTest:
    """Inputs of the test of key frames."""

    look: Callable[[int], Look]
    """Returns the prepared picture of any key."""
    viewmats: NDArray[Any]
    """[K, 4, 4] world-to-camera of the keys, solve units."""
    Ks: NDArray[Any]
    """[K, 3, 3] intrinsics in flow pixels."""
    guessed: list[bool]
    """True for each key whose pose is interpolated."""
    grid: tuple[Map, Map]
    """Positions x and y of the grid's points."""
    unit: float
    """Flow pixels in one pixel of a picture 640 wide."""


class Texture:
    """Local structure of a key frame's picture: motion cannot be measured in areas without texture."""

    def __init__(self, picture: Map, unit: float, config: FlowConfig) -> None:
        # Scaled to derivatives per flow pixel: the grid's points are two flow pixels apart.
        gx, gy = cv2.Sobel(picture, cv2.CV_32F, 1, 0, scale=0.0625), cv2.Sobel(picture, cv2.CV_32F, 0, 1, scale=0.0625)
        self._xx, self._xy, self._yy = (cv2.blur(p, (3, 3)) for p in (gx * gx, gx * gy, gy * gy))
        self._longest = 3.0 * unit
        self.nearly = 0.5 * (self._xx + self._yy) * unit**2
        """Mean squared difference to a position one pixel (of a picture 640 wide) away."""
        self.telling = self.nearly * config.tolerance**2 > config.contrast**2
        """Mask of points at which motion by the tolerance would be visible."""

    def change(self, x: Map, y: Map, length: Map) -> Map:
        """Mean squared difference to the position (x, y) away, by a linear model; longer ways count as `_longest`."""
        shorter = np.square(np.minimum(1.0, self._longest / np.maximum(length, 1e-6)))
        return shorter * (self._xx * x * x + 2 * self._xy * x * y + self._yy * y * y)


@dataclass
class Pair:
    """A key frame and another key frame."""

    seen: Seen
    ray: Ray
    limit: float
    """Distance of a match from the projected still point above which it may show motion, in flow pixels."""
    neighbour: Look
    """Picture of the other key frame."""
    gain: tuple[float, float] = (1.0, 0.0)
    """Factor and offset that fit the other picture's brightness to the key's."""
    matched: Map = field(init=False)
    """Mean squared difference of the pictures at the matches."""
    right: Mask = field(init=False)
    """Mask of points at which the matches show the same surface."""
    weight: Map = field(init=False)
    """[h, w] confidence in each match; by default 1 where it is found, else 0."""

    def __post_init__(self) -> None:
        self.weight = self.seen.found.astype(np.float32)

    @classmethod
    def between(cls, test: StillTest, key: int, seen: Seen, config: FlowConfig) -> Pair:
        """The pair of `key` and `seen.key`, before the pictures are compared: `matched` and `right` are not set."""
        ray = Ray(test.grid, (test.viewmats[key], test.viewmats[seen.key]), (test.Ks[key], test.Ks[seen.key]))
        limit = test.unit * (config.tolerance + config.per_link * (seen.links - 1))
        return cls(seen, ray, limit, test.look(seen.key))

    def miss(self, inverse: Map) -> tuple[tuple[Map, Map], Map, Map, Map]:
        """Projected positions of still points, and x, y and length of the smoothed offset of the matches from them."""
        at, _ = self.ray.project(inverse)
        x, y = (_smoothed(self.seen.at[i] - at[i], self.weight) for i in (0, 1))
        return at, x, y, np.hypot(x, y)


@dataclass(frozen=True)
class Evidence:
    """Evidence from a key frame's matches, on the grid."""

    still: Map
    """Weight of the evidence that a point stands still."""
    moving: Map
    """Weight of the evidence that a point moves."""
    inverse: Map
    """Inverse depth of the still point that fits the matches best, in 1 / solve units."""
    agree: Map
    """Number of matches that the still point explains."""
    parallax: Map
    """Largest shift in flow pixels of these matches if the depth halved: the precision of the depth."""


def evidence(test: StillTest, key: int, seen: list[Seen], depth: float, config: FlowConfig) -> Evidence:
    """Evidence of stillness and motion from a key's matches.

    `seen` are the key's matches, `depth` is a typical depth in its view, in solve units.
    """
    look = test.look(key)
    texture = Texture(look.grid, test.unit, config)
    pairs = [_pair(test, key, s, texture, config) for s in seen]
    start = np.full(look.grid.shape, 1.0 / depth, np.float32)
    inverse = still_points(pairs, start, depth, test.unit)
    agree = np.zeros_like(inverse)
    for pair in pairs:
        *_, length = pair.miss(inverse)
        telling = pair.seen.found & texture.telling
        if np.count_nonzero(telling) >= FEW:
            guessed = test.guessed[key] or test.guessed[pair.seen.key]
            most = np.inf if guessed else config.most_noise * pair.limit
            pair.limit = max(pair.limit, min(config.noise * float(np.median(length[telling])), most))
        agree += pair.seen.found & (length <= pair.limit)
    depths = _surroundings(inverse, agree >= 3)
    inverse = _best_depth(look, pairs, depths)
    still, moving, agree, parallax = _counted(key, look, texture, pairs, inverse, config)
    doubt = config.doubt * (1.0 + config.outline * outlines(depths[0]))
    return Evidence(still, np.maximum(moving - doubt, 0.0), inverse, agree, parallax)


def outlines(inverse: Map) -> Map:
    """[h, w] 0..1: closeness of points to an outline between surfaces, from jumps of inverse depth."""
    block = np.ones((7, 7), np.uint8)
    jump = cv2.dilate(inverse, block) / np.maximum(cv2.erode(inverse, block), 1e-9) - 1.0
    return np.clip(jump / _OUTLINE, 0.0, 1.0)


def _pair(test: StillTest, key: int, seen: Seen, texture: Texture, config: FlowConfig) -> Pair:
    """The pair of `key` and `seen.key`, with the comparison of their pictures."""
    look, pair = test.look(key), Pair.between(test, key, seen, config)
    pair.gain = brightness(look.grid, sample(pair.neighbour.grid, seen.at), seen.found)
    pair.matched = pair.neighbour.difference(look.grid, seen.at, pair.gain)
    pair.right = pair.matched - texture.nearly < _like(pair.matched, seen.found & texture.telling, config)
    return pair


def still_points(pairs: list[Pair], start: Map, depth: float, unit: float, turns: int = 4) -> Map:
    """Inverse depths [h, w] of the still points that fit the matches best, in 1 / solve units, at least 0.

    The fit is robust. Where the matches do not determine it, the inverse depth stays near `start`. `depth` is a typical
    depth.
    """
    inverse = start.copy()
    stiff = np.float32((0.3 * unit * depth) ** 2)
    for turn in range(turns):
        top, bottom = stiff * (start - inverse), np.full_like(inverse, stiff)
        for pair in pairs:
            at, over = pair.ray.project(inverse)
            slope = pair.ray.slope(at, over)
            x, y = pair.seen.at[0] - at[0], pair.seen.at[1] - at[1]
            weight = pair.weight * np.float32(1.0 / pair.limit**2)
            # From the start depth, all matches are distant; afterwards, distant ones hardly count.
            if turn:
                weight /= np.square(1.0 + (x * x + y * y) * np.float32(1.0 / pair.limit**2))
            top += weight * (x * slope[0] + y * slope[1])
            bottom += weight * (slope[0] * slope[0] + slope[1] * slope[1])
        inverse = np.maximum(inverse + top / bottom, 0.0)
    return inverse


def _counted(
    key: int, look: Look, texture: Texture, pairs: list[Pair], inverse: Map, config: FlowConfig
) -> tuple[Map, Map, Map, Map]:
    """(still, moving, agree, parallax) of still points at inverse depths, as in `Evidence`."""
    still, moving, agree, parallax = (np.zeros_like(inverse) for _ in range(4))
    lost: dict[int, Mask] = {}
    for pair in pairs:
        found, after = pair.seen.found, pair.seen.key - key
        at, x, y, length = pair.miss(inverse)
        difference = pair.neighbour.difference(look.grid, at, pair.gain)
        displaced = found & (length > pair.limit)
        fits = found & (length <= _AGREES * pair.limit)
        slope = pair.ray.slope(*pair.ray.project(inverse))
        agree += fits
        parallax = np.maximum(parallax, fits * np.hypot(*slope) * inverse)
        similar = difference - texture.nearly < _like(difference, found & ~displaced & texture.telling, config)
        within = inside(at, look.grid.shape)
        better = pair.right & (difference > config.better * pair.matched + config.contrast**2)
        moving += displaced & better & (texture.change(x, y, length) > config.contrast**2)
        weight = min(1.0, abs(after) / config.baselines[-1]) ** config.haste
        # On a plain wall, flow follows the objects in front of it. A match whose pictures differ is no evidence there.
        smeared = found & ~displaced & ~similar & ~pair.right
        still += weight * (
            (found & ~displaced & ~smeared) + 0.5 * ((displaced & ~better) | (within & similar & ~found))
        )
        # A blurred picture matches no picture far from it in time, even where the scene stands still, so it is no
        # evidence.
        if abs(after) <= _NEAR or look.sharpness >= config.blurred * pair.neighbour.sharpness:
            lost[after] = within & ~similar & (~found | smeared)
    for step in config.baselines[:3]:
        # A point missing both before and after moves too fast for flow. A hidden point is usually hidden on one side.
        if step in lost and -step in lost:
            far = config.gone_far if step > _NEAR else 1.0
            moving += far * (lost[step] & lost[-step])
    return still, moving, agree, parallax


def _smoothed(values: Map, weight: Map) -> Map:
    """Weighted local mean of `values`, which reduces local errors of the flow."""
    return cv2.blur(values * weight, (5, 5)) / np.maximum(cv2.blur(weight, (5, 5)), 1e-3)


def _like(difference: Map, still: Mask, config: FlowConfig) -> float:
    """Threshold of the squared difference below which pictures show the same surface.

    It rises with the median difference at `still` points, which differ if only one of the two pictures is sharp.
    """
    usual = float(np.median(difference[still])) if np.count_nonzero(still) >= FEW else 0.0
    return max(config.likeness**2, config.noise**2 * usual)


def _best_depth(look: Look, pairs: list[Pair], depths: list[Map]) -> Map:
    """For each point the candidate among `depths` (inverse) with the smallest picture difference to direct matches."""
    best, least = depths[0], np.zeros_like(depths[0])
    for number, inverse in enumerate(depths):
        cost, count = np.zeros_like(inverse), np.full_like(inverse, 1e-6)
        for pair in pairs:
            if pair.seen.links == 1:
                at, _ = pair.ray.project(inverse)
                within = inside(at, inverse.shape)
                cost += within * np.minimum(pair.neighbour.difference(look.grid, at, pair.gain), _MAX_DIFFERENCE)
                count += within
        cost = cost / count + (_DEPTH_PENALTY if number else 0.0)
        better = cost < least if number else np.ones(cost.shape, bool)
        best, least = np.where(better, inverse, best), np.where(better, cost, least)
    return best


def inside(at: tuple[Map, Map], shape: tuple[int, ...]) -> Mask:
    """Mask of the positions inside a picture whose grid has the given shape."""
    return (at[0] >= 0) & (at[1] >= 0) & (at[0] < 2 * shape[1]) & (at[1] < 2 * shape[0])


def brightness(values: Map, target: Map, found: Mask) -> tuple[float, float]:
    """Factor and offset that fit `target` to `values` at the `found` points, because exposure drifts in a clip."""
    return fitted_brightness(values[::4, ::4][found[::4, ::4]], target[::4, ::4][found[::4, ::4]])


def fitted_brightness(a: Map, b: Map) -> tuple[float, float]:
    """Factor and offset that fit values `b` [P] to `a` [P]; (1, 0) for fewer than `FEW` values."""
    if len(a) < FEW:
        return 1.0, 0.0
    spread = float(b.var())
    factor = (
        float(np.clip(((a - a.mean()) * (b - b.mean())).mean() / max(spread, 1.0), 0.5, 2.0)) if spread > 25 else 1.0
    )
    return factor, float(np.median(a - factor * b))


def _surroundings(inverse: Map, sure: Mask) -> list[Map]:
    """Candidate inverse depths of each point, [h, w] each: its own, the farthest and the nearest around it."""
    known = np.where(sure, cv2.medianBlur(inverse, 5), 0.0).astype(np.float32)
    total, weight = known, sure.astype(np.float32)
    filled, certain = np.zeros_like(known), np.zeros_like(known)
    for radius in (2, 6, 18, 54):  # the nearest sure points count most
        size = (2 * radius + 1, 2 * radius + 1)
        share = (1.0 - certain) * np.minimum(1.0, cv2.blur(weight, size) * radius)
        filled += share * cv2.blur(total, size) / np.maximum(cv2.blur(weight, size), 1e-6)
        certain += share
    filled = np.where(certain > 1e-3, filled / np.maximum(certain, 1e-3), inverse).astype(np.float32)
    filled[sure] = known[sure]
    block = np.ones((17, 17), np.uint8)
    # Neighbours' depths, because flow smears the motion of the foreground over the background.
    return [filled, cv2.erode(filled, block), cv2.dilate(filled, block)]
