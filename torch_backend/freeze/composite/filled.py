"""Pixels of a frozen frame filled from several plates, as a C++ kernel compiled by Warp."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from ...kernel_text import kernel_text
from ...native import INTEGER, POINTER, Snippet
from ..views.decisions import MARGIN
from ..views.source_views import SourceViews
from ..views.target_view import TargetView, parallax
from .config import CompositeConfig

_PIXELS = 1024
"""Number of pixels per unit of work."""
_KERNEL = Path(__file__).with_name("kernels") / "fill.cpp"


@dataclass
class Fillers:
    """The plates that fill the pixels not covered by the primary plate; lists have one item per plate."""

    chosen: list[int]
    """Frame numbers of the plates."""
    visible: list[Tensor]
    """[h, w] in 0..1: the plate shows the surface and its surroundings."""
    agreed: list[Tensor]
    """[h, w] in 0..1: the plate and plate t* show the surface alike."""
    residuals: list[Tensor]
    """[H, W, 3] float16, as `SourceViews.residual`."""
    maps: Tensor
    """[h, w, C] what `filled` looks up: motion, doubt, the splats' own motion, and of each plate the scene flow of the
    visible surface from t* to it (3 channels, scene units), `visible` and `agreed`. C is a multiple of 16."""
    most: float
    """The largest value in any of the plates, and at least `Display.most`."""


@dataclass
class Filled:
    """P filled pixels."""

    color: Tensor
    """[P, 3] premultiplied, display-referred: splats plus the weighted mean of the plates' residuals."""
    share: Tensor
    """[P] in 0..1: share of the residuals."""
    plate: Tensor
    """[P] int64 index of the plate with the largest weight, among `Fillers.chosen`."""
    instant: Tensor
    """[P] in 0..1: the pixel moves, plate t* shows it and its surroundings, and no other plate near in pose shows
    nearly the same state. Such a plate has no reprojection error, while plate t* may be a pixel off."""
    places: Tensor
    """[P, 2] its pixel in plate t*, at the plate's size."""
    points: Tensor
    """[P, 3] visible surface points, scene units."""


@functools.cache
def _snippet(plates: int) -> Snippet:
    pointers = ("at", "depth", "color", "camera", "maps", "table", "views", "settings", "out")
    sizes = (
        "count", "width", "top", "small_width", "small_height", "plates", "instant", "view_width", "view_height",
        "plate_width", "plate_height", "channels",
    )  # fmt: skip
    fields = {**dict.fromkeys(pointers, POINTER), **dict.fromkeys(sizes, INTEGER)}
    text = kernel_text(_KERNEL).replace("@PIXELS@", str(_PIXELS)).replace("@PLATES@", str(plates))
    return Snippet("fill", fields, text)


def filled(
    source_views: SourceViews, config: CompositeConfig, target: TargetView, fillers: Fillers, at: Tensor, rows: slice
) -> Filled:
    """Fills the pixels `at` [P, 2] int64, row and column, of some rows of the frame.

    A plate's weight is its visibility of the pixel's surface, reduced by the parallax of a depth error. On movers it
    is further reduced by the scene flow, by disagreement with the model, and where plate t* shows the pixel well.
    """
    views, c = [source_views.view(frame) for frame in fillers.chosen], source_views.config
    one = torch.ones((), device="cpu")
    cameras = [
        torch.cat([_camera(view.viewmat, view.K), parallax(source_views, target, frame, one, config.depth_error)[None]])
        for view, frame in zip(views, fillers.chosen, strict=True)
    ]
    table = torch.tensor(
        [
            [view.surface.data_ptr(), 0 if view.ignored is None else view.ignored.data_ptr(), residual.data_ptr()]
            for view, residual in zip(views, fillers.residuals, strict=True)
        ],
        dtype=torch.int64, device="cpu",
    )  # fmt: skip
    settings = torch.tensor(
        [
            target.per_pixel, c.depth_tolerance, 1.0 / c.margin, config.sway_trust,
            -math.log2(math.e) / (config.sway * source_views.unit), config.doubt, 1.0 - MARGIN,
            1.0 / MARGIN,
        ],
        device="cpu",
    )  # fmt: skip
    image, camera, stacked = target.image, _camera(target.viewmat, target.K), torch.stack(cameras)
    depth, color, maps, at = (a.contiguous() for a in (image.depth[rows], image.color[rows], fillers.maps, at))
    out = torch.empty(len(at), 12, device="cpu")
    instant = fillers.chosen.index(target.t) if target.t in fillers.chosen else -1
    _snippet(max(config.sources, len(views))).run(
        at=at.data_ptr(), depth=depth.data_ptr(), color=color.data_ptr(), camera=camera.data_ptr(),
        maps=maps.data_ptr(), table=table.data_ptr(), views=stacked.data_ptr(), settings=settings.data_ptr(),
        out=out.data_ptr(), count=len(at), width=depth.shape[1], top=rows.start, small_width=maps.shape[1],
        small_height=maps.shape[0], plates=len(views), instant=instant, view_width=source_views.size[0],
        view_height=source_views.size[1], plate_width=source_views.plates.width,
        plate_height=source_views.plates.height, channels=maps.shape[2],
    )  # fmt: skip
    return Filled(out[:, :3], out[:, 3], out[:, 4].long(), out[:, 5], out[:, 6:8], out[:, 8:11])


def _camera(viewmat: Tensor, K: Tensor) -> Tensor:
    """[16] rows 0 to 2 of a view matrix, then fx, fy, cx, cy."""
    return torch.cat([viewmat[:3].flatten(), torch.stack([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])]).float()
