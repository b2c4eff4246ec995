"""A candidate for motion mattes against rendered truth: `python -m benchmarks.misfit SCENE ... --results DIR`.

Not a part of the product: it is what could take the place of `solve/fleeting.py` and of what is likely to move
(docs/decisions.md, "Motion mattes"). Dense flow smooths an arm before a wall into the motion of the wall. Two pictures
tell what is there at rest: what a static model of the clip shows, and the median of other frames along the surface.
Each errs in its own places, the model at far skylines, the median at outlines, so a pixel is as unlike as the smaller
of both differences says.

SCENE and DIR are those of `benchmarks.movers`, whose figures are printed for key frames: of the candidate alone, of
today's mattes with what is likely to move, and of both together.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.movers import frame_row, run
from benchmarks.sources import Log
from torch_backend.report.truth import TruthScene
from torch_backend.solve.fleeting import Sight, seeded
from torch_backend.solve.flow import FlowConfig, Map, Mask, Matches, neighbours
from torch_backend.solve.motion import MOVING, load_motion
from torch_backend.solve.moving import Clip
from torch_backend.solve.still import Ray, StillTest, evidence, fitted_brightness
from torch_backend.train import static_views

BEHIND = 19.0
"""`Ray.project` returns 20 times the inverse depth for points at or behind a camera."""
LABELS = ("misfit", "today", "both")
"""What is judged."""


@dataclass(frozen=True)
class MisfitConfig:
    """What counts as unlike. Chosen on tuning scenes `arm` 0, 1, 2 and `swinging` 0."""

    sigma: float = 4.0
    """Sigma of the low-pass of differences, in pixels of a picture 640 wide."""
    usual: float = 0.9
    """Quantile of a frame's differences that is their unit. With the median, thresholds of equally many false pixels
    differ by a factor of 1.9 between tuning scenes, with this by 1.5."""
    weak: float = 1.3
    """Misfit, in that unit, down to which an area extends that moves."""
    strong: float = 2.0
    """Misfit that a pixel of the area has to reach."""
    references: int = 13
    """Key frames of the clip, evenly spaced, whose median is taken."""
    fewest: int = 5
    """References that have to have a surface in their picture. With 2 the rim of a clip's view is called moving, where
    a model has little to learn from either: `arm` 0 then loses 1.2 dB where nothing moves."""


def misfit(
    frame: Sight, inverse: Map, shown: NDArray[np.uint8], others: Sequence[Sight], grid: tuple[Map, Map], unit: float,
    config: MisfitConfig,
) -> Map:  # fmt: skip
    """[h, w] float32 how unlike the world at rest a frame is, in units of what `usual` of the frame stays below.

    Args:
        inverse: [h, w] inverse depths of the frame's still points, in 1 / solve units.
        shown: [h, w, 3] what a static model of the clip shows at the frame's camera.
        others: the references; pixels that too few of them have in their picture read 0.
        grid: positions of the grid's points in flow pixels.
        unit: points of the grid to one pixel of a picture 640 wide.
    """
    colors = frame.shades.colors
    median, number = _median(frame, inverse, others, grid)
    gaps = (np.abs(colors - np.asarray(each, np.float32)).max(axis=-1) for each in (shown, median))
    from_model, from_others = (cv2.GaussianBlur(gap, (0, 0), config.sigma * unit) for gap in gaps)
    gap = np.where(number >= config.fewest, np.minimum(from_model, from_others), np.float32(0.0))
    return gap / np.float32(max(float(np.quantile(gap, config.usual)), 1.0))


def _median(frame: Sight, inverse: Map, others: Sequence[Sight], grid: tuple[Map, Map]) -> tuple[Map, NDArray[Any]]:
    """([h, w, 3] median of the others along the frame's still surfaces, [h, w] how many have those in their picture).

    Others are brought to the frame's brightness. Where none has a surface in its picture it is the frame itself.
    """
    colors = frame.shades.colors
    shown: list[Map] = []
    for other in others:
        picture, visible = _carried(frame, inverse, other, grid)
        few = np.zeros_like(visible)
        few[::4, ::4] = visible[::4, ::4]
        for c in range(3):
            factor, offset = fitted_brightness(colors[..., c][few].astype(np.float32), picture[..., c][few])
            picture[..., c] = factor * picture[..., c] + offset
        shown.append(np.where(visible[..., None], picture, np.float32(np.nan)))
    stack = np.sort(np.stack(shown), axis=0)  # NaN, outside, comes last
    number = np.count_nonzero(~np.isnan(stack[..., 0]), axis=0)
    middle = np.take_along_axis(stack, np.maximum(number - 1, 0)[None, ..., None] // 2, axis=0)[0]
    return np.where(number[..., None] > 0, middle, colors), number


def _carried(frame: Sight, inverse: Map, other: Sight, grid: tuple[Map, Map]) -> tuple[Map, Mask]:
    """([h, w, 3] float32 another frame's colours at this frame's still points, [h, w] which are in its picture)."""
    at, over = Ray(grid, (frame.viewmat, other.viewmat), (frame.K, other.K)).project(inverse)
    x, y = (np.clip(0.5 * p - 0.5, -1e4, 1e4).astype(np.float32) for p in at)
    height, width = inverse.shape
    inside = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1) & (over < BEHIND)
    colors = cv2.remap(other.shades.colors.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return colors, inside


def masks(truth: TruthScene, config: MisfitConfig) -> dict[int, Mask]:
    """Frame number -> [H, W] what moves by the candidate, of the key frames whose pose was solved."""
    flow = FlowConfig()
    clip = Clip(truth.shot, static_views(truth.shot, Log()))
    matches = Matches(clip.picture, flow, clip.unit)
    test = StillTest(clip.look, clip.viewmats, clip.Ks, clip.guessed, matches.grid, clip.unit)
    count, least = len(clip.keys), round((flow.blob * clip.width / 640) ** 2)
    sights = {key: sight for key in range(count) if (sight := clip.sight(key)) is not None}
    chosen = {[*sights][round(n)] for n in np.linspace(0, len(sights) - 1, config.references)}
    found: dict[int, Mask] = {}
    for key, sight in sights.items():
        shown = clip.static(clip.keys[key])
        if shown is None:
            continue
        inverse = evidence(test, key, neighbours(matches, key, count, flow), clip.depths[key], flow).inverse
        others = [sights[other] for other in chosen if other != key]
        unlike = misfit(sight, inverse, shown.colors, others, matches.grid, 0.5 * clip.unit, config)
        unlike = np.asarray(cv2.resize(unlike, (clip.width, clip.height), interpolation=cv2.INTER_LINEAR))
        found[clip.frames[clip.keys[key]]] = seeded(unlike > config.weak, unlike > config.strong, least, connectivity=4)
    return found


def judge(truth: TruthScene, margin: int) -> list[dict[str, Any]]:
    """One row per key frame, see `movers.frame_row`, of `LABELS`."""
    rows: list[dict[str, Any]] = []
    for frame, mask in masks(truth, MisfitConfig()).items():
        today = load_motion(truth.shot, frame, likely=True)
        if today is None:
            continue
        height, width = today.shape
        regions = {name: region.numpy() for name, region in truth.frame_regions(frame, width, height).items()}
        candidate = np.where(mask, np.uint8(MOVING), np.uint8(0))
        both = np.where(mask, np.uint8(MOVING), today)
        rows.append(frame_row(dict(zip(LABELS, (candidate, today, both), strict=True)), regions, margin))
    return rows


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; returns an exit code."""
    return run(argv, __doc__, "misfit", LABELS, judge)


if __name__ == "__main__":
    sys.exit(main())
