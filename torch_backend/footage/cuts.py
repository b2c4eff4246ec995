"""Detects transitions between takes in a clip: hard cuts, dissolves, wipes, fades through black or white.

Hard cut: two sharp neighbouring frames share almost no features, while each shares many with its other neighbour.
Dissolve or wipe: frame m shares features with both m - L and m + L, but these two share none with each other. Within
one take they would overlap.

All thresholds are relative to the features that neighbours share, so that noise, blur and darkness have no effect. A
flash, a passer-by or a whip pan is no cut: the frames before and after match, or the frames between are smeared.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .continuity import Features, Link, link, sure_features

SUSPICIOUS = 0.35
"""SIFT features decide if the overlap of two frames by quick features, relative to their neighbours, is below this."""
DIFFERENT_SCENES = 0.13
"""Largest overlap of different scenes by SIFT features, relative to the overlap of neighbouring frames.
Measured: 0.20 to 1.5 in the fastest parts of three handheld clips, darkened, noisy, flickering and blurred. 0.01 to
0.083 at cuts, including cuts to mirrored pictures and to other views of one room."""
# Minimum number of SIFT features that neighbours share, for a decision.
_LEAST_LEVEL = 20
# Minimum share of quick features in common with a neighbour. Noise, flashes and smeared frames have fewer.
_LINKED = 0.15
# Ratio of a frame's sharpness to the median of its take, below which the frame is smeared.
_SHARP = 0.4
# Number of frames for the median sharpness of a take.
_WINDOW = 8
# Minimum number of frames for the median sharpness of a take.
_LEAST_TAKE = 3
# Share of quick features that unrelated pictures may have in common, with a margin: measured up to 0.04.
_UNRELATED = 0.06
# Largest shift of the picture, as a share of its width, at which two frames around a third one must overlap.
_NEAR = 0.2
# Largest ratio for a wipe: matches between the frames before and after, over the fewer of the mixed frame's matches
# with either. Measured: 0.04 and 0.05; 0.15 if somebody walks past, 0.29 and more in handheld clips with noise.
_WIPED = 0.1
# The limit of `_WIPED` for a dissolve, which has uncertain matches but must also be a sum of the two pictures.
_MIXED = 0.4
# Minimum number of SIFT features to align the two pictures of a dissolve with the frame between.
_LEAST_COMMON = 10
# Minimum share of a dissolved frame's variance that the sum of the two pictures explains.
_EXPLAINED = 0.85
# Minimum factor by which the sum reduces the residual of either picture alone. Measured: 2.2 to 8 in dissolves over 4
# to 30 frames; often more within one take, see `_SAME_SCENE`.
_GAINED = 2.2
# Correlation of the two aligned pictures above which they show the same scene. Measured: 0.41 to 0.55 in dissolves,
# 0.74 and more within one take, where the mean of two neighbours also explains the frame between.
_SAME_SCENE = 0.65
# Minimum weight of either picture in the sum. The weights add up to about 1.
_LEAST_PART = 0.25
# Minimum difference in stops between the darkest or brightest frame of a fade and both takes.
_FADED_STOPS = 2.0
# Minimum change in stops from one frame of a fade to the next.
_FADING = 0.1


@dataclass(frozen=True)
class Transition:
    """A transition between two takes."""

    kind: str
    """hard cut, dissolve, fade, or `wipe or dissolve`."""
    before: int
    """Index of a frame that still shows only the first take."""
    after: int
    """Index of a frame that shows only the second take."""


class Frames:
    """Pairwise comparison of the frames of a clip. Caches all results."""

    def __init__(
        self, quick: Sequence[Features], exposure: Sequence[float], picture: Callable[[int], NDArray[np.uint8]]
    ) -> None:
        """Args:
        quick: quick features of each frame.
        exposure: exposure of each frame, stops.
        picture: returns the grey picture of a frame by its index, as `continuity.small_grey` does.
        """
        self.quick, self.exposure, self.picture = quick, exposure, picture
        self._links: dict[tuple[int, int], Link] = {}
        self._sure: dict[int, Features] = {}
        self._sure_links: dict[tuple[int, int], Link] = {}

    def share(self, a: int, b: int) -> float:
        """Share of quick features in common between two frames."""
        return self.linked(a, b).share

    def linked(self, a: int, b: int) -> Link:
        """Overlap of two frames by quick (ORB) features."""
        if (a, b) not in self._links:
            self._links[a, b] = link(self.quick[a], self.quick[b])
        return self._links[a, b]

    def sure(self, a: int, b: int) -> Link:
        """Overlap of two frames by sure (SIFT) features."""
        for index in (a, b):
            if index not in self._sure:
                self._sure[index] = sure_features(self.picture(index))
        if (a, b) not in self._sure_links:
            self._sure_links[a, b] = link(self._sure[a], self._sure[b])
        return self._sure_links[a, b]

    def forget(self, before: int) -> None:
        """Frees the cached SIFT features of frames before an index."""
        self._sure = {index: kept for index, kept in self._sure.items() if index >= before}


def find_transitions(frames: Frames, usable: Sequence[int]) -> list[Transition]:
    """All transitions, in order. `usable` are the indices of frames without flags (blank, duplicate, corrupt)."""
    shown = [i for i in usable if frames.quick[i].is_sufficient]
    ends = (shown[:1], shown[-1:])

    def is_linked(n: int) -> bool:
        # Noise in black, flashes and smeared frames match no neighbour.
        near = [pair for pair in (shown[max(0, n - 1) : n + 1], shown[n : n + 2]) if len(pair) == 2]
        return max((frames.share(*pair) for pair in near), default=0.0) >= _LINKED

    # The first and the last frame may be the rest of another take, so they always stay.
    shown = [i for n, i in enumerate(shown) if [i] in ends or is_linked(n)]
    found = _breaks(frames, shown)
    return sorted([*found, *_mixtures(frames, shown, found)], key=lambda one: one.before)


def _breaks(frames: Frames, shown: list[int]) -> list[Transition]:
    """Hard cuts and fades: neighbouring frames with enough features but without overlap."""
    found: list[Transition] = []
    for n in range(len(shown) - 1):
        before, after = shown[max(0, n - 2) : n + 1], shown[n + 1 : n + 4]
        inner = [pair for pair in ((before[-2:]), (after[:2])) if len(pair) == 2]
        level = min((frames.share(*pair) for pair in inner), default=0.0)
        if frames.share(before[-1], after[0]) >= SUSPICIOUS * level or level < _LINKED:
            continue
        sure_level = min(frames.sure(*pair).count for pair in inner)
        if sure_level < _LEAST_LEVEL or any(
            frames.sure(a, b).count > DIFFERENT_SCENES * sure_level for a in before for b in after
        ):
            continue
        if any(frames.sure(*pair).shift > _NEAR for pair in inner):
            continue  # whip pan: even the next frame of the same take may show another place
        if not (_is_sharp(frames, shown, n, -1) and _is_sharp(frames, shown, n + 1, 1)):
            continue
        frames.forget(before[0])
        faded = _faded(frames, before[-1], after[0])
        if faded is not None:
            found.append(faded)
        elif after[0] == before[-1] + 1 or _is_plain_gap(frames, before[-1], after[0]):
            found.append(Transition("hard cut", before[-1], after[0]))
    return found


def _is_sharp(frames: Frames, shown: list[int], n: int, way: int) -> bool:
    """True if a frame is as sharp as its take, which lies before it (`way` -1) or after it (1)."""
    take = shown[max(0, n - _WINDOW) : n + 1] if way < 0 else shown[n : n + _WINDOW + 1]
    if len(take) < _LEAST_TAKE:  # a few frames at the clip's end may all be smeared: use both sides
        take = shown[max(0, n - _WINDOW) : n + _WINDOW + 1]
    usual = float(np.median([frames.quick[i].sharpness for i in take]))
    return frames.quick[shown[n]].sharpness >= _SHARP * usual


def _is_plain_gap(frames: Frames, before: int, after: int) -> bool:
    """True if all frames between two takes are blank. The smeared frames of a whip pan are not."""
    return not any(frames.quick[i].is_sufficient for i in range(before + 1, after))


def _faded(frames: Frames, before: int, after: int) -> Transition | None:
    """The fade between two takes, extended to the frames with the full exposure; None if there is no fade."""
    light = frames.exposure
    between = light[before : after + 1]
    first, last = before, after
    for sign, end in ((-1.0, min(between)), (1.0, max(between))):
        while first > 0 and sign * (light[first] - light[first - 1]) > _FADING:
            first -= 1
        while last < len(light) - 1 and sign * (light[last] - light[last + 1]) > _FADING:
            last += 1
        if all(sign * (end - light[i]) > _FADED_STOPS for i in (first, last)):
            return Transition("fade", first, last)
    return None


def _mixtures(frames: Frames, shown: list[int], known: list[Transition]) -> list[Transition]:
    """Dissolves and wipes: a frame that overlaps with two others, which do not overlap with each other."""
    found: list[Transition] = []
    reach = 2
    while 2 * reach < len(shown):
        for n in range(reach, len(shown) - reach, max(1, reach // 2)):
            a, m, b = shown[n - reach], shown[n], shown[n + reach]
            if not any(one.before < b and a < one.after for one in [*known, *found]):
                kind = _mixed(frames, a, m, b)
                if kind == "dissolve":  # the neighbours may be slightly mixed, too
                    a, b = shown[max(0, n - 2 * reach)], shown[min(len(shown) - 1, n + 2 * reach)]
                if kind:
                    found.append(Transition(kind, a, b))
        reach *= 2
    return found


def _mixed(frames: Frames, a: int, m: int, b: int) -> str:
    """Kind of transition ("dissolve", "wipe or dissolve") if frame `m` mixes the takes of `a` and `b`; else empty."""
    quick = frames.share(a, m), frames.share(m, b)
    if frames.share(a, b) > _UNRELATED or max(quick) < _UNRELATED:
        return ""
    left, right = frames.sure(a, m), frames.sure(b, m)
    level, across = min(left.count, right.count), frames.sure(a, b).count
    if level < _LEAST_COMMON or max(left.shift, right.shift) > _NEAR:
        return ""
    if level >= 2 * _LEAST_LEVEL and across <= _WIPED * level:
        return "dissolve" if _is_sum(frames, left, m, right, a, b) else "wipe or dissolve"
    return "dissolve" if across <= _MIXED * level and _is_sum(frames, left, m, right, a, b) else ""


def _is_sum(frames: Frames, left: Link, m: int, right: Link, a: int, b: int) -> bool:
    """True if frame `m` is a weighted sum of frames `a` and `b`, aligned with it by their common features."""
    target = _soft(frames.picture(m))
    size = (target.shape[1], target.shape[0])
    laid = [
        np.asarray(cv2.warpPerspective(_soft(frames.picture(i)), side.homography, size, borderValue=-1.0), np.float32)
        for i, side in ((a, left), (b, right))
    ]
    covered = (laid[0] >= 0.0) & (laid[1] >= 0.0)
    if covered.mean() < 0.5 or target[covered].var() == 0.0:
        return False
    first, second, values = laid[0][covered], laid[1][covered], target[covered]
    if not np.corrcoef(first, second)[0, 1] <= _SAME_SCENE:
        return False

    def fitted(*columns: NDArray[np.float32]) -> tuple[float, NDArray[np.float64]]:
        basis = np.stack([*columns, np.ones_like(values)], axis=1)
        weights = np.asarray(np.linalg.lstsq(basis, values, rcond=None)[0], np.float64)
        return float(np.square(values - basis @ weights).mean() / values.var()), weights

    unexplained, weights = fitted(first, second)
    single = min(fitted(first)[0], fitted(second)[0])
    parts = float(weights[0]), float(weights[1])
    return (
        unexplained <= 1.0 - _EXPLAINED
        and single >= _GAINED * unexplained
        and min(parts) >= _LEAST_PART
        and 0.75 <= sum(parts) <= 1.25
    )


def _soft(picture: NDArray[np.uint8]) -> NDArray[np.float32]:
    """A grey picture blurred to tolerate an alignment error of a pixel."""
    return np.asarray(cv2.GaussianBlur(picture.astype(np.float32), (0, 0), 3.0), np.float32)
