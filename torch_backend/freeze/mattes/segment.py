"""Separates a lassoed thing from what surrounds it, in one frozen frame: by its colours and its depth.

GrabCut (Rother, Kolmogorov, Blake: "GrabCut", SIGGRAPH 2004; OpenCV's) decides which pixels belong to the thing, and a
guided filter (He, Sun, Tang: "Guided image filtering", PAMI 2013) turns that decision into soft edges that follow the
frame's own picture.
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

    longest: int = 480
    """GrabCut works on a crop around the thing of at most so many pixels along its longer side: its cost grows with the
    number of pixels, and the guided filter brings the edge back to full size."""
    slack: float = 0.008
    """A lasso may miss the outline by this share of the frame's width; 0.008 is 5 pixels of 640."""
    band: float = 0.008
    """The outline that splats render may miss the picture's by this share of the frame's width; 5 pixels of 640."""
    around: float = 0.25
    """Share of the frame's width around the thing from which the colours of what surrounds it are learnt where no vote
    is known: white next to a white shirt is known from the wall farther away."""
    least: int = 4
    """`slack` and `band` are at least so many pixels, however small the frame is."""
    iterations: int = 3
    """Rounds of fitting colours and cutting."""
    log_depth: float = 0.5
    """Scale in natural logarithms over which depth is told apart: beyond a factor of e^0.5 all is far."""
    radius: float = 0.004
    """Radius of the guided filter's window as a share of the frame's width; 2.5 pixels of 640."""
    epsilon: float = 1e-4
    """Regularisation of the guided filter on pictures in 0..1: contrast below its root, 0.01, is no edge."""


def segment_lasso(
    picture: Picture, depth: NDArray[np.float32], polygon: NDArray[np.float64], config: SegmentConfig | None = None
) -> Matte:
    """The matte of what a polygon [P, 2] (pixels, centres at +0.5) surrounds in a frame.

    `depth` [H, W] is that of the frame, along the camera's axis, any unit.
    """
    config = config or SegmentConfig()
    inside = filled(polygon, picture.shape[:2])
    slack = max(config.least, round(config.slack * picture.shape[1]))
    outer, inner = _grown(inside, slack), _shrunk(inside, slack)
    surely = inner & _at_its_depth(depth, inside, slack)
    return _cut(picture, depth, inside, ~outer, surely, 4 * slack, config)


def refine(
    picture: Picture, depth: NDArray[np.float32], rendered: Matte, known: Matte, config: SegmentConfig | None = None
) -> Matte:
    """A matte as splats render it, with its edge where the frame's own picture has it.

    `known` [H, W] in 0..1 is the share of each pixel that some vote was about: the picture decides about the rest.
    """
    config = config or SegmentConfig()
    told = known > 0.5
    inside = (rendered > 0.5) & told
    if not inside.any():
        return np.zeros_like(rendered)
    band = max(config.least, round(config.band * picture.shape[1]))
    surely = _shrunk(inside | ~told, band) & inside
    never = told & ~_grown(inside, band)
    margin = 4 * band
    if not told.all():
        never |= ~told & ~_at_its_depth(depth, inside, margin)
        margin = round(config.around * picture.shape[1])
    return _cut(picture, depth, inside, never, surely, margin, config)


def filled(polygon: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """bool [H, W]: pixels whose centres lie within a polygon [P, 2]."""
    shift = 4
    corners = np.rint((polygon - 0.5) * (1 << shift)).astype(np.int32)
    mask = np.zeros(shape, np.uint8)
    cv2.fillPoly(mask, [corners], 1, cv2.LINE_8, shift)
    return mask > 0


def _at_its_depth(depth: NDArray[np.float32], inside: NDArray[np.bool_], around: int) -> NDArray[np.bool_]:
    """bool [H, W]: depths of which more pixels lie `inside` than within `around` pixels outside."""
    away = np.log(np.maximum(depth, 1e-9))
    low, high = np.quantile(away[inside], (0.01, 0.99)) if inside.any() else (0.0, 0.0)
    bins = np.rint((away - low) / max(high - low, 1e-3) * 30.0).clip(-1, 31).astype(np.int64) + 1
    ring = _grown(inside, around) & ~inside
    mine, others = (np.bincount(bins[mask], minlength=33) for mask in (inside, ring))
    return (mine > others)[bins]


def _cut(
    picture: Picture, depth: NDArray[np.float32], inside: NDArray[np.bool_], never: NDArray[np.bool_],
    surely: NDArray[np.bool_], margin: int, config: SegmentConfig,
) -> Matte:  # fmt: skip
    """GrabCut of what is neither `never` nor `surely` the thing, beginning with `inside`; then soft edges.

    Colours are learnt from `margin` pixels around.
    """
    rows, columns = _crop(~never, margin)
    part = picture[rows, columns]
    cues = _cues(part, depth[rows, columns], inside[rows, columns], config)
    labels = np.where(inside[rows, columns], cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[never[rows, columns]] = cv2.GC_BGD
    labels[surely[rows, columns]] = cv2.GC_FGD
    shrink = min(1.0, config.longest / max(part.shape[:2]))
    size = max(1, round(part.shape[1] * shrink)), max(1, round(part.shape[0] * shrink))
    small = cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST)
    if (small == cv2.GC_BGD).any() and (small != cv2.GC_BGD).any():
        cv2.setRNGSeed(0)  # k-means begins at random: the same lasso makes the same matte
        cues = cv2.resize(cues, size, interpolation=cv2.INTER_AREA)
        nowhere, models = (0, 0, 1, 1), (np.zeros((1, 65)), np.zeros((1, 65)))  # the rectangle is not read with a mask
        small = cv2.grabCut(cues, small, nowhere, *models, config.iterations, cv2.GC_INIT_WITH_MASK)[0]
    hard = ((small == cv2.GC_FGD) | (small == cv2.GC_PR_FGD)).astype(np.float32)
    hard = np.asarray(cv2.resize(hard, part.shape[1::-1], interpolation=cv2.INTER_LINEAR), np.float32)
    radius = max(1, round(config.radius * inside.shape[1]))
    matte = np.zeros(inside.shape, np.float32)
    matte[rows, columns] = guided(part.astype(np.float32) / 255.0, hard, radius, config.epsilon)
    return matte


def _cues(picture: Picture, depth: NDArray[np.float32], inside: NDArray[np.bool_], config: SegmentConfig) -> Picture:
    """[H, W, 3]: the two directions in which the picture's colours vary most, and depth.

    OpenCV's GrabCut takes three channels; the third principal direction of colours holds 1 to 3 % of their variance.
    """
    colours = picture.reshape(-1, 3).astype(np.float32)
    colours = colours - colours.mean(0)
    _, axes = np.linalg.eigh(colours.T @ colours)
    main = colours @ axes[:, :0:-1] + 128.0
    middle = float(np.median(depth[inside])) if inside.any() else 1.0
    away = np.log(np.maximum(depth, 1e-9) / max(middle, 1e-9)) / config.log_depth
    cues = np.concatenate([main.reshape(*depth.shape, 2), (128.0 + 127.0 * np.tanh(away))[..., None]], axis=2)
    return np.clip(np.rint(cues), 0, 255).astype(np.uint8)


def guided(guide: NDArray[np.float32], values: Matte, radius: int, epsilon: float) -> Matte:
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
    return np.clip(found, 0.0, 1.0).astype(np.float32)


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


def _shrunk(mask: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    # What the frame's border cuts off goes on beyond it.
    return np.asarray(cv2.erode(mask.astype(np.uint8), _disc(by), borderType=cv2.BORDER_REPLICATE)) > 0
