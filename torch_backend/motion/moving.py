"""Computes the motion mattes of a solved clip: scores key frames, averages scores along surfaces, and labels areas.

There are about ten key frames a second, more in a short clip. The frames between two keys take their scores from both
keys by flow. Frames are processed in a window of a few seconds, so memory does not grow with the clip.
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Collection, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..cameras.stored import load_cameras, load_points
from ..contract import Reporter
from ..footage import load_frames
from ..footage.images import read_frame
from ..sfm.masks import IGNORE, load_mask, painted_over
from ..shot import Shot
from .flow import FlowConfig, Map, Matches, neighbours, sample
from .misfit import MisfitConfig, Sight, misfit, seeded
from .residual_flow import ResidualFlow
from .still import Evidence, Look, StillTest, evidence
from .surface import KeyEvidence

_FLOW_WIDTH = 640
_LARGEST_SCALE = 2.0
_KEYS_PER_SECOND, _LEAST_KEYS = 10.0, 16
_LEAST_SIDE = 64
# Residual motion is computed in every second key frame, because sways are slow.
_LEFT_EVERY = 2
_ENOUGH, _UNKNOWN = 3.0, 0.1
"""Weight of a score at which it saturates, and weight below which a point is unknown."""
# Largest number of frames scored ahead of their labelling by the static model. At 640 x 480 they take 100 MB.
_PREFETCHED = 32


StaticViews = Callable[[int], NDArray[np.uint8] | None]
"""Maps a frame number to a render of the clip's static model from that frame's camera, [h, w, 3], or to None."""


class Clip:
    """Frames and cameras of a solved shot at the flow's resolution."""

    def __init__(self, shot: Shot) -> None:
        """Raises JobError if the shot is not solved."""
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
        """Indices of the key frames in `frames`."""
        viewmats = np.array([c.viewmat for c in path.frames], np.float64).reshape(-1, 4, 4)
        Ks = np.array([[[c.K[0], 0, c.K[2]], [0, c.K[1], c.K[3]], [0, 0, 1]] for c in path.frames], np.float64)
        Ks *= np.array([width / path.width, height / path.height, 1.0])[None, :, None]
        self.viewmats, self.Ks = viewmats[self.keys], Ks[self.keys]
        """Cameras of the keys: [K, 4, 4] world-to-camera, solve units, and [K, 3, 3] intrinsics in flow pixels."""
        self._cameras = viewmats, Ks
        self._guessed = [camera.source == "interpolated" for camera in path.frames]
        self.guessed = [self._guessed[i] for i in self.keys]
        """True for each key whose pose is interpolated."""
        points = load_points(shot)["xyz"].astype(np.float64)
        self.depths = [_typical_depth(points, viewmat) for viewmat in self.viewmats]
        """Median depth of the sparse points in front of each key's camera."""
        self._pictures: dict[int, tuple[NDArray[np.uint8], Sight]] = {}
        self._looks: dict[int, Look] = {}

    def picture(self, key: int) -> NDArray[np.uint8]:
        """Grey picture of a key at the flow's resolution. Raises JobError if the frame is damaged."""
        return self.shown(key)[0]

    def shown(self, key: int) -> tuple[NDArray[np.uint8], Sight]:
        """`frame` of a key, cached."""
        if key not in self._pictures:
            self._pictures[key] = self.frame(self.keys[key])
        return self._pictures[key]

    def look(self, key: int) -> Look:
        """Picture of a key prepared for comparison, cached."""
        if key not in self._looks:
            self._looks[key] = Look(self.picture(key))
        return self._looks[key]

    def frame(self, index: int) -> tuple[NDArray[np.uint8], Sight]:
        """(grey picture at the flow's resolution, colours on the grid with the camera) of any frame."""
        pixels = read_frame(self._shot.plate(self.frames[index]))
        pixels = pixels if pixels.dtype == np.uint8 else (pixels >> 8).astype(np.uint8)
        ignored = load_mask(self._shot, IGNORE, self.frames[index])
        if ignored is not None:
            # Otherwise optical flow would spread the stillness of a logo into its surroundings.
            pixels = painted_over(pixels, ignored)
        grey = _sized(np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), np.uint8), self.flow_size)
        colors = _sized(pixels, (self.flow_size[0] // 2, self.flow_size[1] // 2))
        return grey, Sight(colors, self._cameras[0][index], self._cameras[1][index])

    def references(self, count: int) -> dict[int, Sight]:
        """Up to `count` keys with solved poses, evenly spaced, as a map from key to frame."""
        solved = [key for key, guessed in enumerate(self.guessed) if not guessed]
        if not solved:
            return {}
        chosen = {solved[n * (len(solved) - 1) // (count - 1)] for n in range(count)}
        return {key: self.frame(self.keys[key])[1] for key in sorted(chosen)}

    def is_guessed(self, index: int) -> bool:
        """True if the pose of a frame is interpolated."""
        return self._guessed[index]

    def forget(self, before: int) -> None:
        """Drops the pictures of keys below `before`."""
        for store in (self._pictures, self._looks):
            for key in [key for key in store if key < before]:
                del store[key]


def _sized(pixels: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """A picture resized to `size`, area-averaged if it shrinks."""
    if pixels.shape[1::-1] == size:
        return pixels
    how = cv2.INTER_AREA if size[0] < pixels.shape[1] else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(pixels, size, interpolation=how), np.uint8)


def _keys(seconds: list[float]) -> list[int]:
    """Indices of the key frames: evenly spaced, including the first and the last frame."""
    step = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 0.0
    stride = round(1.0 / (_KEYS_PER_SECOND * step)) if step > 0 else 1
    stride = max(1, min(stride, len(seconds) // _LEAST_KEYS))
    return sorted({*range(0, len(seconds), stride), len(seconds) - 1})


def _typical_depth(points: NDArray[Any], viewmat: NDArray[Any]) -> float:
    """Median depth of the points [P, 3] in front of a camera [4, 4]; 1 if there are none."""
    z = points @ viewmat[2, :3] + viewmat[2, 3]
    z = z[z > 0]
    return float(np.median(z)) if len(z) else 1.0


@dataclass(frozen=True)
class Scored:
    """Motion scores of a frame from optical flow. Maps are [h, w] on the grid."""

    index: int
    """Index of the frame in `Clip.frames`."""
    picture: NDArray[np.uint8]
    """Grey picture at the flow's resolution."""
    sight: Sight
    score: Map
    """Confidence that a point moves, 0 to 1."""
    weight: Map
    """Amount of evidence behind the score."""
    inverse: Map
    """Inverse depths of still points, 1 / solve units."""
    grid: tuple[Map, Map]
    """Positions of the grid's points in flow pixels."""
    evidence: KeyEvidence | None
    """Evidence of a key frame with a solved pose; None for other frames."""


@contextlib.contextmanager
def prefetched_scores(
    clip: Clip, config: FlowConfig, written: Collection[int], report: Reporter
) -> Generator[Iterator[Scored]]:
    """Context of an iterator of `_scores` that a thread computes at most `_PREFETCHED` frames ahead of the consumer."""
    scores = _scores(clip, config, written, report)
    with ThreadPoolExecutor(1, "optical flow") as pool:
        waiting = deque(pool.submit(next, scores, None) for _ in range(_PREFETCHED))

        def results() -> Iterator[Scored]:
            while (scored := waiting.popleft().result()) is not None:
                waiting.append(pool.submit(next, scores, None))
                yield scored

        try:
            yield results()
        finally:
            pool.shutdown(cancel_futures=True)


def _scores(clip: Clip, config: FlowConfig, written: Collection[int], report: Reporter) -> Iterator[Scored]:
    """Scores of all frames that are not in `written`, in order."""
    keys, reach = clip.keys, config.reach * config.baselines[-1]
    groups = [range(keys[k - 1] + 1 if k else 0, keys[k] + 1) for k in range(len(keys))]
    needed = [any(n not in written for n in group) for group in groups]
    if not any(needed):
        return
    first, last = needed.index(True), len(needed) - 1 - needed[::-1].index(True)
    matches = Matches(clip.picture, config, clip.unit)
    scored: dict[int, tuple[Map, Map, Map]] = {}
    evidences: dict[int, KeyEvidence] = {}
    final: dict[int, tuple[Map, Map]] = {}
    start = max(0, first - 1 - reach)
    left: tuple[Map, Map] | None = None
    for turn in range(start - start % _LEFT_EVERY, last + reach + 1):
        report.check_cancelled()
        if turn < len(keys):
            left = None if turn % _LEFT_EVERY == 0 else left
            scored[turn], left, found = _key_score(clip, matches, turn, config, left)
            if not clip.guessed[turn]:
                evidences[turn] = KeyEvidence(found, matches.grid, clip.shown(turn)[1])
        key = turn - reach
        if key < max(0, first - 1) or not (needed[key] or needed[min(key + 1, last)]):
            continue
        final[key] = _followed(matches, key, scored, len(keys), reach, config)
        for n in groups[key] if needed[key] else ():
            if n not in written:
                is_key = n == keys[key]
                picture, sight = clip.shown(key) if is_key else clip.frame(n)
                if is_key:
                    score, inverse = final[key], scored[key][2]
                else:
                    score, inverse = _between(clip, matches, picture, key, final, scored)
                evidence = evidences.get(key) if is_key else None
                yield Scored(n, picture, sight, *score, inverse, matches.grid, evidence)
        for store in (scored, evidences, final):
            for old in [k for k in store if k < key - reach + 1]:
                del store[old]
        matches.forget(key - config.baselines[-1] + 1, key - config.links * config.baselines[-1])
        clip.forget(key - config.baselines[-1])


def _key_score(
    clip: Clip, matches: Matches, key: int, config: FlowConfig, before: tuple[Map, Map] | None
) -> tuple[tuple[Map, Map, Map], tuple[Map, Map], Evidence]:
    """((score, weight, inverse), (score, weight) of residual motion, evidence) of a key frame, as in `Scored`.

    `before` is the residual motion of the key before, which is then followed to this key; if None, it is computed.
    """
    seen = neighbours(matches, key, len(clip.keys), config)
    test = StillTest(clip.look, clip.viewmats, clip.Ks, clip.guessed, matches.grid, clip.unit)
    counts = evidence(test, key, seen, clip.depths[key], config)
    inverse, count = counts.inverse, counts.still + counts.moving
    score = np.clip(counts.moving / (count + config.doubt) / config.share, 0.0, 1.0)
    if before is None:
        left, known = ResidualFlow(clip.picture, test, config).score(key, len(clip.keys), inverse, clip.depths[key])
    else:
        last = next(each for each in seen if each.key == key - 1)
        left, known = (sample(values, last.at) * last.found for values in before)
    sure = np.minimum(count / config.sure, 1.0) * (count >= 1.0)
    scored = np.maximum(score, left), np.maximum(sure, known * (left > score)), inverse
    return scored, (left, known), counts


def _followed(
    matches: Matches, key: int, scored: dict[int, tuple[Map, Map, Map]], count: int, reach: int, config: FlowConfig
) -> tuple[Map, Map]:
    """Score and weight of a key frame, averaged with those of its neighbours so that a surface has one label."""
    score, sure, _ = scored[key]
    total, weight = 2.0 * score * sure, 2.0 * sure
    for seen in neighbours(matches, key, count, config):
        if abs(seen.key - key) <= reach:
            score, sure, _ = scored[seen.key]
            share = sample(sure, seen.at) * seen.found
            total = total + share * sample(score, seen.at)
            weight = weight + share
    return total / np.maximum(weight, 1e-6), weight


def _between(
    clip: Clip, matches: Matches, picture: NDArray[np.uint8], key: int, final: dict[int, tuple[Map, Map]],
    scored: dict[int, tuple[Map, Map, Map]],
) -> tuple[tuple[Map, Map], Map]:  # fmt: skip
    """((score, weight), inverse depths of still points) of a frame between `key` - 1 and `key`, by flow to both."""
    total = np.zeros(picture.shape, np.float32)[::2, ::2]
    weight, inverse, count = (np.zeros_like(total) for _ in range(3))
    for neighbour in (key - 1, key):
        at, found = matches.loose(picture, clip.picture(neighbour))
        score, sure = final[neighbour]
        share = sample(sure, at) * found
        total, weight = total + share * sample(score, at), weight + share
        # A small weight keeps a depth where neither key is matched.
        near = found + np.float32(1e-3)
        inverse, count = inverse + near * sample(scored[neighbour][2], at), count + near
    return (total / np.maximum(weight, 1e-6), weight), inverse / count


class Labels:
    """Labels frames by their scores and, if available, by renders of a static model of the clip."""

    def __init__(self, clip: Clip, static: StaticViews | None, config: FlowConfig) -> None:
        self._clip, self._static, self._config, self._misfit_config = clip, static, config, MisfitConfig()
        self._references = {} if static is None else clip.references(self._misfit_config.references)

    def __call__(self, frame: Scored) -> NDArray[np.uint8]:
        """[H, W] 0 still, 128 unknown, 255 moving."""
        config, limits, size = self._config, self._misfit_config, (self._clip.width, self._clip.height)
        grey = cv2.resize(frame.picture, frame.score.shape[::-1], interpolation=cv2.INTER_AREA).astype(np.float32)
        spread = _Spread(grey, config.radius, config.edge)
        weight = np.minimum(frame.weight, _ENOUGH)
        known = np.maximum(spread(weight), 0.0)
        score = spread(frame.score * weight) / np.maximum(known, 1e-3)
        maps = score, known, self._misfit(frame)
        score, known, difference = (cv2.resize(p, size, interpolation=cv2.INTER_LINEAR) for p in maps)
        least = round((config.blob * self._clip.width / 640) ** 2)
        moving = seeded(score > config.grow, score > config.seed, least)
        moving |= seeded(difference > limits.weak, difference > limits.strong, least)
        still = seeded(~moving, ~moving, least)  # fills small holes of moving areas
        unknown = known < _UNKNOWN
        unknown = seeded(unknown, unknown, least)
        return np.where(~still, np.uint8(255), np.where(unknown, np.uint8(128), np.uint8(0)))

    def _misfit(self, frame: Scored) -> Map:
        """`misfit` of a frame on the grid; 0 without a static model or with an interpolated pose."""
        clip = self._clip
        shown = None
        if self._static is not None and not clip.is_guessed(frame.index):
            shown = self._static(clip.frames[frame.index])
        if shown is None:
            return np.zeros(frame.inverse.shape, np.float32)
        shown = _sized(shown, (clip.flow_size[0] // 2, clip.flow_size[1] // 2))
        # Without the frame itself, which shows its own movers.
        views = [view for key, view in self._references.items() if clip.keys[key] != frame.index]
        return misfit(frame.sight, frame.inverse, shown, views, frame.grid, 0.5 * clip.unit, self._misfit_config)


class _Spread:
    """Smooths values within the areas of a picture, stopping at its edges: a grey guided filter (He 2010)."""

    def __init__(self, picture: Map, radius: int, edge: float) -> None:
        """`picture` is the guide, [h, w], 0 to 255; differences below `edge` do not count as edges."""
        self._size = (2 * radius + 1, 2 * radius + 1)
        self._picture = picture
        self._mean = self._blur(picture)
        self._variance = self._blur(picture * picture) - self._mean**2 + np.float32(edge * edge)

    def _blur(self, values: Map) -> Map:
        return cv2.blur(values, self._size, borderType=cv2.BORDER_REFLECT)

    def __call__(self, values: Map) -> Map:
        """Smoothed `values`, [h, w]."""
        mean = self._blur(values)
        slope = (self._blur(values * self._picture) - mean * self._mean) / self._variance
        level = mean - slope * self._mean
        return self._blur(slope) * self._picture + self._blur(level)
