"""Separates a lassoed thing from what surrounds it, in one frozen frame: by its colours and its depth.

Log-odds of three cues are added: the outline that was drawn or rendered, colour, and depth. The last two are histograms
of what lies inside and around, as in GrabCut (Rother, Kolmogorov, Blake, SIGGRAPH 2004). In place of a graph cut, a
guided filter (He, Sun, Tang: "Guided image filtering", PAMI 2013) smooths them along the frame's own edges; it then
turns the decision into soft edges. OpenCV's GrabCut takes neither a prior nor a fourth channel: it lost legs and arms
of people 25 pixels wide.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]
"""[H, W, 3] as displayed."""
Matte = NDArray[np.float32]
"""[H, W] in 0..1: share of the pixel that belongs to the thing."""


@dataclass(frozen=True)
class SegmentConfig:
    """How a thing is separated from what surrounds it."""

    slack: float = 0.008
    """A lasso may miss the outline by this share of the frame's width; 0.008 is 5 pixels of 640."""
    band: float = 0.008
    """The outline that splats render may miss the picture's by this share of the frame's width; 5 pixels of 640."""
    around: float = 0.06
    """Share of the frame's width around the thing from which the colours of what surrounds it are learnt; 38 pixels of
    640."""
    least: int = 4
    """Least `slack` in pixels at any frame size: a lasso drawn by hand is off by about 3."""
    most: float = 3.0
    """Log-odds of one cue at most, 20 to 1: no cue overrules two others that agree."""
    prior: float = 3.0
    """Log-odds of the outline that was drawn or rendered at a distance of `slack` or `band` from it: 20 to 1."""
    radius: float = 0.004
    """Radius of the guided filters' window as a share of the frame's width; 2.5 pixels of 640."""
    epsilon: float = 1e-3
    """Regularisation of the guided filters on pictures in 0..1: contrast below its root, 0.03, is no edge."""


def segment_lasso(
    picture: Picture, depth: NDArray[np.float32], polygon: NDArray[np.float64], config: SegmentConfig | None = None
) -> Matte:
    """The matte of what a polygon [P, 2] (pixels, centres at +0.5) surrounds in a frame.

    `depth` [H, W] is that of the frame, along the camera's axis, any unit.
    """
    config = config or SegmentConfig()
    inside = filled(polygon, picture.shape[:2])
    slack = max(config.least, round(config.slack * picture.shape[1]))
    prior = config.prior / slack * signed_distance(inside)
    return _cut(picture, depth, prior, ~_grown(inside, slack), config)


def refine(
    picture: Picture, depth: NDArray[np.float32], rendered: Matte, known: Matte, config: SegmentConfig | None = None
) -> Matte:
    """A matte as splats render it, with its edge where the frame's own picture has it.

    `known` [H, W] in 0..1 is the share of each pixel that some vote was about: the picture decides about the rest.
    """
    config = config or SegmentConfig()
    is_known = known > 0.5
    inside = (rendered > 0.5) & is_known
    if not inside.any():
        return np.zeros_like(rendered)
    band = max(2, round(config.band * picture.shape[1]))
    prior = np.where(is_known, config.prior / band * signed_distance(inside), -config.prior)
    return _cut(picture, depth, prior, is_known & ~_grown(inside, band), config)


def signed_distance(inside: NDArray[np.bool_]) -> NDArray[np.float32]:
    """[H, W] pixels from the outline of a mask: above 0 inside, below 0 outside, halves beside the outline."""
    within, beyond = (
        np.asarray(cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5), np.float32)
        for mask in (inside, ~inside)
    )
    return np.where(inside, within - 0.5, 0.5 - beyond)


def filled(polygon: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """bool [H, W]: pixels whose centres lie within a polygon [P, 2]."""
    shift = 4
    corners = np.rint((polygon - 0.5) * (1 << shift)).astype(np.int32)
    mask = np.zeros(shape, np.uint8)
    cv2.fillPoly(mask, [corners], 1, cv2.LINE_8, shift)
    return mask > 0


def _cut(
    picture: Picture, depth: NDArray[np.float32], prior: NDArray[np.float32], never: NDArray[np.bool_],
    config: SegmentConfig,
) -> Matte:  # fmt: skip
    """The matte by log-odds: those of the outline, of colour and of depth, smoothed along the picture's edges."""
    width = prior.shape[1]
    rows, columns = _crop(~never, round(config.around * width))
    part, start = picture[rows, columns], prior[rows, columns]
    guide = part.astype(np.float32) / 255.0
    radius = max(1, round(config.radius * width))
    away = np.log(np.maximum(depth[rows, columns], 1e-9))
    inside = (start > 0.0) & ~never[rows, columns]
    odds = start + ratio(_colour_bins(part), COLOURS**3, inside, config.most)
    odds += ratio(_depth_bins(away, inside), DEPTHS, inside, config.most)
    odds = smoothed(guide, np.clip(odds, -2.0 * config.most, 2.0 * config.most), radius, config.epsilon)
    hard = ((odds > 0.0) & ~never[rows, columns]).astype(np.float32)
    matte = np.zeros(prior.shape, np.float32)
    matte[rows, columns] = guided(guide, hard, radius, config.epsilon)
    return matte


COLOURS, DEPTHS = 12, 48
"""Bins of each colour axis, and of depth."""


def _colour_bins(picture: Picture) -> NDArray[np.int64]:
    """[H, W] bin of each pixel's colour in CIE Lab, `COLOURS` a side."""
    lab = np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2LAB)).astype(np.int64) * COLOURS // 256
    return (lab[..., 0] * COLOURS + lab[..., 1]) * COLOURS + lab[..., 2]


def _depth_bins(away: NDArray[np.float32], inside: NDArray[np.bool_]) -> NDArray[np.int64]:
    """[H, W] bin of each pixel's logarithm of depth: those of the thing's own depths lie in the middle half."""
    low, high = np.quantile(away[inside], (0.02, 0.98)) if inside.any() else (0.0, 0.0)
    span = max(float(high - low), 0.02)
    return np.clip((away - low + 0.5 * span) / (2.0 * span) * DEPTHS, 0, DEPTHS - 1).astype(np.int64)


def ratio(bins: NDArray[np.int64], count: int, inside: NDArray[np.bool_], most: float) -> NDArray[np.float32]:
    """[H, W] log-ratio of how frequent each pixel's bin is inside and outside of a mask, `most` at most.

    A bin counts as if one pixel of a thousand on either side were in it: rare ones tell nothing.
    """
    shares: list[NDArray[np.float64]] = []
    for mask in (inside, ~inside):
        found = np.bincount(bins[mask], minlength=count).astype(np.float64)
        shares.append(found / max(1.0, found.sum()) + 1e-3)
    return np.clip(np.log(shares[0] / shares[1]), -most, most).astype(np.float32)[bins]


def guided(guide: NDArray[np.float32], values: Matte, radius: int, epsilon: float) -> Matte:
    """`smoothed`, held in 0..1."""
    return np.clip(smoothed(guide, values, radius, epsilon), 0.0, 1.0)


def smoothed(
    guide: NDArray[np.float32], values: NDArray[np.float32], radius: int, epsilon: float
) -> NDArray[np.float32]:
    """Guided filter with a colour guide [H, W, 3] in 0..1: `values` [H, W] with edges where the guide has them.

    He et al. 2013, equations 19 to 21: within each window values are a linear function of the guide's colour.
    """

    def mean(layer: NDArray[np.float32]) -> NDArray[np.float32]:
        size = 2 * radius + 1
        return np.asarray(cv2.boxFilter(layer, cv2.CV_32F, (size, size), borderType=cv2.BORDER_REFLECT), np.float32)

    middle, level = mean(guide), mean(values)
    joint = mean(guide * values[..., None]) - middle * level[..., None]
    pairs = [(i, j) for i in range(3) for j in range(i, 3)]
    spread = np.empty((*values.shape, 3, 3), np.float32)
    for i, j in pairs:
        spread[..., i, j] = spread[..., j, i] = mean(guide[..., i] * guide[..., j]) - middle[..., i] * middle[..., j]
    spread[..., range(3), range(3)] += epsilon
    slopes = np.linalg.solve(spread, joint[..., None])[..., 0]
    offset = level - (slopes * middle).sum(-1)
    found = (mean(slopes) * guide).sum(-1) + mean(offset)
    return np.asarray(found, np.float32)


def _crop(mask: NDArray[np.bool_], margin: int) -> tuple[slice, slice]:
    """Rows and columns of what is True, and `margin` pixels around it."""
    found: list[slice] = []
    for axis in (1, 0):
        at = np.flatnonzero(mask.any(axis))
        low, high = (int(at[0]), int(at[-1]) + 1) if len(at) else (0, mask.shape[1 - axis])
        found.append(slice(max(0, low - margin), min(mask.shape[1 - axis], high + margin)))
    return found[0], found[1]


def _disc(radius: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), np.uint8)


def _grown(mask: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    return np.asarray(cv2.dilate(mask.astype(np.uint8), _disc(by))) > 0
