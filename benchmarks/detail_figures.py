"""Figures of frozen frames with plate detail, as pure functions: still pixels, and flow that camera motion explains.

Pictures are display-referred [H, W, 3] in [0, 1], masks bool [H, W], places [H, W, 2] in pixels (x, y) with pixel
centres at +0.5, cameras OpenCV world-to-camera [4, 4] and K [3, 3] in pixels. The product shares none of this code.
"""

# Packages of requirements/bench.txt may be absent; each use handles that case.
# pyright: reportMissingImports=false

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from benchmarks.report.metrics import best_share_psnr, gradient_magnitude, psnr_of

STILL_MATTE = 0.05
"""A still pixel has a motion matte below this."""
STILL_MARGIN = 8
"""A still pixel is farther than this from every mover, in pixels."""
MOVER_MATTE = 0.75
"""A mover has a matte above this; *unknown* (0.5) counts as neither still nor moving."""
SAME_DEPTH = 0.03
"""Two views see the same point if the relative difference of its depths is below this."""
FLOW_WIDTH = 640
"""Picture width in pixels at which flow is computed."""
LEVEL_WINDOW, LEVEL_FLOOR = 31, 8 / 255
"""Window in pixels of the local normalisation before flow, and the contrast added to its divisor."""
TEXTURE_WINDOW, TEXTURE = 9, 4 / 255
"""Window in pixels of the structure tensor, and the least structure; grain of 1 or 2 / 255 stays below it."""


def dilate(mask: Tensor, by: int) -> Tensor:
    """A mask dilated by `by` pixels."""
    return F.max_pool2d(mask.float()[None, None], 2 * by + 1, 1, by)[0, 0] > 0.5


def still_pixels(matte: Tensor, mover: Tensor | None = None, margin: int = STILL_MARGIN) -> Tensor:
    """bool [H, W] still pixels, from a motion matte [H, W] in 0..1.

    `mover`: additional moving pixels, which also get the margin.
    """
    movers = matte > MOVER_MATTE
    movers = movers if mover is None else movers | mover
    return (matte < STILL_MATTE) & ~dilate(movers, margin)


def picture_figures(image: Tensor, plate: Tensor, still: Tensor) -> dict[str, float | None]:
    """Acceptance figures of one frame: PSNR in dB of the whole, of its best 90 % and of still pixels, and gradients."""
    error = (image.clamp(0.0, 1.0) - plate.clamp(0.0, 1.0)).double().square().mean(2)
    sharp = gradient_magnitude(plate)
    return {
        "whole_db": psnr_of(float(error.mean())),
        "best_90_db": best_share_psnr(image, plate),
        "still_db": psnr_of(float(error[still].mean())) if still.any() else None,
        "gradient": gradient_magnitude(image) / sharp if sharp > 0 else None,
    }


def mean_difference(a: Tensor, b: Tensor, where: Tensor) -> float | None:
    """Mean absolute difference of two pictures over a mask; None for an empty mask."""
    return float((a.clamp(0.0, 1.0) - b.clamp(0.0, 1.0)).abs().mean(2)[where].mean()) if where.any() else None


# ------------------------------------------------------------------------------------------------- between two views


def induced_places(
    depth: Tensor, from_view: Tensor, from_K: Tensor, to_view: Tensor, to_K: Tensor
) -> tuple[Tensor, Tensor]:
    """Reprojection of one camera's points into another: (places [H, W, 2], their depths there [H, W]).

    `depth` [H, W] is planar. Points behind the other camera have depth 0 or less.
    """
    height, width = depth.shape
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([x, y, torch.ones_like(x)], dim=-1).double()
    rays = pixels @ torch.linalg.inv(from_K.double()).T
    motion = to_view.double() @ torch.linalg.inv(from_view.double())
    points = (rays * depth.double().clamp(max=1e6)[..., None]) @ motion[:3, :3].T + motion[:3, 3]
    projected = points @ to_K.double().T
    behind = projected[..., 2:] <= 1e-6
    places = torch.where(behind, -1e6, projected[..., :2] / torch.where(behind, 1.0, projected[..., 2:]))
    return places.float(), points[..., 2].float()


def sampled(values: Tensor, places: Tensor, nearest: bool = False) -> Tensor:
    """`values` [H, W, C] or [H, W] at places; places outside get the border's value."""
    height, width = values.shape[:2]
    channels = values.float()[..., None] if values.ndim == 2 else values.float()
    grid = places * torch.tensor([2.0 / width, 2.0 / height]) - 1.0
    found = F.grid_sample(
        channels.permute(2, 0, 1)[None], grid.clamp(-4.0, 4.0)[None], mode="nearest" if nearest else "bilinear",
        padding_mode="border", align_corners=False,
    )[0].permute(1, 2, 0)  # fmt: skip
    return found[..., 0] if values.ndim == 2 else found


def inside(places: Tensor, width: int, height: int, border: float = 1.0) -> Tensor:
    """Mask of the places inside a picture, at least `border` pixels from its edge."""
    x, y = places[..., 0], places[..., 1]
    return (x > border) & (x < width - border) & (y > border) & (y < height - border)


def seen_again(places: Tensor, expected: Tensor, depth: Tensor) -> Tensor:
    """Mask of the points at `places` and depths `expected` that another view with `depth` [H, W] sees unoccluded."""
    height, width = depth.shape
    found = sampled(depth, places, nearest=True)
    near = (expected - found).abs() <= SAME_DEPTH * torch.maximum(expected, found).clamp_min(1e-6)
    return inside(places, width, height) & (expected > 0) & near


class Flow:
    """Dense optical flow between two pictures (DIS), of structure only, so that drifting exposure has no effect."""

    def __init__(self) -> None:
        if importlib.util.find_spec("cv2") is None:
            raise ModuleNotFoundError("optical flow needs opencv-python-headless (requirements/bench.txt)")
        import cv2

        self._dis: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)

    def __call__(self, a: Tensor, b: Tensor) -> Tensor:
        """[H, W, 2] displacement (x, y) from pixels of `a` to their places in `b`."""
        levels = [(_levelled(v) * 255.0).round().byte().numpy() for v in (a, b)]
        return torch.from_numpy(np.asarray(self._dis.calc(levels[0], levels[1], None)))


def _luma(image: Tensor) -> Tensor:
    return image.clamp(0.0, 1.0).float() @ torch.tensor([0.2126, 0.7152, 0.0722])


def _box(values: Tensor, width: int) -> Tensor:
    """Mean over a window of `width` pixels, clipped at the border."""
    return F.avg_pool2d(values[None, None], width, 1, width // 2, count_include_pad=False)[0, 0]


def _levelled(image: Tensor) -> Tensor:
    """Luma normalised by local mean and contrast, [H, W] in 0..1. Otherwise flow takes drifting exposure for motion."""
    luma = _luma(image)
    mean = _box(luma, LEVEL_WINDOW)
    deviation = (_box(luma.square(), LEVEL_WINDOW) - mean.square()).clamp_min(0.0).sqrt()
    return (0.5 + 0.2 * (luma - mean) / (deviation + LEVEL_FLOOR)).clamp(0.0, 1.0)


def textured(image: Tensor) -> Tensor:
    """bool [H, W] pixels with structure in two directions; elsewhere flow is unreliable.

    Uses the smaller eigenvalue of the structure tensor over `TEXTURE_WINDOW` pixels. Its root is a difference per
    pixel.
    """
    luma = _luma(image)
    x = F.pad(luma[:, 2:] - luma[:, :-2], (1, 1)) / 2.0
    y = F.pad(luma[2:] - luma[:-2], (0, 0, 1, 1)) / 2.0
    xx, xy, yy = (_box(v, TEXTURE_WINDOW) for v in (x * x, x * y, y * y))
    smaller = (xx + yy) / 2.0 - (((xx - yy) / 2.0).square() + xy.square()).sqrt()
    return smaller.clamp_min(0.0).sqrt() >= TEXTURE


def unexplained_flow(flow: Flow, a: Tensor, b: Tensor, places: Tensor, both: Tensor) -> Tensor:
    """Residual flow in pixels [H, W] between `a` and `b` warped to `a`, after the camera's motion.

    `b` is warped by `places` before the flow is computed, so that the flow is near zero where nothing moves. Flow of
    several pixels is wrong at every depth edge. Pixels that only `a` sees (not `both`) are filled from `a`, to avoid
    false flow.
    """
    brought = torch.where(both[..., None], sampled(b, places), a)
    return flow(a, brought).norm(dim=2)


def unsteadiness(a: Tensor, b: Tensor, places: Tensor) -> Tensor:
    """Absolute difference [H, W], mean over channels, of `a` and `b` warped to `a` by `places`."""
    return (a.clamp(0.0, 1.0) - sampled(b.clamp(0.0, 1.0), places)).abs().mean(2)


class Histogram:
    """Histogram of pixel values over many frames, for percentiles to 0.01."""

    STEP, TOP = 0.01, 64.0

    def __init__(self) -> None:
        self._counts = torch.zeros(round(self.TOP / self.STEP), dtype=torch.int64)

    def add(self, values: Tensor) -> None:
        """Adds values of 0 or more, of any shape."""
        at = (values.flatten() / self.STEP).long().clamp(0, len(self._counts) - 1)
        self._counts += torch.bincount(at, minlength=len(self._counts))

    def percentile(self, percent: float) -> float | None:
        """The value that `percent` of the values do not exceed; None without values."""
        total = int(self._counts.sum())
        if not total:
            return None
        at = int((self._counts.cumsum(0) >= total * percent / 100.0).int().argmax())
        return (at + 0.5) * self.STEP

    @property
    def count(self) -> int:
        """Number of values."""
        return int(self._counts.sum())
