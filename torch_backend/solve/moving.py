"""From a solved clip to its motion mattes: key frames are tested, their scores follow surfaces through time, and areas.

Keys are about ten frames a second, more in a short clip; the frames between two keys take theirs by flow. Frames go
through a window of a few seconds, so a clip of any length takes the same memory.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from ..contract import Reporter, frame_file
from ..footage import load_frames
from ..footage.images import read_frame
from ..shot import Shot
from .flow import FlowConfig, Map, Mask, Matches, neighbours, sample
from .leftover import Leftover
from .still import Look, StillTest, evidence
from .stored import load_cameras, load_points

_FLOW_WIDTH = 640
_LARGEST_SCALE = 2.0
_KEYS_PER_SECOND, _LEAST_KEYS = 10.0, 16
_LEAST_SIDE = 64
_LEFT_EVERY = 2
"""In every so manieth key frame what is left of motion is looked for: sways are slow."""
_ENOUGH, _UNKNOWN = 3.0, 0.1
"""Weights: more than the one adds nothing, below the other nothing is known."""


class Clip:
    """Frames and cameras of a solved shot, in the flow's size."""

    def __init__(self, shot: Shot) -> None:
        """JobError if it is not solved."""
        path = load_cameras(shot)
        seconds = {int(row["frame"]): float(row["seconds"]) for row in load_frames(shot)["frames"]}
        self._shot = shot
        self.frames = [camera.frame for camera in path.frames]
        """Numbers of the delivered frames, ascending."""
        self.width, self.height = path.width, path.height
        scale = min(_LARGEST_SCALE, _FLOW_WIDTH / path.width)
        width, height = (max(_LEAST_SIDE, round(side * scale / 2) * 2) for side in (path.width, path.height))
        self.flow_size = width, height
        self.unit = width / 640.0
        """Flow pixels in one pixel of a picture 640 wide."""
        self.keys = _keys([seconds.get(frame, float(n)) for n, frame in enumerate(self.frames)])
        """Indices into `frames`."""
        viewmats = np.array([c.viewmat for c in path.frames], np.float64).reshape(-1, 4, 4)
        Ks = np.array([[[c.K[0], 0, c.K[2]], [0, c.K[1], c.K[3]], [0, 0, 1]] for c in path.frames], np.float64)
        Ks *= np.array([width / path.width, height / path.height, 1.0])[None, :, None]
        self.viewmats, self.Ks = viewmats[self.keys], Ks[self.keys]
        """Of the keys: [K, 4, 4] world-to-camera, solve units, and [K, 3, 3] in flow pixels."""
        self.guessed = [path.frames[i].source == "interpolated" for i in self.keys]
        """Keys whose pose was not solved."""
        points = load_points(shot)["xyz"].astype(np.float64)
        self.depths = [_typical_depth(points, viewmat) for viewmat in self.viewmats]
        """Of the keys: median depth of the sparse points before the camera."""
        self._pictures: dict[int, NDArray[np.uint8]] = {}
        self._looks: dict[int, Look] = {}

    def picture(self, key: int) -> NDArray[np.uint8]:
        """Grey picture of a key in the flow's size. JobError if the frame is damaged."""
        if key not in self._pictures:
            self._pictures[key] = self.grey(self.keys[key])
        return self._pictures[key]

    def look(self, key: int) -> Look:
        """It, prepared for comparison."""
        if key not in self._looks:
            self._looks[key] = Look(self.picture(key))
        return self._looks[key]

    def grey(self, index: int) -> NDArray[np.uint8]:
        """Grey picture of any frame, as `picture`."""
        pixels = read_frame(self._shot.frames / frame_file(self.frames[index], ".png"))
        pixels = pixels if pixels.dtype == np.uint8 else (pixels >> 8).astype(np.uint8)
        grey = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), np.uint8)
        if grey.shape == self.flow_size[::-1]:
            return grey
        how = cv2.INTER_AREA if self.flow_size[0] < grey.shape[1] else cv2.INTER_CUBIC
        return np.asarray(cv2.resize(grey, self.flow_size, interpolation=how), np.uint8)

    def forget(self, before: int) -> None:
        """Drops the pictures of keys below `before`."""
        for store in (self._pictures, self._looks):
            for key in [key for key in store if key < before]:
                del store[key]


def _keys(seconds: list[float]) -> list[int]:
    """Indices of the key frames: evenly spaced, the first and the last frame among them."""
    step = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 0.0
    stride = round(1.0 / (_KEYS_PER_SECOND * step)) if step > 0 else 1
    stride = max(1, min(stride, len(seconds) // _LEAST_KEYS))
    return sorted({*range(0, len(seconds), stride), len(seconds) - 1})


def _typical_depth(points: NDArray, viewmat: NDArray) -> float:
    """Median depth of points [P, 3] before a camera [4, 4]; 1 if there are none."""
    z = points @ viewmat[2, :3] + viewmat[2, 3]
    z = z[z > 0]
    return float(np.median(z)) if len(z) else 1.0


def mattes(
    clip: Clip, config: FlowConfig, written: Collection[int], report: Reporter
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """(index, labels [H, W] uint8: 0 still, 128 unknown, 255 moving) of all frames but the `written` ones, in order."""
    keys, reach = clip.keys, config.reach * config.baselines[-1]
    groups = [range(keys[k - 1] + 1 if k else 0, keys[k] + 1) for k in range(len(keys))]
    wanted = [any(n not in written for n in group) for group in groups]
    if not any(wanted):
        return
    first, last = wanted.index(True), len(wanted) - 1 - wanted[::-1].index(True)
    matches = Matches(clip.picture, config, clip.unit)
    own: dict[int, tuple[Map, Map]] = {}
    final: dict[int, tuple[Map, Map]] = {}
    start = max(0, first - 1 - reach)
    left: tuple[Map, Map] | None = None
    for turn in range(start - start % _LEFT_EVERY, last + reach + 1):
        report.check_cancelled()
        if turn < len(keys):
            left = None if turn % _LEFT_EVERY == 0 else left
            own[turn], left = _own_score(clip, matches, turn, config, left)
        key = turn - reach
        if key < max(0, first - 1) or not (wanted[key] or wanted[min(key + 1, last)]):
            continue
        final[key] = _followed(matches, key, own, len(keys), reach, config)
        for n in groups[key] if wanted[key] else ():
            if n not in written:
                picture = clip.picture(key) if n == keys[key] else clip.grey(n)
                score = final[key] if n == keys[key] else _between(clip, matches, picture, key, final)
                yield n, _labels(clip, picture, *score, config)
        for store in (own, final):
            for old in [k for k in store if k < key - reach + 1]:
                del store[old]
        matches.forget(key - config.baselines[-1] + 1, key - config.links * config.baselines[-1])
        clip.forget(key - config.baselines[-1])


def _own_score(
    clip: Clip, matches: Matches, key: int, config: FlowConfig, before: tuple[Map, Map] | None
) -> tuple[tuple[Map, Map], tuple[Map, Map]]:
    """((score, weight), what is left): how surely a key frame's points move, 0 to 1, and how much is known of them.

    What is left of motion is looked for if there is none of the key `before`; else that is followed to here.
    """
    seen = neighbours(matches, key, len(clip.keys), config)
    test = StillTest(clip.look, clip.viewmats, clip.Ks, clip.guessed, matches.grid, clip.unit)
    on, off, inverse = evidence(test, key, seen, clip.depths[key], config)
    count = on + off
    score = np.clip(off / (count + config.doubt) / config.share, 0.0, 1.0)
    if before is None:
        left, known = Leftover(clip.picture, test, config).score(key, len(clip.keys), inverse, clip.depths[key])
    else:
        last = next(each for each in seen if each.key == key - 1)
        left, known = (sample(values, last.at) * last.found for values in before)
    sure = np.minimum(count / config.sure, 1.0) * (count >= 1.0)
    return (np.maximum(score, left), np.maximum(sure, known * (left > score))), (left, known)


def _followed(
    matches: Matches, key: int, own: dict[int, tuple[Map, Map]], count: int, reach: int, config: FlowConfig
) -> tuple[Map, Map]:
    """Score and weight of a key frame with those of its neighbours followed to it: a surface has one label."""
    score, sure = own[key]
    total, weight = 2.0 * score * sure, 2.0 * sure
    for seen in neighbours(matches, key, count, config):
        if abs(seen.key - key) <= reach:
            score, sure = own[seen.key]
            share = sample(sure, seen.at) * seen.found
            total = total + share * sample(score, seen.at)
            weight = weight + share
    return total / np.maximum(weight, 1e-6), weight


def _between(
    clip: Clip, matches: Matches, picture: NDArray[np.uint8], key: int, final: dict[int, tuple[Map, Map]]
) -> tuple[Map, Map]:
    """Score and weight of a frame between key - 1 and key, by flow to both."""
    total = np.zeros(picture.shape, np.float32)[::2, ::2]
    weight = np.zeros_like(total)
    for other in (key - 1, key):
        at, found = matches.loose(picture, clip.picture(other))
        score, sure = final[other]
        share = sample(sure, at) * found
        total, weight = total + share * sample(score, at), weight + share
    return total / np.maximum(weight, 1e-6), weight


def _labels(clip: Clip, picture: NDArray[np.uint8], score: Map, weight: Map, config: FlowConfig) -> NDArray[np.uint8]:
    """The labels [H, W] of a frame's score and weight on the grid."""
    grey = cv2.resize(picture, score.shape[::-1], interpolation=cv2.INTER_AREA).astype(np.float32)
    spread = _Spread(grey, config.radius, config.edge)
    weight = np.minimum(weight, _ENOUGH)
    known = np.maximum(spread(weight), 0.0)
    score = spread(score * weight) / np.maximum(known, 1e-3)
    size = clip.width, clip.height
    score, known = (cv2.resize(p, size, interpolation=cv2.INTER_LINEAR) for p in (score, known))
    least = round((config.blob * clip.width / 640) ** 2)
    moving = _areas(score > config.grow, score > config.seed, least)
    moving = ~_areas(~moving, ~moving, least)
    unknown = known < _UNKNOWN
    unknown = _areas(unknown, unknown, least)
    return np.where(moving, np.uint8(255), np.where(unknown, np.uint8(128), np.uint8(0)))


def _areas(mask: Mask, seeds: Mask, least: int) -> Mask:
    """The connected areas of a mask that hold a seed and at least so many pixels."""
    count, numbers, about, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    keep = about[:, cv2.CC_STAT_AREA] >= least
    keep[0] = False
    seeded = np.zeros(count, bool)
    seeded[np.unique(np.asarray(numbers, np.int32)[seeds & mask])] = True
    return (keep & seeded)[np.asarray(numbers, np.int32)]


class _Spread:
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
