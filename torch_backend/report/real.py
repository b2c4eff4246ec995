"""The truth in a real clip: where nothing moves, the plate at pose n shows what the frozen shot must show at pose n,
whatever t* is. Here is told where nothing moves: where optical flow stays on its epipolar lines through the clip.

A surface that moves exactly along its epipolar lines looks like one at another depth, and is not told from it.
"""

# Packages of requirements/bench.txt may be absent; each use says what to do then.
# pyright: reportMissingImports=false

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_MINIMUM_TRAVEL = 0.02
"""Pairs whose cameras are nearer than this share of the clip's travel say nothing: every match is on every line."""


@dataclass
class RigidConfig:
    """What counts as rigid. Lengths are in pixels of the plates."""

    baselines: tuple[int, ...] = (1, 2, 4)
    """A frame is compared with those this many keyframes before and after."""
    keyframes: int = 40
    """Frames of the clip that are looked at, evenly spaced; the frames asked for are among them."""
    tolerance: float = 2.0
    """Greatest distance of a match from its epipolar line, of plates 640 wide: flow and solve err by 0.5 to 1 each."""
    round_trip: float = 1.0
    """Greatest distance between a pixel and where the flow there and back ends; above it the pixel is hidden there."""
    least: int = 2
    """In fewer neighbours found: nothing is known of a pixel. In as many of them off its line: it moves."""
    blob: int = 5
    """Moving spots narrower than this are noise of the flow; what is left is widened by as much."""


def rigid_mask(
    plates: NDArray[np.uint8],
    viewmats: NDArray[np.floating],
    Ks: NDArray[np.floating],
    wanted: Sequence[int] | None = None,
    config: RigidConfig | None = None,
) -> NDArray[np.bool_]:
    """Which pixels belong to what never moves, bool [wanted, H, W]; all F frames if `wanted` is None.

    A pixel is rigid if it is found (flow there and back agrees) in at least `least` neighbours, lies on its epipolar
    line in all of them but one, and nothing that moved at another time has been followed to it.

    Args:
        plates: [F, H, W, 3] uint8, undistorted.
        viewmats: [F, 4, 4] world-to-camera, OpenCV.
        Ks: [F, 3, 3] in pixels of the plates, pixel centres at +0.5.
        wanted: frames to return, indices into F.

    ModuleNotFoundError without opencv (requirements/bench.txt); ValueError if the arrays do not fit.
    """
    if importlib.util.find_spec("cv2") is None:
        raise ModuleNotFoundError("scores on real clips need opencv-python-headless (requirements/bench.txt)")
    if plates.ndim != 4 or plates.dtype != np.uint8 or not len(plates) == len(viewmats) == len(Ks):
        raise ValueError(f"plates {plates.shape} {plates.dtype}, viewmats {viewmats.shape}, Ks {Ks.shape} do not fit")
    config = config or RigidConfig()
    wanted = list(range(len(plates))) if wanted is None else list(wanted)
    spaced = np.linspace(0, len(plates) - 1, min(config.keyframes, len(plates))).round().astype(int)
    keys = sorted({*spaced.tolist(), *wanted})
    flows = _Flows(plates, config.round_trip)
    centres = -np.einsum("nji,nj->ni", viewmats[:, :3, :3], viewmats[:, :3, 3])
    travel = float(np.linalg.norm(centres - centres.mean(0), axis=1).max())
    moving, known = [], []
    for n, key in enumerate(keys):
        on, off = np.zeros(plates.shape[1:3], np.int32), np.zeros(plates.shape[1:3], np.int32)
        for other in [keys[m] for b in config.baselines for m in (n - b, n + b) if 0 <= m < len(keys)]:
            if np.linalg.norm(centres[key] - centres[other]) < _MINIMUM_TRAVEL * travel:
                continue
            there, found = flows.match(key, other)
            distance = epipolar_distance(there, viewmats[key], viewmats[other], Ks[key], Ks[other])
            on += found & (distance <= config.tolerance)
            off += found & (distance > config.tolerance)
        moving.append(_opened(off >= config.least, config.blob))
        known.append(on + off >= config.least)
    moving = _followed(moving, keys, flows)
    place = {key: n for n, key in enumerate(keys)}
    return np.array([known[place[w]] & ~_widened(moving[place[w]], config.blob) for w in wanted])


def epipolar_distance(
    matches: NDArray[np.floating], from_view: NDArray, to_view: NDArray, from_K: NDArray, to_K: NDArray
) -> NDArray[np.float64]:
    """Distance in pixels of matches [H, W, 2] (x, y of each pixel's place in the other view) from epipolar lines.

    Pixel centres are at +0.5. Near the epipole, where a line is a point, it is the distance from that point.
    """
    height, width = matches.shape[:2]
    y, x = np.mgrid[0.5:height, 0.5:width]
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(from_K.astype(np.float64)).T
    motion = to_view.astype(np.float64) @ np.linalg.inv(from_view.astype(np.float64))
    # A pixel at infinite depth, and the epipole: the line goes through both.
    far = rays @ (to_K.astype(np.float64) @ motion[:3, :3]).T
    epipole = to_K.astype(np.float64) @ motion[:3, 3]
    lines = np.cross(far, np.broadcast_to(epipole, far.shape))
    norm = np.linalg.norm(lines[..., :2], axis=-1)
    points = np.concatenate([matches.astype(np.float64), np.ones((height, width, 1))], -1)
    return np.abs((points * lines).sum(-1)) / np.maximum(norm, 1e-12 * np.abs(lines).max())


class _Flows:
    """Dense matches between plates, each pair computed once."""

    def __init__(self, plates: NDArray[np.uint8], round_trip: float) -> None:
        import cv2

        self._cv2, self._round_trip = cv2, round_trip
        self._grey = [cv2.cvtColor(plate, cv2.COLOR_RGB2GRAY) for plate in plates]
        self._dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        self._flows: dict[tuple[int, int], NDArray[np.float32]] = {}
        height, width = plates.shape[1:3]
        self._grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(np.float32)

    def flow(self, a: int, b: int) -> NDArray[np.float32]:
        """[H, W, 2] from pixels of a to their places in b, less the pixels."""
        if (a, b) not in self._flows:
            self._flows[a, b] = self._dis.calc(self._grey[a], self._grey[b], None)  # type: ignore[call-overload]
        return self._flows[a, b]

    def match(self, a: int, b: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Places in b of a's pixels [H, W, 2] (centres at +0.5), and which are found: inside, and back again."""
        there = self._grid + self.flow(a, b)
        back = self.sample(self.flow(b, a), there)
        inside = (there >= 0).all(-1) & (there <= self._grid[-1, -1]).all(-1)
        return there + 0.5, inside & (np.linalg.norm(there + back - self._grid, axis=-1) <= self._round_trip)

    def sample(self, values: NDArray[np.float32], at: NDArray[np.float32]) -> NDArray[np.float32]:
        """`values` of [H, W, C] at places [H, W, 2] (centres at whole numbers), bilinear; 0 outside."""
        return self._cv2.remap(values, at, None, self._cv2.INTER_LINEAR)  # type: ignore[call-overload]


def _followed(moving: list[NDArray[np.bool_]], keys: list[int], flows: _Flows) -> list[NDArray[np.bool_]]:
    """What moves at one time, followed to all others by the flow between neighbouring keyframes."""
    result = [mask.copy() for mask in moving]
    for order in (range(1, len(keys)), range(len(keys) - 2, -1, -1)):
        step = -1 if order.step > 0 else 1
        carried = moving[order[0] + step] if len(order) else None
        for n in order:
            assert carried is not None
            there, found = flows.match(keys[n], keys[n + step])
            before = flows.sample(carried.astype(np.float32), there - 0.5) > 0.5
            carried = moving[n] | (before & found)
            result[n] |= carried
    return result


def _opened(mask: NDArray[np.bool_], blob: int) -> NDArray[np.bool_]:
    """Without spots narrower than `blob` pixels."""
    import cv2

    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((blob, blob), np.uint8)) > 0


def _widened(mask: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    """With a margin of `by` pixels."""
    import cv2

    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * by + 1, 2 * by + 1), np.uint8)) > 0


def far_from(poses: Sequence[int], t_star: int, frames: int) -> list[int]:
    """The poses that test a freeze at t*: more than a quarter of the clip's `frames` away (frame numbers alike)."""
    return [pose for pose in poses if abs(pose - t_star) > frames / 4]
