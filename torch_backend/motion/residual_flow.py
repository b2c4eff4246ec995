"""Residual flow: detects sways that are too slow or too small to separate from the noise of a match.

Another key frame is warped onto a key frame by the depth of still points. Still surfaces then coincide, and the
residual flow is several times more precise than a match over the whole distance. Depths are fitted again to these
matches. Residual flow that no depth explains is motion, if the pictures confirm it. The two frames are 0.4 to 1.6
seconds apart (`FlowConfig.spans`), because the displacement of a sway grows with time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..array_types import linear_solution
from .flow import FlowConfig, Map, Mask, Seen, dense_flow, sample
from .still import FEW, Look, Pair, StillTest, Texture, brightness, inside, outlines, still_points

_FINEST, _STRIDE, _DESCENTS, _REFINEMENTS = 1, 4, 16, 2
"""Settings of DIS: finest scale is half the pictures' resolution, patches every fourth pixel."""
_SPARSE, _TURNS = 4, 6
"""Stride of the points to which the drift is fitted, and iterations of that reweighted fit."""
# Upper limit of inverse depth relative to its median; the drift fit clamps nearer points.
_NEAREST = 5.0
# Squared picture difference below the noise of any camera; added to ratios to keep them finite.
_FLOOR = 2.0


@dataclass
class _Laid:
    """A key frame and another key frame that was warped onto it."""

    pair: Pair
    """The two frames. `Pair.weight` is the similarity of the pictures at the match."""
    gained: Map
    """[h, w] 0..1: how strongly the pictures favour the match over the still point."""
    visible: float
    """Noise of the pair as a squared picture difference; a larger change is visible."""


class ResidualFlow:
    """Motion of objects in key frames after camera motion is removed."""

    def __init__(self, picture: Callable[[int], NDArray[np.uint8]], test: StillTest, config: FlowConfig) -> None:
        """`picture` returns key k as in `flow.Matches`."""
        self._picture, self._test, self._config = picture, test, config
        self._dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        self._dis.setFinestScale(_FINEST)
        self._dis.setPatchStride(_STRIDE)
        self._dis.setGradientDescentIterations(_DESCENTS)
        self._dis.setVariationalRefinementIterations(_REFINEMENTS)

    def score(self, key: int, count: int, inverse: Map, depth: float) -> tuple[Map, Map]:
        """(score, weight), [h, w] float32: confidence that a key's points move, 0 to 1, and its amount of evidence.

        Keys are 0 to `count` - 1. `inverse` are inverse depths of still points in 1 / solve units, `depth` is a typical
        depth in solve units.
        """
        config = self._config
        look = self._test.look(key)
        texture = Texture(look.grid, self._test.unit, config)
        keys = [key + side * step for side in (-1, 1) for step in config.spans if 0 <= key + side * step < count]
        laid = [
            self._laid(key, neighbour, inverse, look, texture)
            for neighbour in keys
            if not self._guessed(key, neighbour)
        ]
        if len(laid) < 2:
            return np.zeros_like(inverse), np.zeros_like(inverse)
        pairs = [each.pair for each in laid]
        inverse = still_points(pairs, inverse, depth, self._test.unit, turns=3)
        evidence: list[Map] = []
        known = np.zeros_like(inverse)
        for each in laid:
            _, x, y, length = each.pair.miss(inverse)
            limit = self._limit(length, (each.pair.weight > 0.5) & texture.telling)
            seen = np.minimum(texture.change(x, y, length) / each.visible, 1.0)
            evidence.append(np.minimum(length / limit, config.most) * seen * each.gained * each.pair.weight)
            known += each.pair.weight
        second = np.partition(np.stack(evidence), -2, axis=0)[-2]  # the largest alone may be an occlusion
        faint = config.faint
        score = (second / (1.0 + config.rim * outlines(inverse)) - faint) / (config.clear - faint)
        return np.clip(score, 0.0, 1.0), np.minimum(known, 1.0)

    def _guessed(self, key: int, neighbour: int) -> bool:
        return self._test.guessed[key] or self._test.guessed[neighbour]

    def _limit(self, length: Map, telling: Mask) -> float:
        """Unit of residual flow: the distance that may show motion, from the median of the matches."""
        least = self._config.least * self._test.unit
        noise = float(np.median(length[telling])) if np.count_nonzero(telling) >= FEW else 0.0
        return float(np.clip(self._config.unusual * noise, least, self._config.most_left * least))

    def _left(self, key: int, neighbour: int, at: tuple[Map, Map], within: Mask) -> Map:
        """[h, w, 2] flow from a key frame to `neighbour` warped onto it. `at` are the key's still points in it."""
        one = self._picture(key)
        x, y = (cv2.resize(p, one.shape[::-1], interpolation=cv2.INTER_LINEAR) - np.float32(0.5) for p in at)
        brought = cv2.remap(self._picture(neighbour), x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        # Pixels outside the other picture are filled from this picture, so that their flow is zero.
        outside = cv2.resize((~within).astype(np.uint8), one.shape[::-1], interpolation=cv2.INTER_NEAREST)
        cv2.copyTo(one, outside, brought)
        flow = np.nan_to_num(dense_flow(self._dis, one, brought))
        return np.asarray(cv2.resize(flow, within.shape[::-1], interpolation=cv2.INTER_AREA), np.float32)

    def _laid(self, key: int, neighbour: int, inverse: Map, look: Look, texture: Texture) -> _Laid:
        """Key frame `neighbour` warped onto `key` by inverse depths, with their residual flow."""
        test = self._test
        pair = Pair.between(test, key, Seen(neighbour, test.grid, np.zeros(inverse.shape, bool), 1), self._config)
        at, _ = pair.ray.project(inverse)
        within = inside(at, inverse.shape)
        left = self._left(key, neighbour, at, within)
        moved = test.grid[0] + left[..., 0], test.grid[1] + left[..., 1]
        match = sample(at[0], moved), sample(at[1], moved)
        residual = [match[i] - at[i] for i in (0, 1)]
        drift = _drift(residual, within & texture.telling, inverse, self._config.least * test.unit)
        pair.gain = brightness(look.grid, sample(pair.neighbour.grid, match), within)
        still, found = (pair.neighbour.difference(look.grid, place, pair.gain) for place in (at, match))
        sharp = within & texture.telling
        usual = float(np.median(found[sharp])) if np.count_nonzero(sharp) >= FEW else 0.0
        likeness = within / (1.0 + found / (4.0 * usual + 8.0 * _FLOOR))
        gained = (still - found) / (found + usual + _FLOOR) / self._config.bearing
        pair.seen = Seen(neighbour, (match[0] - drift[0], match[1] - drift[1]), within, 1)
        pair.weight = likeness.astype(np.float32)
        noise = float(np.quantile(found[within], 0.3)) if np.count_nonzero(within) >= FEW else 0.0
        least, most = self._config.visible
        return _Laid(pair, np.clip(gained, 0.0, 1.0), min(max(noise, least**2), most**2))


def _drift(left: list[Map], telling: Mask, inverse: Map, unit: float) -> list[Map]:
    """Smooth error of x and y over the picture, [h, w] each, caused by a poor pose, a rolling shutter or the lens.

    The model is a second-order polynomial, plus a term in inverse depth for an error of the camera's position. It is
    fitted robustly to the residual flow `left` at the pixels `telling`.
    """
    height, width = telling.shape
    y, x = np.mgrid[-1.0 : 1.0 : height * 1j, -1.0 : 1.0 : width * 1j].astype(np.float32)
    few = telling[::_SPARSE, ::_SPARSE]
    if np.count_nonzero(few) < FEW:
        return [np.zeros_like(part) for part in left]
    near = np.minimum(inverse / max(float(np.median(inverse[telling])), 1e-9), _NEAREST).astype(np.float32)
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y, near], axis=-1)
    design = terms[::_SPARSE, ::_SPARSE][few].astype(np.float64)
    target = np.stack([part[::_SPARSE, ::_SPARSE][few] for part in left], axis=-1).astype(np.float64)
    count = design.shape[1]
    found = np.zeros((count, 2))
    found[0] = np.median(target, axis=0)
    for _ in range(_TURNS):
        gap = np.sum((target - design @ found) ** 2, axis=1)
        # Robust weights: movers are local, so they stay in the residual.
        weight = 1.0 / np.square(1.0 + gap / max(unit**2, float(np.median(gap))))
        normal = design.T @ (design * weight[:, None]) + 1e-3 * len(design) * np.eye(count)
        found = linear_solution(normal, design.T @ (target * weight[:, None]))
    return [(terms @ found[:, i].astype(np.float32)) for i in (0, 1)]
