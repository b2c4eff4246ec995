"""Where a small thing that swings was at t*: it is followed through the clip, and its swing is triangulated.

One view more of a thing that moves by itself tells nothing of its depth: each frame brings two positions on the picture
and three unknowns in space. What swings on a thread repeats itself: a place, a drift, and a turn with its double (the
rise at both ends) are 18 numbers for all frames, linear but for the frequency, which is tried. That needs about a
whole turn and a camera that moves; how well the frames determine the place at t* comes with it. (Compare Park 2010,
"3D reconstruction of a moving point from a series of 2D projections".)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .instant_depth import View

_TURNS = 6
"""So often sightings that do not fit are weighed less."""
_AROUND = 8
"""So many sightings around one tell where it should be."""


@dataclass
class TrackConfig:
    """What is followed. Lengths are in pixels of pictures 320 wide."""

    reach: int = 48
    """Frames before and after t* in which a thing is looked for."""
    largest: float = 32.0
    """A thing with longer sides is none that is followed."""
    alike: float = 0.12
    """A thing has to be this far from what the render shows (display-referred, root mean square)."""
    same: float = 0.2
    """Colours less far apart than this may be the same thing's."""
    gate: float = 3.0
    """A thing is looked for within so many times its size of where it should be, and farther after frames without."""
    most: int = 4
    """So many things are followed at most, the largest."""
    lost: int = 8
    """It is given up after so many frames without."""
    least: int = 14
    """As many sightings make a track."""
    turn: float = 0.8
    """And so much of a whole swing."""
    residual: float = 0.5
    """Median distance of sightings from a swing that explains them, at most."""
    unsure: float = 0.05
    """Standard deviation of the depth at t*, as a share of it, at most."""
    slowest: float = 0.06
    """Radians per frame; slower ones pass for a drift."""
    fastest: float = 1.0
    """Radians per frame."""


@dataclass
class Track:
    """A thing's way over the picture."""

    pixels: NDArray[np.bool_]
    """[h, w] at t*."""
    color: NDArray[np.float32]
    """[3] display-referred."""
    at: dict[int, NDArray[np.float64]]
    """Frame index -> its centre there, [2], pixels."""


@dataclass
class Swing:
    """What a track tells."""

    place: NDArray[np.float64]
    """[3] at t*, world, scene units."""
    depth: float
    """Along the axis of camera t*."""
    deviation: float
    """Standard deviation of the depth, as a share of it."""
    residual: float
    """Median distance of the sightings from the swing, pixels."""


Frames = Callable[[int], "tuple[View, NDArray[np.bool_]] | None"]
"""Frame index -> its view and what moves in it [h, w]; None if there is no such frame or nobody has looked."""


def tracks(frames: Frames, index: int, shown: NDArray[np.float32], config: TrackConfig, unit: float) -> list[Track]:
    """Small things that move at t* and that a render does not show, followed through the clip.

    Args:
        index: of t* among the frames.
        shown: [h, w, 3] render of the scene frozen at t*, from camera t*.
        unit: pixels per pixel of a picture 320 wide.
    """
    start = frames(index)
    if start is None:
        return []
    view, moving = start
    sighted: list[Track | None] = []
    for mask in _small(moving, config.largest * unit):
        apart = np.sqrt(np.square(view.picture - shown).mean(-1))
        core = mask & (apart > config.alike)
        if core.sum() >= 3:
            color = np.median(view.picture[core], axis=0).astype(np.float32)
            sighted.append(_core(view, mask, color, config))
    found = sorted((track for track in sighted if track is not None), key=lambda t: -float(t.pixels.sum()))[
        : config.most
    ]
    for side in (-1, 1):
        open_ends = [_End(track, float(track.pixels.sum())) for track in found]
        for step in range(1, config.reach + 1):
            sighting = frames(index + side * step) if open_ends else None
            if sighting is None:
                break
            for end in open_ends:
                _follow(end, index + side * step, side, *sighting, config)
            open_ends = [end for end in open_ends if end.lost < config.lost]
    return found


def _small(moving: NDArray[np.bool_], largest: float) -> list[NDArray[np.bool_]]:
    """The connected parts of a mask that are no longer and no wider than that."""
    import cv2

    count, labels, about, _ = cv2.connectedComponentsWithStats(moving.astype(np.uint8), connectivity=8)
    sides = about[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(1)
    return [labels == label for label in range(1, count) if sides[label] <= largest]


def _weights(
    view: View, mask: NDArray[np.bool_], color: NDArray[np.float32], config: TrackConfig
) -> NDArray[np.float64]:
    """[h, w]: how much of a thing of a colour pixels in and right beside a mask show."""
    import cv2

    near = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    apart = np.square(view.picture - color).mean(-1) / config.same**2
    return np.where(near, np.exp(-apart), 0.0)


def _core(view: View, mask: NDArray[np.bool_], color: NDArray[np.float32], config: TrackConfig) -> Track | None:
    """A track that begins at t*."""
    weights = _weights(view, mask, color, config)
    if weights.sum() < 2.0:
        return None
    return Track(mask, color, {view.index: _centre(weights)})


def _centre(weights: NDArray[np.float64]) -> NDArray[np.float64]:
    rows, columns = np.nonzero(weights)
    share = weights[rows, columns] / weights[rows, columns].sum()
    return np.array([share @ columns + 0.5, share @ rows + 0.5])


@dataclass
class _End:
    """Where a track has got to."""

    track: Track
    large: float
    """Square pixels of the thing where it was seen last."""
    speed: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))
    """Pixels per frame."""
    lost: int = 0
    """So many frames ago it was seen."""


def _follow(
    end: _End, index: int, side: int, view: View, moving: NDArray[np.bool_], config: TrackConfig
) -> None:  # fmt: skip
    """Looks for a thing in one frame more."""
    import cv2

    track, frames = end.track, end.lost + 1
    last = track.at[index - side * frames]
    expected = last + end.speed * frames
    reach = config.gate * np.sqrt(end.large) * (1.0 + 0.5 * end.lost) + 0.5 * float(np.linalg.norm(end.speed))
    best: tuple[float, NDArray[np.float64], float] | None = None
    count, labels, about, middles = cv2.connectedComponentsWithStats(moving.astype(np.uint8), connectivity=8)
    for label in range(1, count):
        area = float(about[label, cv2.CC_STAT_AREA])
        far = float(np.linalg.norm(middles[label] + 0.5 - expected))
        if far > reach or not 0.2 < area / end.large < 5.0:
            continue
        weights = _weights(view, labels == label, track.color, config)
        score = float(weights.sum() / area) * np.exp(-2.0 * (far / reach) ** 2)
        if weights.sum() >= 2.0 and (best is None or score > best[0]):
            best = score, _centre(weights), area
    if best is None:
        end.lost += 1
        return
    track.at[index] = best[1]
    end.speed, end.large, end.lost = (best[1] - last) / frames, best[2], 0


def swing(track: Track, index: int, cameras: Callable[[int], View], config: TrackConfig, unit: float) -> Swing | None:
    """Where a thing is at t* that swings, or None if its track is not that of one, or does not tell how deep it is."""
    places = _smooth(track.at, unit)
    if len(places) < config.least:
        return None
    views = {i: cameras(i) for i in places}
    span = max(places) - min(places)
    speeds = [w for w in np.arange(config.slowest, config.fastest, 0.02) if w * span >= config.turn * 2 * np.pi]
    if not speeds:
        return None
    speed = min(speeds, key=lambda w: _fit(places, views, index, w)[1])
    fine = np.linspace(speed - 0.02, speed + 0.02, 21)
    speed = min(fine, key=lambda w: _fit(places, views, index, w)[1])
    place, residual, spread = _fit(places, views, index, speed)
    view = cameras(index)
    depth = float((view.viewmat @ np.append(place, 1.0))[2])
    if depth <= 0.0 or residual > config.residual * unit:
        return None
    axis = view.viewmat[2, :3]
    focal = float(view.K[0, 0])
    equations, free = 2 * len(places), 2 * len(places) - 3 * len(_terms(0.0, speed))
    noise = max(residual * np.sqrt(equations / max(free, 1)), 0.1 * unit)
    deviation = float(np.sqrt(axis @ spread @ axis)) * noise / focal / depth
    return Swing(place, depth, deviation, residual) if deviation <= config.unsure else None


def _smooth(places: dict[int, NDArray[np.float64]], unit: float) -> dict[int, NDArray[np.float64]]:
    """The sightings that lie about where those around them lead: a wrong match leaps."""
    order = sorted(places)
    if len(order) < _AROUND + 1:
        return places
    times, points = np.array(order, np.float64), np.stack([places[i] for i in order])
    off = np.zeros(len(order))
    for n in range(len(order)):
        near = [k for k in np.argsort(np.abs(times - times[n]), kind="stable")[: _AROUND + 1] if k != n]
        ways = np.stack([np.ones(len(near)), times[near] - times[n], np.square(times[near] - times[n])], axis=-1)
        # The least sum of distances, nearly: one wrong match among those around must not lead astray.
        weight, curve = np.ones(len(near)), np.zeros((3, points.shape[-1]))
        for _ in range(_TURNS):
            curve = np.linalg.lstsq(ways * weight[:, None], points[near] * weight[:, None], rcond=None)[0]
            weight = 1.0 / np.sqrt(np.linalg.norm(points[near] - ways @ curve, axis=-1) + 0.1 * unit)
        off[n] = float(np.linalg.norm(points[n] - curve[0]))
    limit = 6.0 * float(np.median(off)) + 2.0 * unit
    return {i: places[i] for i, far in zip(order, off, strict=True) if far <= limit}


def _terms(time: NDArray[np.float64] | float, speed: float) -> NDArray[np.float64]:
    """[..., 6] what a swing is made of; the first alone at time 0."""
    turn = speed * np.asarray(time, np.float64)
    ones = np.ones_like(turn)
    parts = [ones, turn, np.cos(turn) - 1.0, np.sin(turn), np.cos(2 * turn) - 1.0, np.sin(2 * turn)]
    return np.stack(parts, axis=-1)


def _fit(
    places: dict[int, NDArray[np.float64]], views: dict[int, View], index: int, speed: float
) -> tuple[NDArray[np.float64], float, NDArray[np.float64]]:
    """(place at t* [3], median distance in pixels, covariance [3, 3] of it for unit noise on the unit plane)."""
    order = sorted(places)
    terms = _terms(np.array([i - index for i in order], np.float64), speed)
    matrices = np.stack([views[i].viewmat for i in order])
    Ks = np.stack([views[i].K for i in order])
    seen = np.stack([places[i] for i in order])
    flat = (seen - Ks[:, :2, 2]) / Ks[:, [0, 1], [0, 1]]
    rays = matrices[:, :2, :3] - flat[..., None] * matrices[:, 2:3, :3]  # [P, 2, 3]
    target = -(matrices[:, :2, 3] - flat * matrices[:, 2:3, 3])
    design = (terms[:, None, :, None] * rays[:, :, None, :]).reshape(len(order), 2, -1)
    weight = np.ones(len(order))
    each = np.zeros(len(order))
    rows, found = design.reshape(2 * len(order), -1), np.zeros((terms.shape[1], 3))
    for turn in range(_TURNS):
        rows = (design * weight[:, None, None]).reshape(2 * len(order), -1)
        found = np.linalg.lstsq(rows, (target * weight[:, None]).ravel(), rcond=1e-10)[0].reshape(-1, 3)
        local = np.einsum("pij,pj->pi", matrices[:, :3, :3], terms @ found) + matrices[:, :3, 3]
        shown = local[:, :2] / np.where(np.abs(local[:, 2:]) > 1e-6, local[:, 2:], 1e-6)
        each = np.linalg.norm((shown - flat) * Ks[:, [0, 1], [0, 1]], axis=-1)
        weight = 1.0 / np.maximum(np.abs(local[:, 2]), 1e-6)
        if turn:  # a wrong match here and there
            weight = weight / (1.0 + np.square(each / (2.0 * np.median(each) + 1e-3)))
    spread = np.linalg.pinv(rows.T @ rows)[:3, :3]
    return found[0], float(np.median(each)), spread.astype(np.float64)
