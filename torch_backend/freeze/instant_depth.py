"""Depth of a region of a plate that the model does not have (see `missing_layer`).

Nothing tells it alone. What the region hangs on (the arm that a hand belongs to) is nearly as deep, where it can be
told from what is merely beside it: the same colours and the same flow across the outline. Parallax to the frames
around t* is mixed with the region's own motion, which no number of frames takes apart while camera and hand go
straight on; how far matches leave their epipolar lines tells how much own motion there is, and so how little parallax
is to be believed. And the region hides what the model shows there: it is in front of it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray


@dataclass
class DepthConfig:
    """How depth is told. Lengths are in pixels of pictures 320 wide."""

    neighbours: tuple[int, ...] = (1, 2, 3)
    """Frames before and after t* that are matched."""
    round_trip: float = 0.7
    """Greatest distance between a pixel and where the flow there and back ends."""
    ring: float = 6.0
    """Width of the surroundings in which a region may hang on something."""
    alike: float = 0.12
    """Colours this far apart are of different things (display-referred)."""
    together: float = 0.7
    """Flows this far apart, per frame, are of different things."""
    holds: float = 6.0
    """As many alike pixels beside a region weigh as much as nothing else known."""
    nearby: float = 25.0
    """What moves this near is more likely to be as deep as a region than what is behind it."""
    reach: float = 10.0
    """The depth of what a region hangs on is felt this far into it."""
    noise: float = 0.4
    """Standard deviation of the flow."""
    front: float = 0.02
    """Least share by which inverse depth exceeds that of what is hidden."""
    clear: float = 1.08
    """What a region hangs on has at least this times the inverse depth of what the region hides."""
    deep: float = 0.12
    """A region is as deep as what it hangs on to this share of inverse depth."""
    beyond: float = 1.3
    """Inverse depth is at most this times that of the nearest thing around that the region may hang on."""
    free: float = 2.0
    """Or at most this times that of what is hidden, whichever is nearer."""
    steps: int = 64
    """Inverse depths that are tried."""
    field_alpha: float = 0.3
    """Alpha of what the field moves, by itself, from which on the field has something at a pixel."""
    field_share: float = 0.4
    """A region is as deep as what the field has there if that fills at least this share of it."""
    field_jump: float = 0.25
    """What lies off its median by more than this share of inverse depth is something else."""
    field_reach: float = 2.0
    """Standard deviation of the mean of the field's depth that is taken."""
    surely: float = 0.5
    """What hangs on something as surely as that (`Region.attached`) once what the field has there is taken out is as
    deep as it: a field that has it nearer by more than `deep` is wrong."""
    behind: float = 0.05
    """And so is one that has it farther by more than this share, if it falls apart from aside (`torn.py`)."""


@dataclass
class Region:
    """A region of plate t* with its depth."""

    pixels: int
    """Square pixels at the size that was compared."""
    box: tuple[int, int, int, int]
    """Left, top, right, bottom (beyond the last) in those pixels."""
    depth: float
    """Depth along the camera's axis in scene units, median."""
    hidden: float
    """Depth of what the model shows there, median; infinite if it shows nothing."""
    attached: float
    """0..1: how sure it is what the region hangs on."""
    own_motion: float | None
    """Distance of matches from epipolar lines in pixels per frame: the region's own motion; None: no match."""
    deviation: float | None = None
    """Standard deviation of the depth as a share of it where it was triangulated (`instant_track`); None: a guess."""


@dataclass
class View:
    """A plate with its camera."""

    index: int
    """Into the delivered frames."""
    picture: NDArray[np.float32]
    """[h, w, 3] display-referred."""
    viewmat: NDArray[np.float64]
    """[4, 4] world-to-camera, scene units."""
    K: NDArray[np.float64]
    """[3, 3] in pixels of `picture`."""
    _flows: dict[int, tuple[NDArray[np.float32], NDArray[np.bool_]]] = field(
        default_factory=dict[int, "tuple[NDArray[np.float32], NDArray[np.bool_]]"], repr=False
    )

    def grid(self) -> NDArray[np.float64]:
        """[h, w, 2]: x and y of the pixel centres."""
        height, width = self.picture.shape[:2]
        y, x = np.mgrid[0.5:height, 0.5:width]
        return np.stack([x, y], -1)

    def unproject(self, x: NDArray[Any], y: NDArray[Any], depth: NDArray[Any]) -> NDArray[np.float64]:
        """World places [..., 3] of pixels (centres at +0.5) at depths along the axis."""
        rays = np.stack([x, y, np.ones(np.shape(x))], -1) @ np.linalg.inv(self.K).T
        camera = rays * np.asarray(depth, np.float64)[..., None]
        return (camera - self.viewmat[:3, 3]) @ self.viewmat[:3, :3]

    def project(self, other: View, inverse: NDArray[Any] | float) -> NDArray[np.float64]:
        """Where another view sees this one's pixels [h, w, 2], still things of inverse depths [h, w] or one."""
        grid = self.grid()
        rays = np.concatenate([grid, np.ones((*grid.shape[:2], 1))], -1) @ np.linalg.inv(self.K).T
        motion = other.viewmat @ np.linalg.inv(self.viewmat)
        seen = rays @ (other.K @ motion[:3, :3]).T + (other.K @ motion[:3, 3]) * np.asarray(inverse)[..., None]
        return seen[..., :2] / np.maximum(seen[..., 2:], 1e-6)

    def flow_to(self, other: View, round_trip: float) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Dense flow [h, w, 2] to another view's plate, and where the way back leads back [h, w]."""
        import cv2

        if other.index not in self._flows:
            grey = [cv2.cvtColor(np.rint(v.picture * 255).astype(np.uint8), cv2.COLOR_RGB2GRAY) for v in (self, other)]
            flow: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
            forth = np.asarray(flow.calc(grey[0], grey[1], None), np.float32)
            back = np.asarray(flow.calc(grey[1], grey[0], None), np.float32)
            at = (self.grid() - 0.5).astype(np.float32) + forth
            # OpenCV takes None for its second map where the first has both coordinates; its annotations do not.
            border, no_map = cv2.BORDER_CONSTANT, cast(NDArray[np.float32], None)
            returned = np.asarray(cv2.remap(back, at, no_map, cv2.INTER_LINEAR, borderMode=border), np.float32)
            inside = (at >= 0).all(-1) & (at <= np.array(forth.shape[1::-1]) - 1).all(-1)
            self._flows[other.index] = forth, inside & (np.linalg.norm(forth + returned, axis=-1) <= round_trip)
        return self._flows[other.index]


def inverse_depth(
    view: View,
    others: list[View],
    region: NDArray[np.bool_],
    explained: NDArray[np.bool_],
    depth: NDArray[np.float32],
    mover: NDArray[np.float32],
    config: DepthConfig,
    unit: float,
) -> tuple[NDArray[np.float32], Region]:
    """Inverse depth [h, w] of a region (and around it), and what was found about it.

    Args:
        view: plate t*; others: its neighbours.
        region: [h, w] what the model lacks.
        explained: [h, w] where plate and model agree.
        depth: [h, w] the frozen model's, scene units; 1e10 where there is nothing.
        mover: [h, w] in 0..1: what moves.
        unit: pixels per pixel of a picture 320 wide.
    """
    behind = 1.0 / np.maximum(depth.astype(np.float64), 1e-6)
    ring, weight = _ring(view, others, region, explained, behind, mover, config, unit)
    hidden = float(np.median(behind[region]))
    held = float(weight.sum())
    attached = held / (held + config.holds * unit)
    at = weighted_median(behind[ring], weight) if held > 0 else hidden
    low, high = _range(behind, region, ring, weight, mover, config)
    grid = np.geomspace(low, high, config.steps)
    cost = _parallax(view, others, region, grid, config, unit)
    cost = cost + attached * 4.0 * _away(grid, at, config)
    beside, share = _nearby(region, explained, behind, mover, config, unit)
    cost = cost + (1.0 - attached) * share * _away(grid, beside, config)
    cost = cost + 0.02 * np.square(np.log(grid / low) / np.log1p(config.deep))
    best = float(grid[cost.argmin()])
    inverse = _bent(best, behind, region, ring, weight, attached, config, unit)
    # It hides what the model shows there; but a stray Gaussian in front must not drag the region to the lens.
    front = np.minimum(behind * (1.0 + config.front), best * config.beyond)
    inverse = np.maximum(inverse, front).astype(np.float32)
    rows, columns = np.nonzero(region)
    box = int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1
    found = float(np.median(inverse[region]))
    own = own_motion(view, others, region, config, unit)
    return inverse, Region(int(region.sum()), box, 1.0 / found, 1.0 / max(hidden, 1e-10), attached, own)


def as_field(
    inverse: NDArray[np.float32], region: NDArray[np.bool_], config: DepthConfig, unit: float
) -> NDArray[np.float32] | None:
    """Inverse depth [h, w] of a region (and around it), just in front of what the field has there; None if that is too
    little.

    A field that has half a hand, or a pale one, has learnt from all frames around t* where the hand is. With a depth
    guessed anew the other half would stand elsewhere, and the two come apart from the side.

    Args:
        inverse: [h, w] of what the field moves there, before all that stands still; 0 where it has nothing.
        region: [h, w] what the model lacks.
        unit: pixels per pixel of a picture 320 wide.
    """
    import cv2

    there = region & (inverse > 0.0)
    if there.sum() < max(1.0, config.field_share * region.sum()):
        return None
    middle = float(np.median(inverse[there]))
    apart = np.abs(np.log(np.maximum(inverse, 1e-9) / middle))
    weight = ((inverse > 0.0) & (apart < np.log1p(config.field_jump))).astype(np.float32)
    sigma, alone = config.field_reach * unit, 1e-3
    held = np.asarray(cv2.GaussianBlur(weight, (0, 0), sigma), np.float32)
    pulled = np.asarray(cv2.GaussianBlur(inverse * weight, (0, 0), sigma), np.float32)
    told = (1.0 + config.front) * (pulled + alone * middle) / (held + alone)
    return np.asarray(told, np.float32)


def _ring(
    view: View, others: list[View], region: NDArray[np.bool_], explained: NDArray[np.bool_],
    behind: NDArray[np.float64], mover: NDArray[np.float32], config: DepthConfig, unit: float,
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:  # fmt: skip
    """(ring [h, w], weights [R] of its pixels): where a region may hang on something, and how much it seems to."""
    import cv2

    wide = 2 * max(1, round(config.ring * unit)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (wide, wide))
    ring = (cv2.dilate(region.astype(np.uint8), disc) > 0) & explained & ~region
    sigma = 0.5 * config.ring * unit
    other_color = np.linalg.norm(view.picture - _spread(view.picture, region, sigma), axis=-1)
    alike = np.exp(-np.square(other_color / config.alike))
    apart, moves, count = np.zeros(region.shape), np.zeros(region.shape), 0
    for other in others:
        if abs(other.index - view.index) == 1:
            flow, _ = view.flow_to(other, config.round_trip * unit)
            apart = apart + np.linalg.norm(flow - _spread(flow, region, sigma), axis=-1)
            moves = moves + np.linalg.norm(flow - (view.project(other, behind) - view.grid()), axis=-1)
            count += 1
    step = max(1, count) * config.together * unit
    together = np.exp(-np.square(apart / step))
    # A sleeve has another colour than its hand, but goes along; an arm that turns goes less far than its hand.
    weight = np.maximum(alike * (0.3 + 0.7 * together), together * -np.expm1(-np.square(moves / step)))
    # Flow bleeds over outlines, so that what is hidden seems to go along beside a region; but nothing hangs on that.
    weight = weight * (0.2 + 0.8 * mover) * (behind > config.clear * np.median(behind[region]))
    return ring, weight[ring].astype(np.float64)


def _nearby(
    region: NDArray[np.bool_], explained: NDArray[np.bool_], behind: NDArray[np.float64], mover: NDArray[np.float32],
    config: DepthConfig, unit: float,
) -> tuple[float, float]:  # fmt: skip
    """(inverse depth, 0..1 how much there is of it) of what moves not far from a region, in front of what it hides."""
    import cv2

    away = cv2.distanceTransform((~region).astype(np.uint8), cv2.DIST_L2, 3) / (config.nearby * unit)
    weight = mover * explained * np.exp(-np.square(away))
    use = (weight > 0.05) & (behind > (1.0 + config.front) * np.median(behind[region]))
    held = float(weight[use].sum())
    if not use.any():
        return 0.0, 0.0
    return weighted_median(behind[use], weight[use].astype(np.float64)), held / (held + config.nearby**2 * unit**2)


def _spread(values: NDArray[np.float32], mask: NDArray[np.bool_], sigma: float) -> NDArray[np.float32]:
    """Mean [h, w, C] of the values inside a mask around each pixel: Gaussian weights of `sigma` pixels."""
    import cv2

    inside = mask.astype(np.float32)
    weight = cv2.GaussianBlur(inside, (0, 0), sigma)
    total = cv2.GaussianBlur(values * inside[..., None], (0, 0), sigma)
    return np.asarray(total / np.maximum(weight, 1e-6)[..., None], np.float32)


def _away(grid: NDArray[np.float64], at: float, config: DepthConfig) -> NDArray[np.float64]:
    """Cost [G] of inverse depths that are not `at`. Robust: what a region seems to hang on may be beside it only."""
    off = np.square(np.log(grid / max(at, 1e-9)) / np.log1p(config.deep))
    return off / (1.0 + 0.25 * off)


def _range(
    behind: NDArray[np.float64], region: NDArray[np.bool_], ring: NDArray[np.bool_], weight: NDArray[np.float64],
    mover: NDArray[np.float32], config: DepthConfig,
) -> tuple[float, float]:  # fmt: skip
    """Inverse depths between which a region is: in front of what it hides, and not far before its surroundings."""
    low = float(np.percentile(behind[region], 40)) * (1.0 + config.front)
    held = behind[ring][weight > 0.1]
    around = np.concatenate([held, behind[ring & (mover > 0.5)]])
    low = max(low, 1e-6)
    high = float(np.percentile(around, 90)) * config.beyond if len(around) else low
    return low, max(high, config.free * low)


def own_motion(
    view: View, others: list[View], region: NDArray[np.bool_], config: DepthConfig, unit: float
) -> float | None:
    """How far a region leaves its epipolar lines in pixels per frame, median of the frames around; None: not found.

    What moves along the lines only is not told from what is at another depth.
    """
    found: list[float] = []
    for other in others:
        matched = _matches(view, other, region, 0.0, 1.0, config, unit)
        if matched is not None:
            found.append(float(np.median(matched[1])) / abs(other.index - view.index))
    return float(np.median(found)) if found else None


def _matches(
    view: View, other: View, region: NDArray[np.bool_], low: float, high: float, config: DepthConfig, unit: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], float] | None:
    """Where a region's pixels went, [P] each: along their epipolar lines, from the place of inverse depth `low` towards
    that of `high`, and away from the lines; and how far the two places are apart. Pixels. None if too few are found."""
    flow, found = view.flow_to(other, config.round_trip * unit)
    use = region & found
    if use.sum() < 0.3 * region.sum():
        return None
    far = view.project(other, low)[use]
    line = view.project(other, high)[use] - far
    length = np.linalg.norm(line, axis=-1, keepdims=True)
    along = line / np.maximum(length, 1e-9)
    offset = view.grid()[use] + flow[use] - far
    across = np.abs(offset[:, 0] * along[:, 1] - offset[:, 1] * along[:, 0])
    return (offset * along).sum(-1), across, float(np.median(length))


def _parallax(
    view: View, others: list[View], region: NDArray[np.bool_], grid: NDArray[np.float64], config: DepthConfig,
    unit: float,
) -> NDArray[np.float64]:  # fmt: skip
    """Cost [G] of the inverse depths `grid`, by matches in the frames around."""
    cost = np.zeros(len(grid))
    for other in others:
        matched = _matches(view, other, region, float(grid[0]), float(grid[-1]), config, unit)
        if matched is None:
            continue
        place, across, parallax = matched
        # A thing moves along the lines as much as across them: that much a place on them is off.
        error = np.hypot(config.noise * unit, 1.5 * float(np.median(across)))
        expected = parallax * (grid - grid[0]) / (grid[-1] - grid[0])
        off = np.square((expected - float(np.median(place))) / error)
        cost += off / (1.0 + 0.1 * off) / len(others)
    return cost


def _bent(
    best: float, behind: NDArray[np.float64], region: NDArray[np.bool_], ring: NDArray[np.bool_],
    weight: NDArray[np.float64], attached: float, config: DepthConfig, unit: float,
) -> NDArray[np.float64]:  # fmt: skip
    """Inverse depth [h, w]: the region's, bent to meet what it hangs on where the two join."""
    import cv2

    join = np.zeros(region.shape)
    near = np.abs(np.log(behind[ring] / best)) < 0.25
    join[ring] = weight * near * attached
    sigma = config.reach * unit
    held = cv2.GaussianBlur(join, (0, 0), sigma)
    pulled = cv2.GaussianBlur(join * behind, (0, 0), sigma)
    alone = 0.2 / sigma
    return (pulled + alone * best) / (held + alone)


def weighted_median(values: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    """Of values [P] by weights [P], of which some are above zero: the least at which half of the weight is reached."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])
