"""Segments a lassoed object in one frozen frame by colour and depth.

Log-odds of three cues are added: the outline that was drawn or rendered, colour, and depth. Colour and depth use
histograms of the inside and the surroundings, as in GrabCut (Rother, Kolmogorov, Blake, SIGGRAPH 2004). A guided filter
(He, Sun, Tang: "Guided image filtering", PAMI 2013) replaces the graph cut: it smooths the log-odds along the frame's
edges, and then softens the edges of the decision.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]
"""[H, W, 3] sRGB picture."""
Matte = NDArray[np.float32]
"""[H, W] in 0..1: share of the pixel that belongs to the object."""


@dataclass(frozen=True)
class SegmentConfig:
    """Parameters of the segmentation. Lengths are shares of the frame's width."""

    slack: float = 0.008
    """Largest expected error of a lasso's outline; 5 pixels at width 640."""
    band: float = 0.008
    """Largest expected error of an outline rendered from splats; 5 pixels at width 640."""
    around: float = 0.06
    """Width of the surroundings from which background colours are learnt; 38 pixels at width 640."""
    least: int = 4
    """Smallest `slack` in pixels at any frame size: a lasso drawn by hand is off by about 3."""
    most: float = 3.0
    """Largest log-odds of one cue, 20 to 1, so that no cue overrules two others that agree."""
    prior: float = 3.0
    """Log-odds of the outline cue at a distance of `slack` or `band` from the outline: 20 to 1."""
    radius: float = 0.004
    """Radius of the guided filters' windows; 2.5 pixels at width 640."""
    epsilon: float = 1e-3
    """Regularisation of the guided filters on pictures in 0..1: contrast below its root, 0.03, does not form an
    edge."""


def segment_lasso(
    picture: Picture, depth: NDArray[np.float32], polygon: NDArray[np.float64], config: SegmentConfig | None = None
) -> Matte:
    """The matte of the object inside a polygon [P, 2] (pixels, centres at +0.5) in a frame.

    `depth` [H, W] of the frame is along the camera's axis, in any unit.
    """
    config = config or SegmentConfig()
    inside = filled(polygon, picture.shape[:2])
    slack = max(config.least, round(config.slack * picture.shape[1]))
    prior = config.prior / slack * signed_distance(inside)
    return _cut(picture, depth, prior, ~_dilated(inside, slack), config)


def refine(
    picture: Picture, depth: NDArray[np.float32], rendered: Matte, known: Matte, config: SegmentConfig | None = None
) -> Matte:
    """A matte rendered from splats, with its edges moved to the edges of the frame's picture.

    `known` [H, W] in 0..1 is the share of each pixel with votes; elsewhere colour and depth decide.
    """
    config = config or SegmentConfig()
    is_known = known > 0.5
    inside = (rendered > 0.5) & is_known
    if not inside.any():
        return np.zeros_like(rendered)
    band = max(2, round(config.band * picture.shape[1]))
    prior = np.where(is_known, config.prior / band * signed_distance(inside), -config.prior)
    return _cut(picture, depth, prior, is_known & ~_dilated(inside, band), config)


def signed_distance(inside: NDArray[np.bool_]) -> NDArray[np.float32]:
    """[H, W] signed distance to the outline of a mask in pixels: positive inside, +-0.5 at pixels on the outline."""
    within, beyond = (
        np.asarray(cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5), np.float32)
        for mask in (inside, ~inside)
    )
    return np.where(inside, within - 0.5, 0.5 - beyond)


def filled(polygon: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """bool [H, W]: pixels whose centres are inside a polygon [P, 2]."""
    shift = 4
    corners = np.rint((polygon - 0.5) * (1 << shift)).astype(np.int32)
    mask = np.zeros(shape, np.uint8)
    cv2.fillPoly(mask, [corners], 1, cv2.LINE_8, shift)
    return mask > 0


def _cut(
    picture: Picture, depth: NDArray[np.float32], prior: NDArray[np.float32], excluded: NDArray[np.bool_],
    config: SegmentConfig,
) -> Matte:  # fmt: skip
    """The matte from log-odds of outline, colour and depth (see the module docstring); 0 where `excluded` is True."""
    width = prior.shape[1]
    rows, columns = _crop(~excluded, round(config.around * width))
    part, start = picture[rows, columns], prior[rows, columns]
    guide = part.astype(np.float32) / 255.0
    radius = max(1, round(config.radius * width))
    log_depth = np.log(np.maximum(depth[rows, columns], 1e-9))
    inside = (start > 0.0) & ~excluded[rows, columns]
    # OpenCV's GrabCut takes neither a prior nor a fourth channel: overlap 0.51 instead of 0.85 (docs/decisions.md).
    odds = start + ratio(_colour_bins(part), COLOURS**3, inside, config.most)
    odds += ratio(_depth_bins(log_depth, inside), DEPTHS, inside, config.most)
    odds = smoothed(guide, np.clip(odds, -2.0 * config.most, 2.0 * config.most), radius, config.epsilon)
    hard = ((odds > 0.0) & ~excluded[rows, columns]).astype(np.float32)
    matte = np.zeros(prior.shape, np.float32)
    matte[rows, columns] = guided(guide, hard, radius, config.epsilon)
    return matte


COLOURS, DEPTHS = 12, 48
"""Number of histogram bins per colour axis, and for depth."""


def _colour_bins(picture: Picture) -> NDArray[np.int64]:
    """[H, W] histogram bin of each pixel's CIE Lab colour, with `COLOURS` bins per axis."""
    lab = np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2LAB)).astype(np.int64) * COLOURS // 256
    return (lab[..., 0] * COLOURS + lab[..., 1]) * COLOURS + lab[..., 2]


def _depth_bins(log_depth: NDArray[np.float32], inside: NDArray[np.bool_]) -> NDArray[np.int64]:
    """[H, W] histogram bin of each pixel's log depth; the object's depths cover the middle half of the bins."""
    low, high = np.quantile(log_depth[inside], (0.02, 0.98)) if inside.any() else (0.0, 0.0)
    span = max(float(high - low), 0.02)
    return np.clip((log_depth - low + 0.5 * span) / (2.0 * span) * DEPTHS, 0, DEPTHS - 1).astype(np.int64)


def ratio(bins: NDArray[np.int64], count: int, inside: NDArray[np.bool_], most: float) -> NDArray[np.float32]:
    """[H, W] log-ratio of the frequencies of each pixel's bin inside and outside a mask, limited to +-`most`."""
    shares: list[NDArray[np.float64]] = []
    for mask in (inside, ~inside):
        found = np.bincount(bins[mask], minlength=count).astype(np.float64)
        shares.append(found / max(1.0, found.sum()) + 1e-3)  # rare bins give a ratio near 0
    return np.clip(np.log(shares[0] / shares[1]), -most, most).astype(np.float32)[bins]


def guided(guide: NDArray[np.float32], values: Matte, radius: int, epsilon: float) -> Matte:
    """`smoothed`, clipped to 0..1."""
    return np.clip(smoothed(guide, values, radius, epsilon), 0.0, 1.0)


def smoothed(
    guide: NDArray[np.float32], values: NDArray[np.float32], radius: int, epsilon: float
) -> NDArray[np.float32]:
    """`values` [H, W] smoothed by a guided filter with a colour guide [H, W, 3] in 0..1; edges follow the guide.

    He et al. 2013, equations 19 to 21: in each window, the result is a linear function of the guide's colour.
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
    """(rows, columns) of the bounding box of True pixels, extended by `margin` pixels."""
    found: list[slice] = []
    for axis in (1, 0):
        at = np.flatnonzero(mask.any(axis))
        low, high = (int(at[0]), int(at[-1]) + 1) if len(at) else (0, mask.shape[1 - axis])
        found.append(slice(max(0, low - margin), min(mask.shape[1 - axis], high + margin)))
    return found[0], found[1]


def _disc(radius: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), np.uint8)


def _dilated(mask: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    return np.asarray(cv2.dilate(mask.astype(np.uint8), _disc(by))) > 0
